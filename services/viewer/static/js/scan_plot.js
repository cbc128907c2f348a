// Plot of the scan, range against angle: the measurement, and over it the prediction with its stated precision.

import { beginGrid, leftMargin, fitToScreen, tickLabel, ticks } from "./canvas.js";
import { niceAtLeast } from "./geometry.js";
import { palette } from "./theme.js";

const LEFT = 34, GAP = 5, RIGHT = 8, TOP = 6, BOTTOM = 17;
const DEGREE = Math.PI / 180;

export class ScanPlot {
  constructor(canvas, store) {
    this.store = store;
    this.top = 0; // m, end of the axis; it falls slowly so that it does not jump
    this.surface = fitToScreen(canvas, () => this.draw());
  }

  draw() {
    const { context: ctx, width, height } = this.surface;
    const colours = palette(), frame = this.store.frame;
    ctx.clearRect(0, 0, width, height);
    const plot = { x: LEFT, y: TOP, w: Math.max(10, width - LEFT - RIGHT), h: Math.max(10, height - TOP - BOTTOM) };
    if (!frame || frame.ranges.length < 2) {
      ctx.strokeStyle = colours.line;
      ctx.strokeRect(plot.x + 0.5, plot.y + 0.5, plot.w - 1, plot.h - 1);
      ctx.fillStyle = colours["ink-3"];
      ctx.font = `11.5px ${colours.sans}`;
      ctx.textAlign = "center";
      ctx.textBaseline = "middle";
      ctx.fillText("no scan yet", plot.x + plot.w / 2, plot.y + plot.h / 2);
      return;
    }
    const { angle_min: first, angle_increment: step } = frame.scan;
    const last = first + step * (frame.ranges.length - 1);
    this.fitTop(frame);
    const share = (angle) => (angle - Math.min(first, last)) / Math.max(Math.abs(last - first), 1e-9);
    const x = (i) => plot.x + share(first + step * i) * plot.w;
    const y = (range) => plot.y + plot.h * (1 - range / this.top);
    const lines = this.gridLines(plot.h);
    plot.x = leftMargin(ctx, lines, colours, GAP, LEFT);
    plot.w = Math.max(10, width - plot.x - RIGHT);
    this.drawAxes(ctx, plot, lines, Math.min(first, last), Math.max(first, last), y, colours);
    ctx.save();
    ctx.beginPath();
    ctx.rect(plot.x, plot.y, plot.w, plot.h);
    ctx.clip();
    if (frame.sigma.length === frame.predicted.length) drawBand(ctx, frame, x, y, colours);
    drawMeasured(ctx, frame, x, y, colours);
    drawPredicted(ctx, frame, x, y, colours);
    ctx.restore();
  }

  fitTop({ ranges, predicted }) {
    let far = 1;
    for (const array of [ranges, predicted]) for (const r of array) if (r > far && r < Infinity) far = r;
    const wanted = far * 1.06;
    this.top = wanted > this.top ? wanted : this.top + (wanted - this.top) * 0.06;
    if (this.top > 3 * wanted) this.top = niceAtLeast(wanted);
  }

  gridLines(h) {
    const values = ticks(0, this.top, Math.max(2, Math.floor(h / 36)));
    return values.map((value) => [value, tickLabel(value, values[1] - values[0]) + (value === 0 ? " m" : "")]);
  }

  drawAxes(ctx, plot, lines, first, last, y, colours) {
    beginGrid(ctx, plot, lines, y, colours, GAP);
    ctx.textBaseline = "alphabetic";
    const by = plot.w > 260 ? 45 : 90;
    for (let angle = Math.ceil(first / DEGREE / by - 1e-6) * by; angle <= last / DEGREE + 1e-6; angle += by) {
      const px = Math.round(plot.x + ((angle * DEGREE - first) / (last - first)) * plot.w) + 0.5;
      ctx.moveTo(px, plot.y);
      ctx.lineTo(px, plot.y + plot.h);
      const edge = px < plot.x + 12 ? "left" : px > plot.x + plot.w - 12 ? "right" : "center";
      ctx.textAlign = edge;
      ctx.fillText(`${angle < 0 ? "−" : ""}${Math.abs(angle)}°`, px, plot.y + plot.h + 13);
    }
    ctx.stroke();
  }
}

/** Draws the band of ± 2 standard deviations, with gaps where nothing is predicted. */
function drawBand(ctx, { predicted, sigma }, x, y, colours) {
  const band = new Path2D();
  let from = 0;
  const close = (until) => {
    if (until - from < 2) return;
    for (let i = from; i < until; i++) band[i === from ? "moveTo" : "lineTo"](x(i), y(predicted[i] + 2 * sigma[i]));
    for (let i = until - 1; i >= from; i--) band.lineTo(x(i), y(Math.max(0, predicted[i] - 2 * sigma[i])));
    band.closePath();
  };
  for (let i = 0; i <= predicted.length; i++) {
    if (i < predicted.length && Number.isFinite(predicted[i])) continue;
    close(i);
    from = i + 1;
  }
  ctx.fillStyle = colours.predicted;
  ctx.globalAlpha = 0.24;
  ctx.fill(band);
  ctx.globalAlpha = 1;
}

function drawMeasured(ctx, { ranges }, x, y, colours) {
  ctx.fillStyle = colours.measured;
  ctx.beginPath();
  for (let i = 0; i < ranges.length; i++) {
    if (Number.isFinite(ranges[i]) && ranges[i] > 0) ctx.rect(x(i) - 1.2, y(ranges[i]) - 1.2, 2.4, 2.4);
  }
  ctx.fill();
}

function drawPredicted(ctx, { predicted }, x, y, colours) {
  ctx.strokeStyle = colours.predicted;
  ctx.lineWidth = 1.4;
  ctx.lineJoin = "round";
  ctx.beginPath();
  let open = false;
  for (let i = 0; i < predicted.length; i++) {
    const seen = Number.isFinite(predicted[i]);
    if (seen) ctx[open ? "lineTo" : "moveTo"](x(i), y(predicted[i]));
    open = seen;
  }
  ctx.stroke();
}
