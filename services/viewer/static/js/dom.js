// Creates DOM elements. Text is always set as text, so nothing from the bus is ever parsed as HTML.

export const $ = (id) => document.getElementById(id);

/** Creates an element; `on…` are listeners, `data` the data attributes; null and false leave an attribute out. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "data") Object.assign(element.dataset, value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** Creates an icon from the sprite in index.html. */
export function icon(name, className = "") {
  const svg = document.createElementNS(SVG, "svg");
  if (className) svg.setAttribute("class", className);
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(SVG, "use");
  use.setAttribute("href", `#${name}`);
  svg.append(use);
  return svg;
}

/** Replaces the icon of a button. */
export function setIcon(button, name) {
  button.querySelector("use").setAttribute("href", `#${name}`);
}

/** Sets a text only if it differs, to avoid needless layout. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Reads a setting of this browser, or stores it if there is a `value`; null if the browser stores none. */
export function storedSetting(key, value) {
  try {
    if (value === undefined) return localStorage.getItem(`presage.${key}`);
    localStorage.setItem(`presage.${key}`, value);
  } catch { /* private mode */ }
  return value ?? null;
}

export const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");
