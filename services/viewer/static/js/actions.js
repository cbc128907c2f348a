// The requests that a visitor can send, and the messages that show their results.

import { moved, placeText } from "./geometry.js";

const rounded = (pose) => Object.fromEntries(Object.entries(pose).filter(([, v]) => Number.isFinite(v)).map(([k, v]) => [k, Math.round(v * 1e4) / 1e4]));

const OF_SIMULATION = new Set(["teleport", "obstacle", "pause", "resume", "step", "reset", "speed"]);
const REAL_ROBOT = { ok: false, reason: "only in a simulation, but these scans come from a real robot" };

export class Actions {
  constructor(store, connection, toast) {
    Object.assign(this, { store, connection, toast });
    this.recording = false;
    this.changed = () => {};
  }

  /** Sends a request and shows its result: the reply's reason, else the text `done`. */
  async request(action, fields, done, { quiet = false } = {}) {
    const possible = this.store.simulated || !OF_SIMULATION.has(action);
    const reply = possible ? await this.connection.request(action, fields) : REAL_ROBOT;
    if (!reply.ok) this.toast(reply.reason || `${action} was refused`, false);
    else if (!quiet) this.toast(reply.reason || done, true);
    this.changed();
    return reply;
  }

  place(pose) {
    return placeText(this.store.world?.floors ?? [], pose);
  }

  watch(robot) {
    return this.request("watch", { robot }, "", { quiet: true });
  }

  goal(pose) {
    return this.request("goal", rounded(pose), `Going to ${this.place(pose)}`);
  }

  cancel() {
    return this.request("cancel", {}, "Goal cancelled");
  }

  explore() {
    return this.request("explore", {}, "Exploring");
  }

  teleport(pose) {
    return this.request("teleport", rounded(pose), `Carried to ${this.place(pose)}; ${this.store.paused ? "shown with the next scan" : "the estimator is not informed"}`);
  }

  localise() {
    return this.request("localise", {}, "Searching the whole map");
  }

  addObstacle(obstacle) {
    return this.request("obstacle", { action: "add", name: obstacle.name, obstacle }, `${obstacle.name} added; the robot's map does not know it`);
  }

  moveObstacle(obstacle, last) {
    return this.request("obstacle", { action: "move", name: obstacle.name, obstacle }, `${obstacle.name} moved`, { quiet: !last });
  }

  turnObstacle(obstacle, turn) {
    return this.moveObstacle(moved(obstacle, 0, 0, turn), false);
  }

  removeObstacle(name) {
    return this.request("obstacle", { action: "remove", name }, `${name} removed`);
  }

  async pause(paused) {
    const reply = await this.request(paused ? "pause" : "resume", {}, paused ? "Paused" : "Running", { quiet: true });
    if (reply.ok) Object.assign(this.store, { paused, pausedAt: performance.now() });
    this.changed();
  }

  async step() {
    const reply = await this.request("step", {}, "", { quiet: true });
    if (reply.ok) this.store.pausedAt = performance.now();
  }

  async reset() {
    const reply = await this.request("reset", {}, this.store.paused ? "Restarted; shown with the next scan" : "Simulation restarted");
    if (reply.ok) this.store.forget();
  }

  speed(factor) {
    return this.request("speed", { factor }, `${factor} × real time`);
  }

  async record(action) {
    const reply = await this.request("record", { action }, action === "start" ? "Recording" : "Recording saved", { quiet: action === "status" });
    if (reply.ok && typeof reply.recording === "boolean") this.recording = reply.recording;
    else if (reply.ok && action !== "status") this.recording = action === "start";
    this.changed();
    return reply;
  }

  /** Asks the recorder for its state if its health shows another one: another visitor or program may have changed it. */
  followRecorder() {
    const recorder = this.store.services.find((one) => one.name === "recorder");
    if (this.store.control && Boolean(recorder && !recorder.idle) !== this.recording) this.recordStatus();
  }

  /** Updates the state of the recorder without showing a message. */
  async recordStatus() {
    const reply = await this.connection.request("record", { action: "status" });
    this.recording = Boolean(reply.ok && reply.recording);
    this.changed();
  }

  saveMap(name) {
    return this.request("save_map", { name }, "Map saved");
  }

  drive(twist) {
    return this.connection.request("drive", twist);
  }
}
