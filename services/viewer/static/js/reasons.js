// Why the robot stops or searches: a notice over the map while it does, and the last reasons in the journal.

import { $, h, icon, setText } from "./dom.js";

export const STATUS = {
  idle: ["s-ring", ""], navigating: ["s-play", "work"], reached: ["s-check", "good"], blocked: ["s-square", "warn"],
  lost: ["s-triangle", "bad"], manual: ["s-dot", "work"], exploring: ["i-localise", "work"], carried: ["i-carry", "warn"],
};
const TITLES = { blocked: "Blocked", lost: "Lost", exploring: "Exploring" };
const MIN_STOP_DURATION = 600; // ms; a shorter obstacle stop is not shown

export class Reasons {
  constructor(store) {
    this.store = store;
    this.title = h("b");
    this.text = h("span");
    this.mark = icon("s-square");
    $("why").append(this.mark, h("div", {}, this.title, " ", this.text));
  }

  /** The notice over the map: state, title and text; null if there is none. */
  get now() {
    const { frame, missing, connected, stoppedAt } = this.store, status = frame?.status;
    if (!connected || missing.some((one) => one.name === "controller")) return null;
    if (status && status.state in TITLES) {
      const done = status.exploration ? `; ${status.exploration.area.toFixed(0)} m² mapped, ${status.exploration.path.toFixed(0)} m driven` : "";
      return [status.state, `${TITLES[status.state]}:`, (status.reason || "no reason given") + done];
    }
    if (frame?.truth?.contact) return ["lost", "Contact:", "the robot touches something"];
    if (frame?.truth?.stopped && performance.now() - stoppedAt > MIN_STOP_DURATION) {
      return ["blocked", "Obstacle stop:", "an obstacle is too close ahead; the robot's safety stop holds the wheels"];
    }
    return null;
  }

  draw() {
    const now = this.now;
    $("why").hidden = !now;
    if (!now) return;
    const [state, title, text] = now, [mark, tone] = STATUS[state];
    $("why").dataset.tone = tone;
    this.mark.querySelector("use").setAttribute("href", `#${mark}`);
    setText(this.title, title);
    setText(this.text, text);
  }

  /** Draws the journal, the newest entry first. */
  drawJournal() {
    const rows = [...this.store.journal].reverse().map(({ t, state, reason }) => {
      const [mark, tone] = STATUS[state] ?? STATUS.idle;
      return h("li", { data: { tone } }, h("time", {}, `${t.toFixed(1)} s`), icon(mark),
        h("span", {}, h("b", {}, state), reason ? ` ${reason}` : ""));
    });
    $("journal").replaceChildren(...(rows.length ? rows : [h("li", { class: "quiet" }, "No events yet.")]));
  }
}
