// Modes of the pointer on the map: set a goal, carry the robot, edit obstacles, or move the view.

import { $ } from "./dom.js";
import { distance, moved } from "./geometry.js";

const GRAB_DISTANCE = 8; // px around an obstacle within which it can be grabbed
const MOVE_EVERY = 180; // ms between two moves of a dragged obstacle

export class Modes {
  constructor(store, view, actions) {
    Object.assign(this, { store, view, actions });
    this.shape = "box";
    this.size = 0.5; // m
    this.changed = () => {};
    this.set("goal");
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.addEventListener("click", () => this.set(button.dataset.mode));
    }
  }

  set(name) {
    this.name = ["goal", "carry", "obstacle", "look"].includes(name) ? name : "goal";
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.setAttribute("aria-pressed", button.dataset.mode === this.name);
    }
    if (this.name !== "obstacle") this.select("");
    this.cancel();
    $("map").style.cursor = this.name === "look" ? "grab" : "crosshair";
    this.changed();
  }

  get canControl() {
    return this.store.control && !this.store.player && this.store.connected;
  }

  get gesture() {
    return this.view.gesture;
  }

  select(name) {
    this.gesture.selected = name;
    this.changed();
    this.view.invalidate();
  }

  get selected() {
    return this.obstacles.find((one) => one.name && one.name === this.gesture.selected) ?? null;
  }

  get obstacles() {
    return this.store.world?.obstacles ?? [];
  }

  /** The obstacle under a point that can be grabbed; null if there is none. */
  grabbable(point) {
    if (!this.canControl || point.shift || this.name !== "obstacle") return null;
    const reach = GRAB_DISTANCE / this.view.camera.scale;
    return this.obstacles.findLast((one) => one.name && distance(one, point.x, point.y) <= reach) ?? null;
  }

  hover(point) {
    const held = point && this.grabbable(point);
    const name = held?.name ?? "";
    if (this.gesture.hovered !== name) {
      this.gesture.hovered = name;
      this.view.invalidate();
    }
    const plan = point && !held && this.canControl && this.name === "obstacle" ? this.planned(point.x, point.y) : null;
    if (plan || this.gesture.plan) this.view.invalidate();
    this.gesture.plan = plan;
    return held || this.name === "look" || !this.canControl ? "grab" : "crosshair";
  }

  begin(point) {
    if (this.name === "look" || !this.canControl) return "pan";
    this.active = true;
    this.held = this.grabbable(point);
    if (this.held) this.select(this.held.name);
    return "";
  }

  drag(point, start) {
    if (!this.active) return;
    const heading = Math.atan2(point.y - start.y, point.x - start.x);
    const pose = { x: start.x, y: start.y, yaw: heading };
    if (this.held) {
      this.gesture.ghost = moved(this.held, point.x - start.x, point.y - start.y);
      this.sendMove(false);
    } else if (this.name === "carry" || start.shift) this.gesture.carry = pose;
    else if (this.name === "goal") this.gesture.goal = pose;
  }

  /** Sends the place of the dragged obstacle to the simulator, one request at a time. */
  sendMove(last) {
    const now = performance.now(), { ghost } = this.gesture;
    if (!ghost) return;
    if (last) this.actions.moveObstacle(ghost, true).then(() => this.drop(ghost));
    else if (!this.moving && now - (this.movedAt ?? 0) > MOVE_EVERY) {
      this.movedAt = now;
      this.moving = true;
      this.actions.moveObstacle(ghost, false).then(() => { this.moving = false; });
    }
  }

  drop(ghost) {
    if (this.gesture.ghost === ghost) this.gesture.ghost = null;
    this.view.invalidate();
  }

  end(point, start, clicked) {
    if (!this.active) return;
    const { goal, carry } = this.gesture;
    this.gesture.goal = this.gesture.carry = null;
    if (this.held) {
      if (!clicked) this.sendMove(true);
      this.held = null;
    } else if (this.name === "carry" || start.shift) {
      this.actions.teleport(carry ?? { x: start.x, y: start.y, yaw: this.yaw() });
    } else if (this.name === "goal") this.actions.goal(goal ?? { x: start.x, y: start.y });
    else if (this.name === "obstacle" && clicked) {
      if (this.gesture.selected) this.select("");
      else this.actions.addObstacle(this.planned(start.x, start.y));
    }
  }

  cancel() {
    Object.assign(this.gesture, { goal: null, carry: null, plan: null, ghost: null });
    this.held = null;
    this.active = false; // the rest of a drag does nothing
    this.view.invalidate();
  }

  yaw() {
    return this.store.frame?.truth?.yaw ?? this.store.frame?.belief?.yaw ?? 0;
  }

  /** A new obstacle of the chosen shape, with a name that is free. */
  planned(x, y) {
    const round = (value) => Math.round(value * 100) / 100;
    const taken = new Set(this.obstacles.map((one) => one.name));
    let n = 1;
    while (taken.has(`${this.shape}-${n}`)) n += 1;
    const center = [round(x), round(y)], name = `${this.shape}-${n}`;
    return this.shape === "circle"
      ? { name, circle: { center, radius: this.size / 2 } }
      : { name, box: { center, size: [this.size, this.size], yaw_deg: 0 } };
  }
}
