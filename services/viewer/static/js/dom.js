// Elements made by hand: text is always text, so nothing from the bus is ever read as HTML.

export const $ = (id) => document.getElementById(id);

/** An element; `on…` are listeners, `data` the data attributes, null and false leave an attribute out. */
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

/** An icon of index.html's sprite. */
export function icon(name, className = "") {
  const svg = document.createElementNS(SVG, "svg");
  if (className) svg.setAttribute("class", className);
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(SVG, "use");
  use.setAttribute("href", `#${name}`);
  svg.append(use);
  return svg;
}

/** Another icon in a button that has one. */
export function setIcon(button, name) {
  button.querySelector("use").setAttribute("href", `#${name}`);
}

/** Text only where it differs: the page is not laid out anew for nothing. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A setting of this browser; it may keep none. */
export function remembered(key, value) {
  try {
    if (value === undefined) return localStorage.getItem(`presage.${key}`);
    localStorage.setItem(`presage.${key}`, value);
  } catch { /* private mode */ }
  return value ?? null;
}

export const stillness = matchMedia("(prefers-reduced-motion: reduce)");
