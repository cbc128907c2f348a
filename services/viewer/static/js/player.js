// Plays a recording: the list of recordings, and the bar with the position.

import { $, h, setIcon, setText } from "./dom.js";
import { bytes, clock } from "./format.js";

const SEEK_EVERY = 120; // ms between two seeks of a drag

export class Player {
  constructor(store, connection, toast) {
    Object.assign(this, { store, connection, toast });
    this.dragging = false;
    $("open").addEventListener("click", () => this.choose());
    $("player-play").addEventListener("click", () => this.toggle());
    $("player-step").addEventListener("click", () => this.request("step"));
    $("player-close").addEventListener("click", () => this.close());
    $("player-rate").addEventListener("change", () => this.request("rate", Number($("player-rate").value)));
    const bar = $("player-seek");
    bar.addEventListener("input", () => {
      this.dragging = true;
      setText($("player-time"), clock(bar.valueAsNumber));
      this.seek();
    });
    bar.addEventListener("change", () => {
      this.dragging = false;
      this.wanted = bar.valueAsNumber;
      this.seek();
    });
  }

  async request(action, value = 0) {
    const reply = await this.connection.request("player", { action, value });
    if (!reply.ok) this.toast(reply.reason, false);
    return reply;
  }

  /** Seeks to the position of the bar, one request at a time; the last position is always sent. */
  async seek() {
    this.wanted = $("player-seek").valueAsNumber;
    if (this.seeking) return;
    this.seeking = true;
    while (this.wanted !== null) {
      const value = this.wanted;
      this.wanted = null;
      await this.request("seek", value);
      await new Promise((resolve) => { setTimeout(resolve, SEEK_EVERY); });
    }
    this.seeking = false;
  }

  toggle() {
    return this.request(this.store.player?.paused ? "resume" : "pause");
  }

  async close() {
    const reply = await this.connection.request("close");
    if (!reply.ok) this.toast(reply.reason, false);
  }

  draw() {
    const { player } = this.store;
    $("player").hidden = !player;
    if (!player) return;
    const bar = $("player-seek");
    bar.max = String(player.duration_s);
    if (!this.dragging && !this.seeking) bar.value = String(player.position_s);
    if (!this.dragging) setText($("player-time"), clock(player.position_s));
    setText($("player-duration"), clock(player.duration_s));
    setText($("player-file"), player.file ?? "");
    $("player-file").title = player.file ?? "";
    setIcon($("player-play"), player.paused ? "i-play" : "i-pause");
    $("player-play").setAttribute("aria-label", player.paused ? "Play" : "Pause");
    const rate = String(player.rate);
    if (document.activeElement !== $("player-rate") && [...$("player-rate").options].some((option) => option.value === rate)) $("player-rate").value = rate;
    bar.setAttribute("aria-valuetext", `${clock(player.position_s)} of ${clock(player.duration_s)}`);
  }

  async choose() {
    const box = $("files");
    box.replaceChildren(h("p", {}, "Looking…"));
    $("recordings-dialog").showModal();
    const reply = await this.connection.request("recordings");
    const files = reply.files ?? [];
    if (!reply.ok) box.replaceChildren(h("p", {}, reply.reason));
    else if (!files.length) box.replaceChildren(h("p", {}, "There are no recordings yet. Record makes one."));
    else box.replaceChildren(...files.map((file) => this.row(file)));
    box.querySelector("button")?.focus();
  }

  row(file) {
    const open = async () => {
      $("recordings-dialog").close();
      this.toast(`Opening ${file.name}`, true);
      const reply = await this.connection.request("open", { name: file.name });
      if (!reply.ok) this.toast(reply.reason, false);
    };
    return h("button", { type: "button", onclick: open, data: { file: file.name } }, h("span", { class: "name" }, file.name),
      h("span", { class: "quiet" }, file.duration == null ? "" : clock(file.duration)), h("span", { class: "quiet" }, bytes(file.size ?? 0)));
  }
}
