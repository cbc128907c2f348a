// Draws the distance to the goal: a tint, darkest at the goal, and lines of equal distance.

const TINT = 0.3; // opacity at the goal
const MAX_LINES = 24;
const STEPS = [0.5, 1, 2, 5, 10, 20, 50]; // m between two lines

const pictures = new WeakMap(); // by field, so that each is computed once

/** {tint, minor, major}: a canvas with one pixel per cell, lowest row first, and lines in m. */
function pictureOf(field, colour) {
  let picture = pictures.get(field);
  if (picture?.colour !== colour) {
    picture = { colour, tint: tintOf(field, colour), ...(picture ?? linesOf(field)) };
    picture.colour = colour;
    pictures.set(field, picture);
  }
  return picture;
}

/** Draws the field, under everything that moves. */
export function drawField(ctx, camera, field, colours) {
  const { tint, minor, major } = pictureOf(field, colours.goal);
  const { origin, resolution, width, height } = field;
  const [px, py] = camera.toScreen(0, 0);
  ctx.save();
  ctx.transform(camera.scale, 0, 0, -camera.scale, px, py);
  ctx.imageSmoothingEnabled = true;
  const alpha = ctx.globalAlpha;
  ctx.drawImage(tint, origin.x, origin.y, width * resolution, height * resolution);
  ctx.strokeStyle = colours.goal;
  ctx.lineWidth = 1 / camera.scale;
  for (const [path, strength] of [[minor, 0.26], [major, 0.5]]) {
    ctx.globalAlpha = alpha * strength;
    ctx.stroke(path);
  }
  ctx.restore();
}

function farthest({ distance }) {
  let far = 0;
  for (const d of distance) if (d > far && d < Infinity) far = d;
  return far;
}

function tintOf(field, colour) {
  const { width, height, distance } = field, far = Math.max(farthest(field), 1);
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width, height });
  const ctx = canvas.getContext("2d");
  ctx.fillStyle = colour;
  ctx.fillRect(0, 0, width, height);
  const pixels = ctx.getImageData(0, 0, width, height);
  for (let i = 0; i < distance.length; i++) {
    pixels.data[4 * i + 3] = distance[i] < Infinity ? 255 * TINT * (0.1 + 0.9 * Math.exp((-3.2 * distance[i]) / far)) : 0;
  }
  ctx.putImageData(pixels, 0, 0);
  return canvas;
}

/** Lines of equal distance by marching squares between the centres of cells; every fifth line is major. */
function linesOf(field) {
  const far = farthest(field), step = STEPS.find((s) => far / s <= MAX_LINES) ?? far / MAX_LINES;
  const minor = new Path2D(), major = new Path2D();
  const { width, height, distance, origin, resolution } = field;
  const at = (column, row) => [origin.x + (column + 0.5) * resolution, origin.y + (row + 0.5) * resolution];
  for (let row = 0; row + 1 < height; row++) {
    for (let column = 0; column + 1 < width; column++) {
      const i = row * width + column;
      const corners = [distance[i], distance[i + 1], distance[i + width + 1], distance[i + width]];
      const low = Math.min(...corners), high = Math.max(...corners);
      if (!(high < Infinity)) continue;
      for (let k = Math.max(1, Math.ceil(low / step)); k * step < high; k++) {
        cross(k % 5 ? minor : major, corners, k * step, column, row, at);
      }
    }
  }
  return { minor, major };
}

const EDGES = [[0, 0, 1, 0], [1, 0, 1, 1], [1, 1, 0, 1], [0, 1, 0, 0]]; // of a square, corner to corner

/** Adds the segments of one line within one square. */
function cross(path, corners, level, column, row, at) {
  let open = false;
  EDGES.forEach(([ax, ay, bx, by], k) => {
    const a = corners[k], b = corners[(k + 1) % 4];
    if (a < level === b < level) return;
    const u = (level - a) / (b - a);
    path[open ? "lineTo" : "moveTo"](...at(column + ax + u * (bx - ax), row + ay + u * (by - ay)));
    open = !open;
  });
}
