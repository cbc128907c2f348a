// Draws the planned path and motion, obstacles outside the map, and people.

const PERSON = 0.25; // m, a person's radius
const MARK = 3.4; // px, half the diagonal of a diamond

/** Calls `each(x, y)` for points x, y, x, y, … in m. */
function eachPoint(points, each) {
  for (let i = 0; i + 1 < points.length; i += 2) each(points[i], points[i + 1]);
}

function trace(ctx, camera, points, from) {
  ctx.beginPath();
  if (from) ctx.moveTo(...camera.toScreen(from.x, from.y));
  let begun = Boolean(from);
  eachPoint(points, (x, y) => {
    ctx[begun ? "lineTo" : "moveTo"](...camera.toScreen(x, y));
    begun = true;
  });
}

/** Draws the planned path, with an outline that separates it from what lies under it. */
export function drawPath(ctx, camera, path, colours) {
  trace(ctx, camera, path, null);
  ctx.lineJoin = ctx.lineCap = "round";
  ctx.strokeStyle = colours.free;
  ctx.lineWidth = 4.5;
  ctx.stroke();
  ctx.strokeStyle = colours.goal;
  ctx.lineWidth = 2.25;
  ctx.stroke();
}

/** Draws the predicted motion until the robot would stop; nothing if it stands. */
export function drawMotion(ctx, camera, motion, from, colours) {
  let far = 0;
  eachPoint(motion, (x, y) => { far = Math.max(far, Math.hypot(x - from.x, y - from.y)); });
  if (far < 0.03) return;
  trace(ctx, camera, motion, from);
  ctx.lineJoin = ctx.lineCap = "round";
  ctx.strokeStyle = colours.predicted;
  ctx.lineWidth = 6;
  ctx.globalAlpha *= 0.6;
  ctx.stroke();
  ctx.globalAlpha /= 0.6;
}

/** Draws obstacles that are not in the map as diamonds. */
export function drawUnmapped(ctx, camera, points, colours) {
  ctx.beginPath();
  eachPoint(points, (x, y) => {
    const [px, py] = camera.toScreen(x, y);
    ctx.moveTo(px, py - MARK);
    ctx.lineTo(px + MARK, py);
    ctx.lineTo(px, py + MARK);
    ctx.lineTo(px - MARK, py);
    ctx.closePath();
  });
  ctx.fillStyle = colours.unmapped;
  ctx.strokeStyle = colours["unmapped-line"];
  ctx.lineWidth = 1.6;
  ctx.lineJoin = "miter";
  ctx.stroke();
  ctx.fill(); // after the lines, so that diamonds that touch become one patch with a rim
}

/** Draws people at their true positions, which only a simulator knows. */
export function drawPeople(ctx, camera, people, colours) {
  const alpha = ctx.globalAlpha, r = PERSON * camera.scale;
  ctx.fillStyle = ctx.strokeStyle = colours.truth;
  ctx.lineWidth = 1.25;
  eachPoint(people, (x, y) => {
    const [px, py] = camera.toScreen(x, y);
    ctx.beginPath();
    ctx.arc(px, py, r, 0, 2 * Math.PI);
    ctx.globalAlpha = alpha * 0.1;
    ctx.fill();
    ctx.globalAlpha = alpha * 0.45;
    ctx.setLineDash([3, 3]);
    ctx.stroke();
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.arc(px, py, Math.max(1.5, r * 0.38), 0, 2 * Math.PI);
    ctx.fill();
  });
  ctx.globalAlpha = alpha;
}
