// Draws the robot: believed pose, true pose, other hypotheses, and goal.

import { degrees, metres, percent } from "./format.js";
import { ellipse, niceAtLeast } from "./geometry.js";
import { label } from "./draw_world.js";

const MIN_ELLIPSE = 16; // px; a smaller 2 sigma ellipse is drawn enlarged, with the factor beside it

/** Draws the path of the last minute, older parts fainter. */
export function drawTrail(ctx, camera, path, colour, { dash = [], width = 2 } = {}) {
  const parts = 6, size = Math.ceil(path.length / parts);
  ctx.strokeStyle = colour;
  ctx.lineWidth = width;
  ctx.lineJoin = "round";
  ctx.setLineDash(dash);
  for (let k = 0; k < parts; k++) {
    const from = Math.max(0, k * size - 1), until = Math.min(path.length, (k + 1) * size);
    ctx.globalAlpha = 0.12 + (0.6 * (k + 1)) / parts;
    ctx.beginPath();
    let open = false;
    for (let i = from; i < until; i++) {
      const point = path[i];
      const [px, py] = point ? camera.toScreen(point[0], point[1]) : [0, 0];
      if (point) ctx[open && !point[2] ? "lineTo" : "moveTo"](px, py);
      open = point !== null;
    }
    ctx.stroke();
  }
  ctx.setLineDash([]);
  ctx.globalAlpha = 1;
}

/** Draws the round body with a wedge that points ahead, large enough to be seen at any zoom. */
export function drawBody(ctx, camera, pose, radius, { stroke, fill, dash = [], width = 2, alpha = 1 }) {
  const [px, py] = camera.toScreen(pose.x, pose.y);
  const r = Math.max(radius * camera.scale, 7);
  ctx.save();
  ctx.translate(px, py);
  ctx.rotate(-pose.yaw);
  ctx.globalAlpha = alpha;
  ctx.beginPath();
  ctx.arc(0, 0, r, 0, 2 * Math.PI);
  if (fill) {
    ctx.fillStyle = fill;
    ctx.globalAlpha = alpha * 0.2;
    ctx.fill();
    ctx.globalAlpha = alpha;
  }
  ctx.setLineDash(dash);
  ctx.lineWidth = width;
  ctx.strokeStyle = stroke;
  ctx.stroke();
  ctx.setLineDash([]);
  ctx.beginPath();
  ctx.moveTo(r * 0.92, 0);
  ctx.lineTo(r * 0.28, r * 0.4);
  ctx.lineTo(r * 0.28, -r * 0.4);
  ctx.closePath();
  if (fill) {
    ctx.fillStyle = stroke;
    ctx.fill();
  } else ctx.stroke();
  ctx.restore();
}

/** Draws the ellipse of two standard deviations of the position; returns the factor by which it is enlarged. */
export function drawCovariance(ctx, camera, pose, cov, colour, { enlarge = true, alpha = 1 } = {}) {
  const { major, minor, angle } = ellipse(cov);
  const size = 2 * major * camera.scale;
  const factor = enlarge && size > 0 && size < MIN_ELLIPSE ? niceAtLeast(MIN_ELLIPSE / size) : 1;
  const [px, py] = camera.toScreen(pose.x, pose.y);
  ctx.beginPath();
  ctx.ellipse(px, py, Math.max(size * factor, 0.5), Math.max(2 * minor * camera.scale * factor, 0.5), -angle, 0, 2 * Math.PI);
  ctx.fillStyle = ctx.strokeStyle = colour;
  ctx.globalAlpha = 0.16 * alpha;
  ctx.fill();
  ctx.globalAlpha = 0.9 * alpha;
  ctx.lineWidth = 1.25;
  ctx.setLineDash(factor > 1 ? [3, 2] : []);
  ctx.stroke();
  ctx.setLineDash([]);
  ctx.globalAlpha = 1;
  return factor;
}

/** Draws the believed pose, its ellipse and the text beside it. */
export function drawBelief(ctx, camera, frame, radius, colours) {
  const { belief } = frame;
  const vague = belief.state !== "tracking";
  drawBody(ctx, camera, belief, radius, { stroke: colours.predicted, fill: colours.predicted, dash: vague ? [5, 3] : [] });
  const factor = belief.cov ? drawCovariance(ctx, camera, belief, belief.cov, colours.predicted) : 1;
  const [px, py] = camera.toScreen(belief.x, belief.y);
  const gap = Math.max(radius * camera.scale, MIN_ELLIPSE) + 9;
  const left = px + gap + 160 > camera.width - camera.padding.right; // 160 px: the longest text
  const beside = (text, y, colour) => label(ctx, text, px + (left ? -gap : gap), y, colours, { align: left ? "right" : "left", colour, size: 10.5 });
  if (factor > 1) beside(`uncertainty enlarged ${factor}×`, py - 7, colours.predicted);
  if (frame.error > 0.1) beside(`${metres(frame.error)} from the true position`, py + 7, colours.ink);
}

