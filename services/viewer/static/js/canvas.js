// Canvases at the resolution of the screen, and the axes of plots.

/** Gives the canvas the resolution of the screen; calls `resized` with each new size in CSS pixels. */
export function fitToScreen(canvas, resized) {
  const context = canvas.getContext("2d");
  const state = { context, width: 0, height: 0 };
  const fit = () => {
    const ratio = window.devicePixelRatio || 1;
    const { width, height } = canvas.getBoundingClientRect();
    const w = Math.max(1, Math.round(width * ratio)), h = Math.max(1, Math.round(height * ratio));
    if (canvas.width !== w || canvas.height !== h) {
      canvas.width = w;
      canvas.height = h;
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(state, { width, height });
    resized(state);
  };
  new ResizeObserver(fit).observe(canvas); // reports the first size too
  return state;
}

/** Returns a function that schedules `draw` for the next animation frame; repeated calls draw only once. */
export function oncePerFrame(draw) {
  let scheduled = false;
  return () => {
    if (scheduled) return;
    scheduled = true;
    requestAnimationFrame((now) => {
      scheduled = false;
      draw(now);
    });
  };
}

/** About `count` round tick values between two numbers. */
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count);
  if (!(raw > 0) || !Number.isFinite(raw)) return [];
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k++) values.push(k * step);
  return values;
}

/** Label of a tick, with no more digits than the step needs. */
export function tickLabel(value, step) {
  const digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9) + (Math.abs((step / 10 ** Math.floor(Math.log10(step))) - 2.5) < 1e-6 ? 1 : 0));
  return (Math.abs(value) < step * 1e-6 ? 0 : value).toFixed(Math.min(6, digits)).replace("-", "−");
}

const axisFont = (colours) => `10.5px ${colours.sans}`;

/** Width in px that the labels of a plot's grid lines, `[value, text]` each, and a `gap` need; at least `least`. */
export function leftMargin(ctx, lines, colours, gap, least) {
  ctx.font = axisFont(colours);
  return Math.max(least, ...lines.map(([, text]) => Math.ceil(ctx.measureText(text).width) + gap + 2));
}

/** Begins the path of a plot's grid with its horizontal lines, `[value, text]` each; `gap` px from text to plot. */
export function beginGrid(ctx, plot, lines, y, colours, gap) {
  ctx.strokeStyle = colours.line;
  ctx.fillStyle = colours["ink-3"];
  ctx.lineWidth = 1;
  ctx.font = axisFont(colours);
  ctx.textBaseline = "middle";
  ctx.textAlign = "right";
  ctx.beginPath();
  for (const [value, text] of lines) {
    const py = Math.round(y(value)) + 0.5;
    ctx.moveTo(plot.x, py);
    ctx.lineTo(plot.x + plot.w, py);
    ctx.fillText(text, plot.x - gap, py);
  }
}
