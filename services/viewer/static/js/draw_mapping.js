// What the mapper has done: the path along its key scans, and the loop closures between them.

function lines(ctx, camera, each) {
  ctx.beginPath();
  for (const points of each) points.forEach(([x, y], i) => ctx[i ? "lineTo" : "moveTo"](...camera.toScreen(x, y)));
  ctx.stroke();
}

export function drawMapping(ctx, camera, { path, closures }, colours) {
  ctx.lineJoin = "round";
  ctx.strokeStyle = colours["ink-3"];
  ctx.lineWidth = 1;
  lines(ctx, camera, [path]);
  ctx.strokeStyle = colours.hypothesis;
  ctx.globalAlpha *= 0.25; // a long drive has hundreds
  lines(ctx, camera, closures);
  ctx.globalAlpha /= 0.25;
}
