// Assembles the page: messages from the web socket update the store, and the views draw it.

import { Actions } from "./actions.js";
import { oncePerFrame } from "./canvas.js";
import { Connection } from "./connection.js";
import { $, h, storedSetting, setText } from "./dom.js";
import { Drive } from "./drive.js";
import { Floors } from "./floors.js";
import { startKeys } from "./keys.js";
import { MapView } from "./map.js";
import { Modes } from "./modes.js";
import { Panels } from "./panels.js";
import { Player } from "./player.js";
import { Pointer } from "./pointer.js";
import { Reasons } from "./reasons.js";
import { Services } from "./services.js";
import { Store } from "./store.js";
import { startTheme } from "./theme.js";
import { toast } from "./toasts.js";
import { Toolbar } from "./toolbar.js";

const DISCOVERY_TIME = 10_000; // ms after connecting, in which a robot that was shown before is shown again

const store = new Store();
const view = new MapView(store);
const floors = new Floors(store, view);
const panels = new Panels(store);
const reasons = new Reasons(store);
const services = new Services(store, toast);
const connection = new Connection({ message: take, frame: takeFrame, state: connectionChanged });
const actions = new Actions(store, connection, toast);
const modes = new Modes(store, view, actions);
new Pointer($("map"), view, modes);
const toolbar = new Toolbar(store, modes, actions);
const drive = new Drive(store, actions, () => modes.canControl);
const player = new Player(store, connection, toast);
const draw = oncePerFrame(() => panels.draw());
reasons.drawJournal();
let layout = storedSetting("layout"); // "wide" or "side"; null: by the shape of the world
let wanted = new URLSearchParams(location.search).get("robot"), wantedUntil = 0; // ms

startTheme(() => {
  view.invalidate();
  draw();
});
startKeys({ store, view, modes, actions, drive, player, toolbar });
$("robot").addEventListener("change", () => {
  wanted = $("robot").value;
  store.clear();
  actions.watch(wanted);
  redraw();
});
$("banner-retry").addEventListener("click", () => connection.retry());
$("layout").addEventListener("click", () => {
  layout = $("main").dataset.layout === "wide" ? "side" : "wide";
  storedSetting("layout", layout);
  arrange();
});
setInterval(() => {
  toolbar.draw();
  services.drawMissing();
  panels.drawBadges();
  panels.drawVitals();
  reasons.draw();
}, 500);

/** Handles a message of the server; unknown types, of a newer server, are ignored. */
function take(message) {
  const handler = {
    hello: takeHello, world: takeWorld, services: takeServices, history: takeHistory, player: takePlayer, closed: takeClosed,
    journal: takeJournal, field: takeField, map: takeMap,
  }[message.type];
  handler?.(message);
}

function takeHello(hello) {
  const first = !store.connected;
  const moved = store.hello && store.hello.robot !== hello.robot;
  if (moved) store.clear();
  if (first) wantedUntil = performance.now() + DISCOVERY_TIME; // a viewer that just started does not know all robots yet
  if (first) Object.assign(store, { player: null, servicesKnown: false });
  store.hello = hello;
  store.connected = true;
  const names = hello.robots.includes(hello.robot) || !hello.robot ? hello.robots : [hello.robot, ...hello.robots];
  $("robot").replaceChildren(...names.map((name) => h("option", { value: name }, name)));
  $("robot").value = hello.robot ?? "";
  $("robot").parentElement.hidden = names.length < 1;
  $("robot").disabled = names.length < 2;
  // A robot that was chosen here, or by a recording that was opened or closed.
  if (!wanted || (moved && !first) || performance.now() > wantedUntil) wanted = hello.robot;
  if (wanted !== hello.robot && names.includes(wanted)) actions.watch(wanted);
  $("joystick").hidden = !hello.control || !matchMedia("(pointer: coarse)").matches;
  view.rearrange();
  redraw();
}

/** The world of the simulator or of the recording, or the estimator's map. */
function takeWorld({ world: knownWorld, scanner, robot }) {
  const before = store.world, world = store.map?.world ?? knownWorld; // the mapper's map may have another frame
  Object.assign(store, { world, knownWorld, scanner, robot });
  floors.update();
  if (view.gesture.selected && !modes.selected) modes.select("");
  redraw(); // first, because the fit depends on the size of the tools
  if (!before || before.name !== world?.name || String(before.boundary) !== String(world?.boundary)) {
    arrange();
    view.fit();
  }
}

/** The mapper's map, which replaces the known world; a message without a world removes it. */
function takeMap(message) {
  const map = message.world ? message : null, changed = !map !== !store.map;
  if (!map && !changed) return;
  Object.assign(store, { map, world: map?.world ?? store.knownWorld });
  floors.update();
  if (changed || view.camera.fitted) view.fit();
  if (changed) redraw();
  view.invalidate();
}

function takeServices({ services: rows, missing }) {
  store.takeServices(rows, missing ?? []);
  actions.followRecorder();
  toolbar.draw();
  services.draw();
  draw();
}

function takeHistory({ samples }) {
  store.takeHistory(samples);
  draw();
}

function takeJournal({ rows }) {
  store.journal = rows;
  reasons.drawJournal();
}

function takeField(field) {
  store.field = field;
  view.invalidate();
}

function takeFrame(frame) {
  const before = store.frame;
  store.takeFrame(frame, performance.now());
  floors.follow();
  // Frames that arrive long after a pause or a step: another visitor has resumed the simulation.
  if (store.paused && before && frame.t > before.t && performance.now() - store.pausedAt > 1000) store.paused = false;
  const state = frame.belief?.state ?? frame.status?.state ?? "";
  const title = `${frame.robot}${state ? ` · ${state}` : ""} · presage`;
  if (document.title !== title) document.title = title;
  if (before?.status?.state !== frame.status?.state) reasons.draw();
  view.invalidate();
  draw();
}

function takePlayer(state) {
  const opened = !store.player;
  store.player = state;
  player.draw();
  if (opened) toolbar.draw();
}

function takeClosed({ reason }) {
  store.player = null;
  if (reason) toast(reason, false);
  redraw();
}

function connectionChanged(state, wait) {
  if (state === "waiting") {
    drive.stop();
    store.connected = false;
    store.player = null;
    setText($("banner-text"), `No connection to the viewer. Trying again ${wait < 1000 ? "now" : `in ${Math.round(wait / 1000)} s`}…`);
  } else if (!$("banner").hidden) toast("Connected again");
  $("banner").hidden = state === "open";
  document.body.dataset.connection = state;
  redraw();
}

function arrange() {
  const [x0, y0, x1, y1] = store.world ? view.bounds : [0, 0, 2, 1];
  $("main").dataset.layout = layout ?? ((x1 - x0) / (y1 - y0) > 1.9 ? "wide" : "side");
}

function redraw() {
  player.draw();
  toolbar.draw();
  services.draw();
  reasons.draw();
  reasons.drawJournal();
  view.invalidate();
  draw();
}

// For tests and for inspection in the browser's console.
window.presage = { store, view, connection, modes, actions };
