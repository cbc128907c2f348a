// Draws the measured and the predicted scan, both from the believed pose.

import { compose } from "./geometry.js";

const LEVELS = 5; // of opacity of a predicted beam, by its stated precision
const MIN_SIGMA = 0.02, MAX_SIGMA = 0.6; // m, standard deviations drawn strongest and faintest

/** Pose of the scanner at the believed pose, or at the true one if there is no belief. */
export function scannerPose(frame) {
  const base = frame.belief ?? frame.truth;
  return base && frame.scan ? compose(base, frame.scan.mount) : null;
}

function rays(frame, pose) {
  const { angle_min: first, angle_increment: step } = frame.scan;
  return (i) => {
    const angle = pose.yaw + first + step * i;
    return [Math.cos(angle), Math.sin(angle)];
  };
}

/** Tints the area that the beams crossed. */
export function drawFan(ctx, camera, frame, pose, colours) {
  const ray = rays(frame, pose), far = frame.scan.range_max ?? 25;
  ctx.beginPath();
  ctx.moveTo(...camera.toScreen(pose.x, pose.y));
  for (let i = 0; i < frame.ranges.length; i++) {
    const r = frame.ranges[i] === Infinity ? far : Math.max(0, frame.ranges[i]);
    const [c, s] = ray(i);
    ctx.lineTo(...camera.toScreen(pose.x + r * c, pose.y + r * s));
  }
  ctx.closePath();
  ctx.fillStyle = colours.measured;
  ctx.globalAlpha = 0.055;
  ctx.fill();
  ctx.globalAlpha = 1;
}

/** Draws the measured ranges as points. */
export function drawMeasured(ctx, camera, frame, pose, colours) {
  const ray = rays(frame, pose), size = camera.scale > 50 ? 2.6 : 2;
  ctx.fillStyle = colours.measured;
  ctx.beginPath();
  for (let i = 0; i < frame.ranges.length; i++) {
    const r = frame.ranges[i];
    if (!Number.isFinite(r) || r <= 0) continue; // 0: not measured
    const [c, s] = ray(i);
    const [px, py] = camera.toScreen(pose.x + r * c, pose.y + r * s);
    ctx.rect(px - size / 2, py - size / 2, size, size);
  }
  ctx.fill();
}

const level = (sigma) => {
  const share = Math.log(sigma / MIN_SIGMA) / Math.log(MAX_SIGMA / MIN_SIGMA);
  return Math.round(Math.min(1, Math.max(0, share)) * (LEVELS - 1));
};

/** Draws the predicted ranges as a line, fainter where less certain, with a band of ± 2 standard deviations. */
export function drawPredicted(ctx, camera, frame, pose, colours) {
  const ray = rays(frame, pose), { predicted, sigma } = frame;
  const stated = sigma.length === predicted.length;
  const bands = Array.from({ length: LEVELS }, () => new Path2D());
  const lines = Array.from({ length: LEVELS }, () => new Path2D());
  let last = null;
  for (let i = 0; i < predicted.length; i++) {
    const r = predicted[i];
    if (!Number.isFinite(r)) {
      last = null;
      continue;
    }
    const [c, s] = ray(i), k = stated ? level(sigma[i]) : 0;
    const at = (range) => camera.toScreen(pose.x + range * c, pose.y + range * s);
    const here = at(r);
    if (stated) {
      bands[k].moveTo(...at(Math.max(0, r - 2 * sigma[i])));
      bands[k].lineTo(...at(r + 2 * sigma[i]));
    }
    const joined = last && Math.abs(r - last.r) < 0.12 + 0.06 * r;
    lines[k].moveTo(...(joined ? last.here : [here[0] - 0.6, here[1]]));
    lines[k].lineTo(...here);
    last = { r, here };
  }
  ctx.strokeStyle = colours.predicted;
  ctx.lineCap = "butt";
  for (let k = 0; k < LEVELS; k++) {
    const vague = k / (LEVELS - 1);
    ctx.globalAlpha = 0.24 - 0.15 * vague;
    ctx.lineWidth = 2.4;
    ctx.stroke(bands[k]);
    ctx.globalAlpha = 1 - 0.65 * vague;
    ctx.lineWidth = 3 - 1.6 * vague;
    ctx.stroke(lines[k]);
  }
  ctx.globalAlpha = 1;
}
