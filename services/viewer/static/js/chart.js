// Charts of the last minute; one cursor for all charts.

import { beginGrid, leftMargin, fitToScreen, tickLabel, ticks } from "./canvas.js";
import { palette } from "./theme.js";
import { WINDOW } from "./store.js";

const LEFT = 44, GAP = 6, RIGHT = 8, TOP = 6, BOTTOM = 17;

/** The time under the pointer, shared by all charts; null if it is over none. */
export const cursor = { t: null, changed: () => {} };

export class Chart {
  /** `series`: {key, tone, width?, fill?}. Options: `log`; `low` and `high`, which are always in view; `axis: false` hides the times. */
  constructor(canvas, store, series, options = {}) {
    Object.assign(this, { store, series, options, left: LEFT });
    this.surface = fitToScreen(canvas, () => this.draw());
    canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    canvas.addEventListener("pointerleave", () => this.point(null));
  }

  point(px) {
    const end = this.end();
    cursor.t = px === null || end === null ? null : end - WINDOW + ((px - this.left) / this.plotWidth()) * WINDOW;
    cursor.changed();
  }

  plotWidth() {
    return Math.max(10, this.surface.width - this.left - RIGHT);
  }

  end() {
    const times = this.store.history.t;
    return times.length ? times[times.length - 1] : null;
  }

