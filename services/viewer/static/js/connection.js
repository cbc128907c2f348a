// The socket: questions with answers, and its own return after a loss.

import { decode } from "./protocol.js";

const SILENCE = 6000; // ms without a message: the other side is gone, services are told every second
const ANSWER = 20000; // ms until a question counts as unanswered
const WAITS = [400, 800, 1500, 3000, 5000]; // ms between attempts

export class Connection {
  /** `on.message(json)`, `on.frame(frame)`, `on.state("open" | "waiting", ms until the next attempt)`. */
  constructor(on) {
    this.on = on;
    this.questions = new Map();
    this.nextId = 1;
    this.failures = 0;
    this.undecodable = 0;
    this.socket = null;
    addEventListener("online", () => this.retry());
    document.addEventListener("visibilitychange", () => document.hidden || this.retry());
    setInterval(() => this.watch(), 1000);
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
    this.heard = performance.now();
    socket.onmessage = (event) => {
      this.heard = performance.now();
      if (this.socket === socket) this.receive(event.data);
    };
    socket.onclose = () => this.socket === socket && this.lost();
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
    else if (message.type === "answer") this.answered(message);
    else if (message.type === "frame") this.on.frame(message);
    else {
      if (message.type === "hello" && this.failures >= 0) {
        this.failures = -1; // from here on a loss is a new one
        this.on.state("open", 0);
      }
      this.on.message(message);
    }
  }

  lost() {
    this.socket = null;
    this.failures = Math.max(0, this.failures);
    const wait = WAITS[Math.min(this.failures, WAITS.length - 1)];
    this.failures += 1;
    for (const id of [...this.questions.keys()]) this.answered({ id, ok: false, reason: "the connection was lost" });
    this.timer = setTimeout(() => this.connect(), wait);
    this.on.state("waiting", wait);
  }

  watch() {
    if (this.open && performance.now() - this.heard > SILENCE) {
      const socket = this.socket;
      this.lost();
      socket.close();
    }
  }

  /** At once instead of after the wait. */
  retry() {
    if (this.socket === null) this.connect();
  }

  answered(message) {
    const question = this.questions.get(message.id);
    if (!question) return;
    this.questions.delete(message.id);
    clearTimeout(question.timer);
    question.resolve(message);
  }

  /** Ask for an action; resolves to {ok, reason, …}, never rejects. */
  ask(action, fields = {}) {
    if (!this.open) return Promise.resolve({ ok: false, reason: "not connected" });
    const id = this.nextId++;
    return new Promise((resolve) => {
      const timer = setTimeout(() => this.answered({ id, ok: false, reason: `no answer to ${action} within 20 s` }), ANSWER);
      this.questions.set(id, { resolve, timer });
      this.socket.send(JSON.stringify({ id, do: action, ...fields }));
    });
  }
}
