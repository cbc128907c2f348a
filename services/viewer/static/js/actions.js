// What a visitor can ask for, and how the answer is told.

import { moved } from "./geometry.js";

const at = ({ x, y }) => `${x.toFixed(2)}, ${y.toFixed(2)} m`;
const neat = (pose) => Object.fromEntries(Object.entries(pose).filter(([, v]) => Number.isFinite(v)).map(([k, v]) => [k, Math.round(v * 1e4) / 1e4]));

export class Actions {
  constructor(store, connection, toast) {
    Object.assign(this, { store, connection, toast });
    this.recording = false;
    this.changed = () => {};
  }

  /** Ask, and say how it went; `done` in words where the answer has none. */
  async ask(action, fields, done, { quiet = false } = {}) {
    const answer = await this.connection.ask(action, fields);
    if (!answer.ok) this.toast(answer.reason || `${action} was refused`, false);
    else if (!quiet) this.toast(answer.reason || done, true);
    this.changed();
    return answer;
  }

  watch(robot) {
    return this.ask("watch", { robot }, "", { quiet: true });
  }

  goal(pose) {
    return this.ask("goal", neat(pose), `Goal set: ${at(pose)}`);
  }

  cancel() {
    return this.ask("cancel", {}, "Goal cancelled");
  }

  explore() {
    return this.ask("explore", {}, "Exploring");
  }

  teleport(pose) {
    return this.ask("teleport", neat(pose), `Carried to ${at(pose)}; the estimator is not informed`);
  }

  localise() {
    return this.ask("localise", {}, "Searching the whole map");
  }

  addObstacle(obstacle) {
    return this.ask("obstacle", { action: "add", name: obstacle.name, obstacle }, `${obstacle.name} added; the robot's map does not know it`);
  }

  moveObstacle(obstacle, last) {
    return this.ask("obstacle", { action: "move", name: obstacle.name, obstacle }, `${obstacle.name} moved`, { quiet: !last });
  }

  turnObstacle(obstacle, turn) {
    return this.moveObstacle(moved(obstacle, 0, 0, turn), false);
  }

  removeObstacle(name) {
    return this.ask("obstacle", { action: "remove", name }, `${name} removed`);
  }

  async pause(paused) {
    const answer = await this.ask(paused ? "pause" : "resume", {}, paused ? "Paused" : "Running", { quiet: true });
    if (answer.ok) Object.assign(this.store, { paused, pausedAt: performance.now() });
    this.changed();
  }

  async step() {
    const answer = await this.ask("step", {}, "", { quiet: true });
    if (answer.ok) this.store.pausedAt = performance.now();
  }

  async reset() {
    const answer = await this.ask("reset", {}, "Simulation restarted");
    if (answer.ok) this.store.forget();
  }

  speed(factor) {
    return this.ask("speed", { factor }, `${factor} × real time`);
  }

  async record(action) {
    const answer = await this.ask("record", { action }, action === "start" ? "Recording" : "Recording saved", { quiet: action === "status" });
    if (answer.ok && typeof answer.recording === "boolean") this.recording = answer.recording;
    else if (answer.ok && action !== "status") this.recording = action === "start";
    this.changed();
    return answer;
  }

  /** The state of the recorder, without a word about it. */
  async recordStatus() {
    const answer = await this.connection.ask("record", { action: "status" });
    this.recording = Boolean(answer.ok && answer.recording);
    this.changed();
  }

  saveMap(name) {
    return this.ask("save_map", { name }, "Map saved");
  }

  drive(twist) {
    return this.connection.ask("drive", twist);
  }
}