/** Draws the true pose, and a line to the believed one if they differ. */
export function drawTruth(ctx, camera, frame, radius, colours) {
  const { truth, belief } = frame;
  if (belief && frame.error > radius) {
    ctx.beginPath();
    ctx.moveTo(...camera.toScreen(truth.x, truth.y));
    ctx.lineTo(...camera.toScreen(belief.x, belief.y));
    ctx.strokeStyle = colours.truth;
    ctx.globalAlpha = 0.45;
    ctx.lineWidth = 1;
    ctx.setLineDash([2, 4]);
    ctx.stroke();
    ctx.setLineDash([]);
    ctx.globalAlpha = 1;
  }
  drawBody(ctx, camera, truth, radius, { stroke: colours.truth, dash: [3, 3], width: 1.6 });
}

/** Draws all hypotheses, stronger with more weight. */
export function drawHypotheses(ctx, camera, frame, radius, colours) {
  const all = frame.belief.hypotheses ?? [];
  if (all.length < 2) return;
  for (const one of [...all].reverse()) {
    const alpha = 0.25 + 0.75 * Math.sqrt(one.weight);
    if (one.cov) drawCovariance(ctx, camera, one, one.cov, colours.hypothesis, { enlarge: false, alpha });
    drawBody(ctx, camera, one, radius, { stroke: colours.hypothesis, fill: colours.hypothesis, width: 1 + 2 * one.weight, alpha });
    const [px, py] = camera.toScreen(one.x, one.y);
    const above = py - Math.max(radius * camera.scale, 7) - 9;
    if (one.weight >= 0.01) label(ctx, `${Math.round(one.weight * 100)} %`, px, above, colours, { align: "center", colour: colours.hypothesis });
  }
}

/** Draws the goal with its tolerance and heading, and a straight line to it from `from`. */
export function drawGoal(ctx, camera, goal, from, colours, { planned = false } = {}) {
  const [px, py] = camera.toScreen(goal.x, goal.y);
  ctx.strokeStyle = ctx.fillStyle = colours.goal;
  if (from && !planned) {
    ctx.globalAlpha = 0.55;
    ctx.lineWidth = 1.25;
    ctx.setLineDash([2, 5]);
    ctx.beginPath();
    ctx.moveTo(...camera.toScreen(from.x, from.y));
    ctx.lineTo(px, py);
    ctx.stroke();
    ctx.setLineDash([]);
  }
  ctx.beginPath();
  ctx.arc(px, py, Math.max((goal.tolerance ?? 0) * camera.scale, 8), 0, 2 * Math.PI);
  ctx.globalAlpha = 0.14;
  ctx.fill();
  ctx.globalAlpha = 1;
  ctx.lineWidth = 1.75;
  ctx.setLineDash(planned ? [4, 3] : []);
  ctx.stroke();
  ctx.setLineDash([]);
  ctx.beginPath();
  ctx.arc(px, py, 2.5, 0, 2 * Math.PI);
  ctx.fill();
  if (planned ? Number.isFinite(goal.yaw) : goal.yaw_tolerance != null) drawHeading(ctx, px, py, goal.yaw, Math.max(0.45 * camera.scale, 24));
}

/** Draws an arrow from a point in pixels. */
export function drawHeading(ctx, px, py, yaw, length) {
  const tx = px + length * Math.cos(yaw), ty = py - length * Math.sin(yaw);
  ctx.lineWidth = 2;
  ctx.lineCap = "round";
  ctx.beginPath();
  ctx.moveTo(px, py);
  ctx.lineTo(tx, ty);
  for (const side of [2.6, -2.6]) {
    ctx.moveTo(tx, ty);
    ctx.lineTo(tx + 8 * Math.cos(yaw + side), ty - 8 * Math.sin(yaw + side));
  }
  ctx.stroke();
}

/** Describes a belief in a few words, after the probability that it is right. */
export function describeBelief(belief) {
  const probability = belief.probability != null ? [percent(belief.probability)] : [];
  const version = belief.field_version ? [`map v${belief.field_version}`] : [];
  return [...probability, describeState(belief), ...version].filter(Boolean).join(", ");
}

/** Explains the values of `describeBelief`. */
export function explainBelief(belief) {
  const lines = [belief.estimator];
  if (belief.probability != null) lines.push(`${percent(belief.probability)}: probability that the pose is within 0.2 m and 5° of the truth`);
  if (belief.protection) {
    const [x, y, yaw] = belief.protection;
    lines.push(`Errors exceed ${metres(x)} along the robot, ${metres(y)} across it or ${degrees(yaw, 1)} in one of 10 000 scans each`);
  }
  if (belief.field_version) lines.push(`Version ${belief.field_version} of the map, learned while driving`);
  return lines.filter(Boolean).join("\n");
}

function describeState(belief) {
  if (belief.state === "tracking" && belief.protection) {
    const [x, y, yaw] = belief.protection;
    return `≤ ${metres(Math.max(x, y))}, ≤ ${degrees(yaw, 1)}`;
  }
  if (belief.state === "tracking" && belief.cov) {
    return `± ${metres(2 * ellipse(belief.cov).major)}, ± ${degrees(2 * Math.sqrt(Math.max(0, belief.cov[8])), 1)}`;
  }
  const rivals = (belief.hypotheses ?? []).filter((one) => one.weight > 0.02).length;
  if (belief.state === "ambiguous") return rivals > 1 ? `${rivals} places match the scan` : "more than one place matches the scan";
  if (belief.state === "lost") return "the pose may be wrong";
  if (belief.state === "localising") return "no certain pose yet";
  return belief.estimator ?? "";
}
