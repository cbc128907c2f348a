// Short messages: that a request was done, or why not.

import { $, h, icon } from "./dom.js";

const MAX_TOASTS = 4;

/** Shows a text for a while; longer if something was refused. */
export function toast(text, ok = true) {
  const box = $("toasts");
  const same = [...box.children].find((child) => child.dataset.text === text);
  if (same) same.remove();
  const item = h("div", { class: `toast ${ok ? "yes" : "no"}`, data: { text, ok: String(ok) } }, icon(ok ? "s-check" : "s-triangle"), h("span", {}, text));
  item.addEventListener("click", () => item.remove());
  box.append(item);
  while (box.children.length > MAX_TOASTS) box.firstChild.remove();
  setTimeout(() => item.remove(), ok ? 3500 : 8000);
}
