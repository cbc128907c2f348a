// Manual driving by keys or joystick.

import { $ } from "./dom.js";

// ms; a command expires after 500 ms of the robot's time, and a simulation may run ten times as fast
const SEND_PERIOD = 25;
const KEYS = {
  w: [1, 0, 0], arrowup: [1, 0, 0], s: [-1, 0, 0], arrowdown: [-1, 0, 0],
  a: [0, 0, 1], arrowleft: [0, 0, 1], d: [0, 0, -1], arrowright: [0, 0, -1],
  q: [0, 1, 0], e: [0, -1, 0],
};
const SPEED_SHARE = 0.6; // of the maximum speed, without shift

export class Drive {
  constructor(store, actions, allowed) {
    Object.assign(this, { store, actions, allowed });
    this.down = new Set();
    this.stick = null; // forward and turn, -1 to 1
    this.fast = false;
    this.waiting = false; // for the reply to the last command
    addEventListener("blur", () => this.stop());
    document.addEventListener("visibilitychange", () => document.hidden && this.stop());
    this.startStick();
  }

  /** Handles a key; returns whether it is a key for driving. */
  press(event) {
    const key = event.key.toLowerCase();
    if (!(key in KEYS)) return false;
    this.down.add(key);
    this.fast = event.shiftKey;
    this.run();
    return true;
  }

  release(event) {
    this.fast = event.shiftKey;
    if (this.down.delete(event.key.toLowerCase()) && this.down.size === 0) this.stop();
  }

  run() {
    if (this.timer || !this.allowed()) return;
    this.timer = setInterval(() => this.send(), SEND_PERIOD);
    this.send();
  }

  /** Stops driving: sends one last command, to stand still. */
  stop() {
    this.down.clear();
    this.stick = null;
    if (!this.timer) return;
    clearInterval(this.timer);
    this.timer = null;
    this.actions.drive({ vx: 0, vy: 0, wz: 0 });
  }

  async send() {
    if (!this.allowed()) {
      this.stop();
      return;
    }
    if (this.waiting) return; // commands that queue up would delay the stop
    this.waiting = true;
    const reply = await this.actions.drive(this.twist());
    this.waiting = false;
    if (!reply.ok && this.timer) {
      this.stop();
      this.actions.toast(reply.reason, false);
    }
  }

  twist() {
    const { max_speed: speed = 1, max_turn: turn = 2 } = this.store.robot ?? {};
    const share = this.fast ? 1 : SPEED_SHARE;
    const sum = [0, 0, 0];
    for (const key of this.down) KEYS[key].forEach((value, i) => { sum[i] += value; });
    if (this.stick) {
      sum[0] += this.stick[0];
      sum[2] += this.stick[1];
    }
    const [vx, vy, wz] = sum.map((value) => Math.max(-1, Math.min(1, value)) * share);
    const backing = vx < 0 ? -1 : 1; // the joystick steers like a car: backwards, left stays left
    return { vx: vx * speed, vy: this.store.robot?.drive === "differential" ? 0 : vy * speed, wz: (this.stick ? backing : 1) * wz * turn * 0.6 };
  }

  startStick() {
    const box = $("joystick"), knob = box.firstElementChild;
    let middle = null; // px, centre when the touch began; the page may scroll during it
    const place = (dx, dy) => { knob.style.transform = `translate(${dx}px, ${dy}px)`; };
    const steer = (event) => {
      const { x, y, reach } = middle;
      let dx = event.clientX - x, dy = event.clientY - y;
      const far = Math.hypot(dx, dy);
      if (far > reach) [dx, dy] = [(dx * reach) / far, (dy * reach) / far];
      place(dx, dy);
      this.stick = [-dy / reach, -dx / reach];
      this.run();
    };
    const leave = () => {
      place(0, 0);
      if (this.stick) this.stop();
    };
    box.addEventListener("pointerdown", (event) => {
      box.setPointerCapture(event.pointerId);
      const size = box.getBoundingClientRect();
      middle = { x: size.left + size.width / 2, y: size.top + size.height / 2, reach: size.width / 2 - 12 };
      steer(event);
    });
    box.addEventListener("pointermove", (event) => this.stick && steer(event));
    box.addEventListener("pointerup", leave);
    box.addEventListener("pointercancel", leave);
  }
}
