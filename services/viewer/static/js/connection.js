// The web socket: requests with replies, and reconnection after a loss.

import { decode } from "./protocol.js";

const SILENCE_TIMEOUT = 6000; // ms without a message after which the connection counts as lost; one comes every second
const REQUEST_TIMEOUT = 20000; // ms
const RETRY_DELAYS = [400, 800, 1500, 3000, 5000]; // ms, after the first and the following failures

export class Connection {
  /** `on.message(json)`, `on.frame(frame)`, `on.state("open" | "waiting", ms until the next attempt)`. */
  constructor(on) {
    this.on = on;
    this.pending = new Map();
    this.nextId = 1;
    this.failures = 0;
    this.undecodable = 0;
    this.socket = null;
    addEventListener("online", () => this.retry());
    document.addEventListener("visibilitychange", () => document.hidden || this.retry());
    setInterval(() => this.checkSilence(), 1000);
    this.connect();
  }

  get open() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect() {
    clearTimeout(this.timer);
    const address = new URL("ws", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.hash = "";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.lastMessageAt = performance.now();
    socket.onmessage = (event) => {
      this.lastMessageAt = performance.now();
      if (this.socket === socket) this.receive(event.data);
    };
    socket.onclose = () => this.socket === socket && this.reconnect();
  }

  receive(data) {
    let message;
    try {
      message = typeof data === "string" ? JSON.parse(data) : decode(data);
    } catch {
      this.undecodable += 1;
      return;
    }
    if (!message?.type) this.undecodable += 1;
    else if (message.type === "answer") this.settle(message);
    else if (message.type === "frame") this.on.frame(message);
    else {
      if (message.type === "hello" && this.failures >= 0) {
        this.failures = -1; // a loss from here on counts as the first
        this.on.state("open", 0);
      }
      this.on.message(message);
    }
  }

  reconnect() {
    this.socket = null;
    this.failures = Math.max(0, this.failures);
    const wait = RETRY_DELAYS[Math.min(this.failures, RETRY_DELAYS.length - 1)];
    this.failures += 1;
    for (const id of [...this.pending.keys()]) this.settle({ id, ok: false, reason: "the connection was lost" });
    this.timer = setTimeout(() => this.connect(), wait);
    this.on.state("waiting", wait);
  }

  checkSilence() {
    if (this.socket && performance.now() - this.lastMessageAt > SILENCE_TIMEOUT) {
      const socket = this.socket;
      this.reconnect();
      socket.close();
    }
  }

  /** Connects at once instead of after the delay. */
  retry() {
    if (this.socket === null) this.connect();
  }

  settle(message) {
    const request = this.pending.get(message.id);
    if (!request) return;
    this.pending.delete(message.id);
    clearTimeout(request.timer);
    request.resolve(message);
  }

  /** Sends a request; resolves to {ok, reason, …}, never rejects. */
  request(action, fields = {}) {
    if (!this.open) return Promise.resolve({ ok: false, reason: "not connected" });
    const id = this.nextId++;
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.settle({ id, ok: false, reason: `no reply to ${action} within 20 s` }), REQUEST_TIMEOUT);
      this.pending.set(id, { resolve, timer });
      this.socket.send(JSON.stringify({ id, do: action, ...fields }));
    });
  }
}
