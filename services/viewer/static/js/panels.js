// The panels beside the map: badges, key numbers, charts.

import { Chart, cursor, indexAt } from "./chart.js";
import { $, h, icon, setText } from "./dom.js";
import { describeBelief, explainBelief } from "./draw_belief.js";
import { metres, number } from "./format.js";
import { STATUS } from "./reasons.js";
import { ScanPlot } from "./scan_plot.js";

const TEXT_PERIOD = 180; // ms between updates of texts; faster ones cannot be read
const BELIEF = { tracking: ["s-dot", "good"], localising: ["s-half", "work"], ambiguous: ["s-diamond", "warn"], lost: ["s-triangle", "bad"] };

export class Panels {
  constructor(store) {
    this.store = store;
    const chart = (id, series, options) => new Chart($(id), store, series, options);
    this.charts = [
      chart("c-energy", [{ key: "accuracy", tone: "measured", width: 1 }, { key: "free_energy", tone: "predicted" }], { axis: false, nothing: "no free energy yet" }),
      chart("c-complexity", [{ key: "complexity", tone: "goal", fill: true }], { low: 0, high: 1 }),
      chart("c-error", [{ key: "error", tone: "predicted", fill: true }], { log: true, low: 0.0001, high: 0.01, nothing: "no true pose: only a simulator knows it" }),
      chart("c-speed", [{ key: "speed", tone: "measured", fill: true }], { low: 0, high: 0.5 }),
    ];
    this.scan = new ScanPlot($("c-scan"), store);
    this.keys = {
      free_energy: key("k-energy", "predicted", "F"), accuracy: key("k-energy", "measured", "accuracy"),
      complexity: key("k-energy", "goal", "complexity"), error: key("k-error", "predicted", ""), speed: key("k-speed", "measured", ""),
    };
    this.policy = Object.fromEntries(["risk", "ambiguity", "pose_information", "place_information"]
      .map((term) => [term, key("k-policy", "predicted", term.replace("_information", ""))]));
    this.badges = { estimator: badge("estimator-badge", "estimator"), controller: badge("controller-badge", "controller") };
    this.textDrawnAt = -Infinity;
    cursor.changed = () => {
      this.drawKeys();
      this.draw();
    };
  }

  draw() {
    const now = performance.now();
    if (now - this.textDrawnAt > TEXT_PERIOD) {
      this.textDrawnAt = now;
      this.drawBadges();
      this.drawVitals();
      this.drawKeys();
    }
    for (const chart of this.charts) chart.draw();
    this.scan.draw();
  }

  drawBadges() {
    const { frame, missing, servicesKnown } = this.store;
    const gone = (name) => servicesKnown && missing.some((one) => one.name === name);
    const { belief, status } = frame ?? {};
    const none = (name) => (gone(name) ? ["s-triangle", "bad", "missing", "see the note on the map"]
      : this.store.stuck.some((one) => one.name === name) ? ["s-triangle", "bad", "silent", "see the note on the map"] : ["s-ring", "", "silent", "no messages"]);
    this.badges.estimator(...(belief && !gone("estimator") ? [...(BELIEF[belief.state] ?? ["s-ring", ""]), belief.state, describeBelief(belief)] : none("estimator")));
    const why = status?.reason || (status?.state === "navigating" && status.distance !== null ? `${metres(status.distance)} to go` : "");
    this.badges.controller(...(status && !gone("controller") ? [...(STATUS[status.state] ?? ["s-ring", ""]), status.state, why] : none("controller")));
    $("estimator-badge").title = belief ? explainBelief(belief) : "";
    $("scan-band").hidden = Boolean(frame) && frame.sigma.length === 0;
  }

  drawVitals() {
    const { frame } = this.store;
    const rate = this.store.rate(performance.now());
    setText($("v-time"), frame ? `${frame.t.toFixed(1)} s` : "–");
    setText($("v-rate"), rate ? `${rate.toFixed(1)} Hz` : this.store.paused && frame ? "paused" : "–");
    setText($("v-latency"), frame?.latency_ms != null ? `${number(frame.latency_ms, frame.latency_ms < 10 ? 1 : 0)} ms` : "–");
    setText($("v-error"), metres(frame?.error));
    for (const [term, show] of Object.entries(this.policy)) {
      const energy = frame?.status?.energy;
      show(energy ? number(energy[term], 4) : "–");
    }
  }

  /** Shows the latest values, or those under the pointer. */
  drawKeys() {
    const { history } = this.store;
    const i = cursor.t === null ? history.t.length - 1 : indexAt(history.t, cursor.t);
    const value = (name) => history[name][i];
    const nats = (name) => number(value(name), Math.abs(value(name)) < 10 ? 1 : 0);
    this.keys.free_energy(nats("free_energy"));
    this.keys.accuracy(nats("accuracy"));
    this.keys.complexity(nats("complexity"));
    this.keys.error(metres(value("error")));
    this.keys.speed(`${number(value("speed"), 2)} m/s`);
  }
}

/** Adds a name with a coloured line and a value; returns a function that sets the value. */
function key(box, tone, name) {
  const value = h("b", {}, "–");
  $(box).append(h("span", { class: `key ${tone}` }, name, value));
  return (text) => setText(value, text);
}

/** Fills a badge with a state's icon, colour and reason; returns a function that sets them, only if they change. */
function badge(id, name) {
  const box = $(id), state = h("b", { role: "status" }), why = h("span", { class: "why" });
  const shape = icon("s-ring");
  box.append(shape, h("span", { class: "who" }, name), state, why);
  let shown = "";
  return (mark, tone, text, reason) => {
    setText(why, reason);
    if (shown === `${mark} ${text}`) return;
    shown = `${mark} ${text}`;
    shape.querySelector("use").setAttribute("href", `#${mark}`);
    box.dataset.tone = tone;
    box.dataset.state = text;
    setText(state, text);
  };
}