  /** Lowest and highest value to show, with a margin; null if there are no values. */
  range() {
    let low = Infinity, high = -Infinity;
    for (const { key } of this.series) {
      for (const value of this.store.history[key]) {
        if (!Number.isFinite(value)) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    if (low > high) return null;
    const { log, low: least = Infinity, high: most = -Infinity } = this.options;
    low = Math.min(low, least);
    high = Math.max(high, most);
    if (log) return [least, 10 ** Math.ceil(Math.log10(Math.max(high, 10 * least)) - 1e-9)]; // smaller values are drawn at `low`
    const margin = Math.max((high - low) * 0.08, Math.abs(high) * 0.002, 1e-6);
    return [least === low ? low : low - margin, high + margin];
  }

  draw() {
    const { context: ctx, width, height } = this.surface;
    const colours = palette();
    ctx.clearRect(0, 0, width, height);
    const end = this.end(), range = this.range();
    const bottom = this.options.axis === false ? 4 : BOTTOM;
    const h = Math.max(4, height - TOP - bottom), lines = range ? this.gridLines(...range, h) : [];
    this.left = leftMargin(ctx, lines, colours, GAP, LEFT);
    const plot = { x: this.left, y: TOP, w: this.plotWidth(), h };
    if (end === null || range === null) {
      this.drawNothing(ctx, plot, colours);
      return;
    }
    const { log } = this.options;
    const [low, high] = log ? range.map(Math.log10) : range;
    const x = (t) => plot.x + (1 - (end - t) / WINDOW) * plot.w;
    const y = (value) => plot.y + plot.h * (1 - ((log ? Math.log10(Math.max(value, range[0])) : value) - low) / (high - low || 1));
    this.drawAxes(ctx, plot, lines, y, colours);
    ctx.save();
    ctx.beginPath();
    ctx.rect(plot.x, plot.y - 1, plot.w + 1, plot.h + 2);
    ctx.clip();
    this.drawEvents(ctx, plot, x, colours);
    for (const one of this.series) this.drawSeries(ctx, one, x, y, plot, colours);
    if (cursor.t !== null && cursor.t <= end) this.drawCursor(ctx, plot, x, y, colours);
    ctx.restore();
  }

  drawNothing(ctx, plot, colours) {
    ctx.strokeStyle = colours.line;
    ctx.lineWidth = 1;
    ctx.strokeRect(plot.x + 0.5, plot.y + 0.5, plot.w - 1, plot.h - 1);
    ctx.fillStyle = colours["ink-3"];
    ctx.font = `11.5px ${colours.sans}`;
    ctx.textAlign = "center";
    ctx.textBaseline = "middle";
    if (plot.h > 24) ctx.fillText(this.options.nothing ?? "nothing yet", plot.x + plot.w / 2, plot.y + plot.h / 2);
  }

  drawAxes(ctx, plot, lines, y, colours) {
    beginGrid(ctx, plot, lines, y, colours, GAP);
    ctx.stroke();
    if (this.options.axis === false) return;
    ctx.textBaseline = "alphabetic";
    for (const ago of plot.w > 200 ? [60, 45, 30, 15, 0] : [60, 30, 0]) {
      ctx.textAlign = ago === 60 ? "left" : ago === 0 ? "right" : "center";
      ctx.fillText(ago ? `−${ago} s` : "now", plot.x + (1 - ago / WINDOW) * plot.w, plot.y + plot.h + 13);
    }
  }

  gridLines(low, high, h) {
    if (!this.options.log) {
      const values = ticks(low, high, Math.max(2, Math.floor(h / 34)));
      const step = values.length > 1 ? values[1] - values[0] : Math.abs(values[0]) || 1;
      return values.map((value) => [value, tickLabel(value, step)]);
    }
    const lines = [];
    const every = Math.ceil((Math.log10(high / low) * 16) / Math.max(h, 1));
    for (let k = Math.round(Math.log10(low)); k <= Math.log10(high) + 1e-9; k += every) {
      lines.push([10 ** k, k >= 0 ? `${10 ** k} m` : k >= -2 ? `${10 ** (k + 2)} cm` : k >= -3 ? `${10 ** (k + 3)} mm` : "0.1 mm"]);
    }
    return lines;
  }

  drawEvents(ctx, plot, x, colours) {
    ctx.setLineDash([2, 3]);
    ctx.lineWidth = 1;
    for (const { t, state } of this.store.events) {
      ctx.strokeStyle = colours[{ tracking: "goal", localising: "measured", ambiguous: "warn" }[state] ?? "predicted"];
      const px = Math.round(x(t)) + 0.5;
      ctx.beginPath();
      ctx.moveTo(px, plot.y);
      ctx.lineTo(px, plot.y + plot.h);
      ctx.stroke();
    }
    ctx.setLineDash([]);
  }

  drawSeries(ctx, { key, tone, width = 1.2, fill = false }, x, y, plot, colours) {
    const { history } = this.store, values = history[key];
    const path = new Path2D(), area = new Path2D();
    let from = null, last = null;
    const close = () => {
      if (from === null) return;
      area.lineTo(last, plot.y + plot.h);
      area.lineTo(from, plot.y + plot.h);
      area.closePath();
      from = null;
    };
    for (let i = 0; i < values.length; i++) {
      const gap = i > 0 && history.t[i] - history.t[i - 1] > 1.5;
      if (!Number.isFinite(values[i]) || gap) close();
      if (!Number.isFinite(values[i])) continue;
      const px = x(history.t[i]), py = y(values[i]);
      path[from === null ? "moveTo" : "lineTo"](px, py);
      area[from === null ? "moveTo" : "lineTo"](px, py);
      from ??= px;
      last = px;
    }
    close();
    if (fill) {
      ctx.globalAlpha = 0.1;
      ctx.fillStyle = colours[tone];
      ctx.fill(area);
      ctx.globalAlpha = 1;
    }
    ctx.strokeStyle = colours[tone];
    ctx.lineWidth = width;
    ctx.lineJoin = "round";
    ctx.stroke(path);
  }

  drawCursor(ctx, plot, x, y, colours) {
    const px = Math.round(x(cursor.t)) + 0.5;
    ctx.strokeStyle = colours["ink-3"];
    ctx.lineWidth = 1;
    ctx.beginPath();
    ctx.moveTo(px, plot.y);
    ctx.lineTo(px, plot.y + plot.h);
    ctx.stroke();
    const i = indexAt(this.store.history.t, cursor.t);
    for (const { key, tone } of this.series) {
      const value = this.store.history[key][i];
      if (!Number.isFinite(value)) continue;
      ctx.fillStyle = colours[tone];
      ctx.beginPath();
      ctx.arc(x(this.store.history.t[i]), y(value), 3, 0, 2 * Math.PI);
      ctx.fill();
    }
  }
}

/** Index of the sample nearest to a time; -1 if there are no samples. */
export function indexAt(times, t) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1;
    else high = middle;
  }
  return low > 0 && t - times[low - 1] < times[low] - t ? low - 1 : high;
}
