// Draws what does not move: walls, furniture, grid and rulers.

import { drawFreeCells, drawOccupiedCells } from "./draw_grid.js";
import { boundsOf, middle, ring, wallsOf } from "./geometry.js";

/** Adds a closed path through points of the world. */
function trace(ctx, camera, points) {
  points.forEach(([x, y], i) => ctx[i ? "lineTo" : "moveTo"](...camera.toScreen(x, y)));
  ctx.closePath();
}

/** Draws the free floor with a grid in metres, clipped to the walls; calls `ready` when the cells of a ROS map are decoded. */
export function drawFloor(ctx, camera, world, colours, ready) {
  const step = [0.5, 1, 5, 10, 50].find((s) => s * camera.scale >= 26) ?? 100;
  ctx.save();
  ctx.beginPath();
  for (const walls of wallsOf(world)) trace(ctx, camera, walls);
  ctx.fillStyle = colours.free;
  if (!world.grid) ctx.fill();
  ctx.clip();
  if (world.grid) drawFreeCells(ctx, camera, world.grid, colours, ready);
  const [x0, y0, x1, y1] = boundsOf(world.boundary);
  ctx.beginPath();
  for (let x = Math.ceil(x0 / step) * step; x < x1; x += step) line(ctx, camera.toScreen(x, y0), camera.toScreen(x, y1));
  for (let y = Math.ceil(y0 / step) * step; y < y1; y += step) line(ctx, camera.toScreen(x0, y), camera.toScreen(x1, y));
  ctx.strokeStyle = colours.grid;
  ctx.lineWidth = 1;
  ctx.stroke();
  ctx.restore();
}

function line(ctx, [ax, ay], [bx, by]) {
  ctx.moveTo(Math.round(ax) + 0.5, Math.round(ay) + 0.5);
  ctx.lineTo(Math.round(bx) + 0.5, Math.round(by) + 0.5);
}

/** Draws walls and obstacles; `ghost` replaces the obstacle of the same name while it is dragged. */
export function drawWalls(ctx, camera, world, colours, { selected, hovered, ghost }, ready) {
  if (world.grid) drawOccupiedCells(ctx, camera, world.grid, colours, ready);
  for (const obstacle of world.obstacles) {
    drawObstacle(ctx, camera, ghost?.name && ghost.name === obstacle.name ? ghost : obstacle, colours, {
      selected: selected === obstacle.name && selected !== "",
      hovered: hovered === obstacle.name && hovered !== "",
    });
  }
  if (world.grid) return; // the edge of a ROS map is not a wall
  ctx.beginPath();
  for (const walls of wallsOf(world)) trace(ctx, camera, walls);
  ctx.strokeStyle = colours.wall;
  ctx.lineWidth = 3;
  ctx.lineJoin = "miter";
  ctx.stroke();
}

/** Writes the names of floors above them, and marks the lifts. */
export function drawFloors(ctx, camera, world, colours) {
  for (const { name, offset, boundary } of world.floors ?? []) {
    const [x0, , , y1] = boundsOf(boundary), [left, top] = camera.toScreen(x0, y1);
    label(ctx, name, left, top - 11, colours, { size: 12 });
    for (const lift of world.lifts ?? []) {
      if (!lift[name]) continue;
      const [px, py] = camera.toScreen(lift[name][0] + offset[0], lift[name][1] + offset[1]);
      ctx.strokeStyle = colours["ink-2"];
      ctx.lineWidth = 1.5;
      ctx.strokeRect(px - 8, py - 8, 16, 16);
      label(ctx, "lift", px, py + 16, colours, { align: "center" });
    }
  }
}

function outline(ctx, camera, obstacle) {
  ctx.beginPath();
  if (obstacle.circle) {
    const [px, py] = camera.toScreen(...obstacle.circle.center);
    ctx.arc(px, py, obstacle.circle.radius * camera.scale, 0, 2 * Math.PI);
  } else trace(ctx, camera, ring(obstacle));
}

function drawObstacle(ctx, camera, obstacle, colours, { selected, hovered }) {
  outline(ctx, camera, obstacle);
  ctx.fillStyle = colours.obstacle;
  ctx.fill();
  ctx.strokeStyle = selected || hovered ? colours.accent : colours["obstacle-line"];
  ctx.lineWidth = selected ? 2.5 : 1.25;
  ctx.stroke();
  if (!selected) return;
  const [px, py] = camera.toScreen(...middle(obstacle));
  label(ctx, obstacle.name, px, py, colours, { align: "center" });
}

/** Draws the outline of an obstacle that a click would add. */
export function drawPlan(ctx, camera, obstacle, colours) {
  outline(ctx, camera, obstacle);
  ctx.setLineDash([4, 3]);
  ctx.strokeStyle = colours.accent;
  ctx.lineWidth = 1.5;
  ctx.stroke();
  ctx.setLineDash([]);
}

/** Draws rulers in metres along the left and the lower wall. */
export function drawRulers(ctx, camera, world, colours) {
  const [x0, y0, x1, y1] = boundsOf(world.boundary);
  const step = [1, 2, 5, 10, 20, 50].find((s) => s * camera.scale >= 56) ?? 100;
  ctx.fillStyle = colours["ink-3"];
  ctx.font = `10.5px ${colours.sans}`;
  ctx.textAlign = "center";
  ctx.textBaseline = "top";
  const bottom = Math.min(camera.toScreen(x0, y0)[1] + 6, camera.height - 16);
  for (let x = Math.ceil(x0 / step) * step; x <= x1 + 1e-9; x += step) ctx.fillText(`${x}`, camera.toScreen(x, y0)[0], bottom);
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  const edge = camera.toScreen(x0, y0)[0] - 7;
  for (let y = Math.ceil(y0 / step) * step; y <= y1 + 1e-9; y += step) {
    const text = y === 0 && x0 === 0 ? "0 m" : `${y}`;
    ctx.fillText(text, Math.max(edge, ctx.measureText(text).width + 4), camera.toScreen(x0, y)[1]);
  }
}

/** Writes a small text with an outline, so that it is readable over anything. */
export function label(ctx, text, x, y, colours, { align = "left", colour = colours.ink, size = 11 } = {}) {
  ctx.font = `550 ${size}px ${colours.sans}`;
  ctx.textAlign = align;
  ctx.textBaseline = "middle";
  ctx.lineJoin = "round";
  ctx.lineWidth = 3.5;
  ctx.strokeStyle = colours.free;
  ctx.strokeText(text, x, y);
  ctx.fillStyle = colour;
  ctx.fillText(text, x, y);
}
