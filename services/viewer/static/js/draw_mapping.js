// Draws the path along the key scans of the mapper, and the loop closures between them.

function drawLines(ctx, camera, lines) {
  ctx.beginPath();
  for (const points of lines) points.forEach(([x, y], i) => ctx[i ? "lineTo" : "moveTo"](...camera.toScreen(x, y)));
  ctx.stroke();
}

export function drawMapping(ctx, camera, { path, closures }, colours) {
  ctx.lineJoin = "round";
  ctx.strokeStyle = colours["ink-3"];
  ctx.lineWidth = 1;
  drawLines(ctx, camera, [path]);
  ctx.strokeStyle = colours.hypothesis;
  ctx.globalAlpha *= 0.25; // a long drive has hundreds of them
  drawLines(ctx, camera, closures);
  ctx.globalAlpha /= 0.25;
}
