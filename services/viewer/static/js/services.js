// Health of all services, and how to start missing ones.

import { $, h, icon, setText } from "./dom.js";
import { span } from "./format.js";

export class Services {
  constructor(store, toast) {
    Object.assign(this, { store, toast });
    this.opened = new Set();
    this.shown = "";
  }

  draw() {
    this.drawTable();
    this.drawMissing();
  }

  drawTable() {
    const { services } = this.store;
    const alive = services.filter((one) => one.alive).length;
    setText($("k-services"), services.length ? `${alive} of ${services.length} running` : "");
    const focused = document.activeElement?.dataset?.service;
    const rows = services.flatMap((one) => this.rows(one));
    if (!rows.length) rows.push(h("tr", { class: "note" }, h("td", { colspan: 6 }, this.store.servicesKnown ? "No service is running." : "Waiting for the services.")));
    $("services").replaceChildren(...rows);
    if (focused) [...$("services").querySelectorAll("button")].find((button) => button.dataset.service === focused)?.focus();
  }

  rows(one) {
    const rates = one.rates ?? [];
    const sum = (name) => rates.reduce((total, rate) => total + (rate[name] ?? 0), 0);
    const open = this.opened.has(one.name);
    const head = h("tr", { class: one.alive ? "" : "dead" },
      h("td", {}, this.toggle(one, open, rates.length)), ...cells({
        published_hz: sum("published_hz"), received_hz: sum("received_hz"), dropped: sum("dropped"), undecodable: sum("undecodable"),
      }), h("td", { title: one.age_s == null ? "" : `last sign of life ${one.age_s} s ago` }, one.alive ? (one.uptime_s == null ? "–" : span(one.uptime_s)) : "gone"));
    const note = one.note ? [h("tr", { class: "note" }, h("td", { colspan: 6 }, one.note))] : [];
    const topics = open ? rates.map((rate) => h("tr", { class: "topic" }, h("th", { scope: "row" }, rate.topic), ...cells(rate), h("td"))) : [];
    return [head, ...note, ...topics];
  }

  toggle(one, open, any) {
    const button = h("button", {
      class: "service", "aria-expanded": String(open), data: { service: one.name }, disabled: !any,
      onclick: () => {
        if (!this.opened.delete(one.name)) this.opened.add(one.name);
        this.drawTable();
      },
    }, icon("i-chevron", "turn"), icon(one.alive ? "s-dot" : "s-triangle", one.alive ? "alive" : "gone"), one.name);
    button.append(h("span", { class: "sr" }, one.alive ? "alive" : "not alive"));
    return button;
  }

  drawMissing() {
    const { missing, frame, world, connected, servicesKnown, player } = this.store;
    const now = performance.now();
    const silent = frame && this.store.arrivals.length > 0 && now - this.store.arrivals.at(-1) > 3000;
    const empty = connected && servicesKnown && !player && !world && !frame;
    const stuck = this.store.stuck.map((one) => one.name);
    const state = JSON.stringify([missing, stuck, empty, connected, silent && !this.store.paused, Boolean(player)]);
    if (state === this.shown) return;
    this.shown = state;
    $("empty").hidden = !empty;
    $("empty").replaceChildren(...(empty ? [this.sheet(missing)] : []));
    const notices = [];
    if (connected && servicesKnown && !empty && !player) {
      notices.push(...missing.map((one) => this.notice(`${one.name} is missing.`, consequence(one.name), one.start)));
      notices.push(...stuck.map((name) => this.notice(`${name} is silent.`, "It is connected but sends nothing: it hangs, is stopped, or gets no processor time.", "")));
      if (silent && !this.store.paused && !missing.length && !stuck.length) {
        notices.push(this.notice("No scan for a while.", "The simulation is paused, or its source has stopped.", ""));
      }
    }
    $("notices").replaceChildren(...notices);
  }

  /** The text in place of the map before there is a world. */
  sheet(missing) {
    const nothingRuns = missing.some((one) => one.name === "simulator");
    return h("div", { class: "sheet" },
      h("h2", {}, nothingRuns ? "Nothing is running yet" : "Waiting for the world"),
      h("p", {}, nothingRuns ? "The page works, but no robot is running. Start everything at once, in a terminal beside this one:"
        : this.store.simulated ? "The simulator is running but has not sent its world yet." : "The estimator has not sent its map yet."),
      ...(nothingRuns ? [this.start("presage up")] : []),
      ...(missing.length ? [h("p", { class: "or" }, nothingRuns ? "or one by one:" : "Also missing:")] : []),
      ...missing.map((one) => h("div", {}, this.start(one.start))),
      ...(nothingRuns && this.store.control ? [h("p", { class: "or" }, "To look at a recording, none of them is needed: use Open, below.")] : []));
  }

  notice(title, text, command) {
    return h("div", { class: "notice" }, icon("s-triangle"), h("div", {}, h("b", {}, title), ` ${text}`, command ? this.start(command) : null));
  }

  start(command) {
    const copy = async () => {
      try {
        await navigator.clipboard.writeText(command);
        this.toast("Copied");
      } catch {
        this.toast("The browser does not allow copying; select the text instead", false);
      }
    };
    return h("div", { class: "start" }, h("code", {}, command), h("button", { class: "icon", type: "button", title: "Copy", "aria-label": `Copy: ${command}`, onclick: copy }, icon("i-copy")));
  }
}

const consequence = (name) => ({
  simulator: "There are no scans.", estimator: "The robot's pose is not estimated.", controller: "The robot does not drive.",
  router: "The services do not find one another.",
}[name] ?? "");

function cells(rate) {
  const hz = (value) => (value ? value.toFixed(value < 9.95 ? 1 : 0) : "–");
  const count = (value) => h("td", { class: value ? "some" : "" }, value ? String(value) : "–");
  return [
    h("td", { title: "messages a second" }, hz(rate.published_hz)), h("td", { title: "messages a second" }, hz(rate.received_hz)),
    h("td", {}, rate.dropped ? String(rate.dropped) : "–"), count(rate.undecodable),
  ];
}
