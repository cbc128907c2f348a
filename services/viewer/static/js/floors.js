// The floor of a building that the map shows: the robot's, or the one that the visitor chose.

import { $, h } from "./dom.js";
import { floorAt } from "./geometry.js";

const ALL = "*"; // no name of a floor

export class Floors {
  constructor(store, view) {
    Object.assign(this, { store, view });
    this.chosen = ""; // name of a floor, ALL, or empty for the robot's
    $("floor").addEventListener("change", () => {
      this.chosen = $("floor").value;
      this.show();
    });
  }

  get floors() {
    return this.store.world?.floors ?? [];
  }

  /** Call it when the world has changed. */
  update() {
    const names = this.floors.map((floor) => floor.name);
    if (this.chosen !== ALL && !names.includes(this.chosen)) this.chosen = "";
    const option = (value, text) => h("option", { value }, text);
    $("floor").replaceChildren(option("", "robot’s floor"), option(ALL, "all floors"), ...names.map((name) => option(name, name)));
    $("floor").value = this.chosen;
    $("floor").parentElement.hidden = !names.length;
    this.view.floor = this.floors.find((floor) => floor.name === this.view.floor?.name) ?? null;
    this.view.floor = this.wanted();
  }

  /** Follows the robot to another floor. */
  follow() {
    if (this.chosen === "" && this.wanted() !== this.view.floor) this.show();
  }

  show() {
    this.view.floor = this.wanted();
    if (this.chosen || !this.view.camera.follow) this.view.fit();
  }

  /** The floor to show, or null for all. */
  wanted() {
    if (this.chosen) return this.floors.find((floor) => floor.name === this.chosen) ?? null;
    const { belief, truth } = this.store.frame ?? {};
    if (belief && belief.state !== "tracking") return this.view.floor; // which floor is not known: keep the last
    const pose = belief ?? truth;
    return (pose && floorAt(this.floors, pose)) ?? this.view.floor;
  }
}
