// Answers: done, or why not.

import { $, h, icon } from "./dom.js";

const MOST = 4;

/** Show some words for a while; longer where something was refused. */
export function toast(text, ok = true) {
  const box = $("toasts");
  const same = [...box.children].find((child) => child.dataset.text === text);
  if (same) same.remove();
  const item = h("div", { class: `toast ${ok ? "yes" : "no"}`, data: { text, ok: String(ok) } }, icon(ok ? "s-check" : "s-triangle"), h("span", {}, text));
  item.addEventListener("click", () => item.remove());
  box.append(item);
  while (box.children.length > MOST) box.firstChild.remove();
  setTimeout(() => item.remove(), ok ? 3500 : 8000);
}
