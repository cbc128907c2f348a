// The tools below the map, and the line above them with the options of the mode.

import { $, h, setIcon, setText } from "./dom.js";

const TOUCH = matchMedia("(pointer: coarse)").matches, CLICK = TOUCH ? "Tap" : "Click";
const HINTS = {
  goal: `${CLICK} to set a goal, drag for its heading`,
  carry: `${CLICK} to carry the robot there, drag for its heading`,
  obstacle: `${CLICK} to add, drag to move`,
  look: TOUCH ? "Drag to move the view, pinch to zoom" : "Drag to move the view, scroll to zoom",
};

export class Toolbar {
  constructor(store, modes, actions) {
    Object.assign(this, { store, modes, actions });
    $("pause").addEventListener("click", () => this.togglePause());
    $("step").addEventListener("click", () => actions.step());
    $("reset").addEventListener("click", () => actions.reset());
    $("speed").addEventListener("change", () => actions.speed(Number($("speed").value)));
    $("localise").addEventListener("click", () => actions.localise());
    $("explore").addEventListener("click", () => (this.exploring ? actions.cancel() : actions.explore()));
    $("record").addEventListener("click", () => actions.record(actions.recording ? "stop" : "start"));
    $("sub").addEventListener("submit", (event) => {
      event.preventDefault();
      this.submit();
    });
    $("save-map").addEventListener("submit", (event) => {
      event.preventDefault();
      actions.saveMap(new FormData($("save-map")).get("name"));
    });
    modes.changed = () => this.draw();
    actions.changed = () => this.draw();
    this.draw();
  }

  /** Whether the simulation stands still: paused, or without a scan for longer than the slowest speed needs. */
  get standing() {
    const last = this.store.arrivals.at(-1);
    return this.store.paused || (last !== undefined && performance.now() - last > 1500);
  }

  /** Whether the robot explores, or will continue to after a goal. */
  get exploring() {
    return ["exploring", "returning"].includes(this.store.frame?.status?.exploration?.phase);
  }

  togglePause() {
    this.actions.pause(!this.standing);
  }

  draw() {
    const { store, modes, actions } = this;
    const allowed = modes.canControl;
    $("watch-only").hidden = !store.hello || store.control;
    document.body.toggleAttribute("data-playing", Boolean(store.player));
    document.body.toggleAttribute("data-real-robot", !store.simulated);
    if (!store.simulated && ["carry", "obstacle"].includes(modes.name)) modes.set("goal");
    for (const id of ["pause", "step", "reset", "speed", "localise", "record"]) $(id).disabled = !allowed;
    for (const button of document.querySelectorAll("[data-mode]")) button.disabled = !allowed && button.dataset.mode !== "look";
    $("open").disabled = !store.connected || !store.control;
    $("explore-group").hidden = $("save-map").hidden = !store.map;
    $("localise").parentElement.hidden = Boolean(store.map); // the mapper finds the robot by itself
    $("explore").disabled = $("save-button").disabled = !allowed;
    $("explore").setAttribute("aria-pressed", String(this.exploring));
    setText($("explore-label"), this.exploring ? "Stop" : "Explore");
    $("step").disabled = !allowed || !this.standing;
    setIcon($("pause"), this.standing ? "i-play" : "i-pause");
    setText($("pause-label"), this.standing ? "Resume" : "Pause");
    $("record").setAttribute("aria-pressed", String(actions.recording));
    setText($("record-label"), actions.recording ? "Stop" : "Record");
    $("record").title = actions.recording ? "Stop recording (R)" : "Record (R)";
    this.drawSub(allowed);
  }

  drawSub(allowed) {
    const { modes } = this;
    $("sub").hidden = Boolean(this.store.player) || !this.store.world;
    const selected = modes.selected;
    const kind = !allowed ? "none" : selected ? `selected ${selected.name} ${Boolean(selected.circle)}` : modes.name;
    if (this.kind === kind) return;
    this.kind = kind;
    $("sub").replaceChildren(...this.parts(allowed, selected));
  }

  parts(allowed, selected) {
    const { modes, actions } = this;
    if (!allowed) return [h("span", { class: "hint" }, this.store.control ? "Not connected" : "View only: this page was started without --allow-control")];
    const hint = (text) => h("span", { class: "hint" }, text);
    const button = (text, run, attributes = {}) => h("button", { type: "button", onclick: run, ...attributes }, text);
    if (selected) {
      const turns = selected.circle ? [] : [
        button("⟲ 15°", () => actions.turnObstacle(this.modes.selected ?? selected, Math.PI / 12), { "aria-label": "Turn left by 15 degrees" }),
        button("⟳ 15°", () => actions.turnObstacle(this.modes.selected ?? selected, -Math.PI / 12), { "aria-label": "Turn right by 15 degrees" }),
      ];
      return [hint(selected.name), ...turns, button("Remove", () => actions.removeObstacle(selected.name)), button("Done", () => modes.select(""))];
    }
    if (modes.name === "goal") return [hint(HINTS.goal), ...this.place(), h("button", { class: "primary" }, "Go"), button("Cancel goal", () => actions.cancel())];
    if (modes.name === "carry") return [hint(HINTS.carry), ...this.place(), h("button", { class: "primary" }, "Carry")];
    if (modes.name === "obstacle") return this.furniture(hint);
    return [hint(HINTS.look)];
  }

  furniture(hint) {
    const { modes } = this;
    const shape = h("select", { "aria-label": "Shape", onchange: () => { modes.shape = shape.value; } },
      h("option", { value: "box" }, "box"), h("option", { value: "circle" }, "circle"));
    shape.value = modes.shape;
    const size = h("input", { type: "number", min: 0.05, max: 20, step: 0.05, value: modes.size, "aria-label": "Size in metres",
      oninput: () => { if (size.valueAsNumber >= 0.05 && size.valueAsNumber <= 20) modes.size = size.valueAsNumber; } });
    return [hint(HINTS.obstacle), shape, h("label", {}, size, "m"), ...this.place(false), h("button", { class: "primary" }, "Add")];
  }

  /** Input fields for a pose, as an alternative to pointing. */
  place(heading = true) {
    const field = (name, label, unit, required) => h("label", { class: "field" }, label,
      h("input", { type: "number", step: "any", name, required, "aria-label": `${name}, ${unit}` }), unit === "degrees" ? "°" : null);
    return [field("x", "x", "metres", true), field("y", "y", "metres", true), ...(heading ? [field("heading", "heading", "degrees", false)] : [])];
  }

  submit() {
    const { modes, actions } = this;
    const fields = new FormData($("sub"));
    if (!fields.get("x") || !fields.get("y")) return;
    const x = Number(fields.get("x")), y = Number(fields.get("y"));
    const heading = fields.get("heading") ? (Number(fields.get("heading")) * Math.PI) / 180 : undefined;
    if (modes.name === "goal") actions.goal({ x, y, yaw: heading });
    if (modes.name === "carry") actions.teleport({ x, y, yaw: heading ?? modes.yaw() });
    if (modes.name === "obstacle") actions.addObstacle(modes.planned(x, y));
  }
}
