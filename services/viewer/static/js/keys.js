// Keyboard shortcuts.

import { $, h } from "./dom.js";

const HELP = [
  ["click, drag", "set a goal, with a heading"], ["shift + click", "carry the robot there; the estimator is not informed"], ["right drag, two fingers", "move the view"],
  ["W A S D, arrows", "drive; Q and E sideways, shift faster"], ["space", "pause or resume"], [".", "go forward by one scan, while paused"],
  ["G C O V", "goal, carry, obstacle, look"], ["X", "cancel the goal"], ["L", "forget the believed pose and search the whole map"], ["R", "start or stop recording"],
  ["T", "show or hide the true pose"], ["F", "follow the robot"], ["+ − 0", "zoom in, zoom out, show the whole world or floor"],
  ["Del, [ ]", "remove or turn the selected obstacle"], ["Esc", "abort the drag, deselect"], ["?", "this help"],
];

export function startKeys({ store, view, modes, actions, drive, player, toolbar }) {
  const list = $("shortcuts");
  for (const [keys, text] of HELP) list.append(h("dt", {}, h("kbd", {}, keys)), h("dd", {}, text));
  const help = () => $("help-dialog").showModal();
  $("help-button").addEventListener("click", help);
  for (const dialog of document.querySelectorAll("dialog")) {
    dialog.querySelector("[data-close]").addEventListener("click", () => dialog.close());
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  }
  const ifAllowed = (run) => () => modes.canControl && run();
  const turn = (angle) => ifAllowed(() => modes.selected && !modes.selected.circle && actions.turnObstacle(modes.selected, angle));
  const remove = ifAllowed(() => modes.selected && actions.removeObstacle(modes.selected.name));
  const commands = {
    " ": () => (store.player ? player.toggle() : modes.canControl && toolbar.togglePause()),
    ".": () => (store.player ? player.request("step") : modes.canControl && toolbar.standing && actions.step()),
    g: () => modes.set("goal"), c: () => modes.set("carry"), o: () => modes.set("obstacle"), v: () => modes.set("look"),
    x: ifAllowed(() => actions.cancel()), l: ifAllowed(() => !store.map && actions.localise()), r: ifAllowed(() => actions.record(actions.recording ? "stop" : "start")),
    t: () => view.show("truth", !view.shown.truth), f: () => view.follow(!view.camera.follow),
    "+": () => view.zoom(1.35), "=": () => view.zoom(1.35), "-": () => view.zoom(1 / 1.35), "0": () => view.fit(),
    delete: remove, backspace: remove, "[": turn(Math.PI / 12), "]": turn(-Math.PI / 12),
    escape: () => { modes.cancel(); modes.select(""); }, "?": help,
  };
  addEventListener("keydown", (event) => {
    if (event.metaKey) drive.stop(); // on macOS, no key that is released while the command key is held is reported
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") || typing(event)) return;
    const command = commands[event.key.toLowerCase()];
    if (command && !event.repeat) command();
    if (command || (modes.canControl && drive.press(event))) event.preventDefault();
  });
  addEventListener("keyup", (event) => drive.release(event));
  for (const kind of ["click", "change"]) document.addEventListener(kind, backToMap);
}

/** Moves the focus back to the map after a mouse click, so that space pauses instead of pressing the button again. */
function backToMap({ type, target }) {
  if (type === "click" && !target.closest("button")) return;
  if (document.activeElement !== document.body && !document.activeElement.matches(":focus-visible")) $("map").focus({ preventScroll: true });
}

/** Whether the focused element handles the key itself. */
function typing({ target, key }) {
  if (!(target instanceof Element)) return false;
  if (target.matches("input:not([type=checkbox]), select, textarea")) return true;
  return target.matches("button, a, input, summary, .scroll") && (key === " " || key === "Enter" || (key.startsWith("Arrow") && target.matches(".scroll")));
}
