// Light or dark colours, or those of the system. The canvases read their colours from the style sheet.

import { $, storedSetting } from "./dom.js";

const NAMES = ["bg", "surface", "line", "line-strong", "ink", "ink-2", "ink-3", "measured", "predicted", "goal", "hypothesis",
  "warn", "truth", "outside", "free", "grid", "wall", "obstacle", "obstacle-line", "accent", "unmapped", "unmapped-line"];
const system = matchMedia("(prefers-color-scheme: dark)");
const CHOICES = ["system", "light", "dark"];
let current = null;

/** Colours by their names in the style sheet. */
export function palette() {
  if (!current) {
    const style = getComputedStyle(document.documentElement);
    current = Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
    current.sans = style.getPropertyValue("--sans").trim();
  }
  return current;
}

/** Applies the setting of the system or of the button; calls `changed` after each change. */
export function startTheme(changed) {
  let choice = CHOICES.includes(storedSetting("theme")) ? storedSetting("theme") : "system";
  const apply = () => {
    document.documentElement.toggleAttribute("data-dark", choice === "dark" || (choice === "system" && system.matches));
    $("theme").title = `Colours: ${choice}`;
    $("theme").setAttribute("aria-label", `Colours: ${choice}`);
    current = null;
    changed();
  };
  system.addEventListener("change", apply);
  $("theme").addEventListener("click", () => {
    choice = CHOICES[(CHOICES.indexOf(choice) + 1) % CHOICES.length];
    storedSetting("theme", choice);
    apply();
  });
  apply();
}
