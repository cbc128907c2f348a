// Poses, ellipses and the shapes of obstacles: pure functions.

export const wrap = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/** The pose `b`, which is given in the frame of pose `a`, in the parent frame of `a`. */
export function compose(a, b) {
  const c = Math.cos(a.yaw), s = Math.sin(a.yaw);
  return { x: a.x + c * b.x - s * b.y, y: a.y + s * b.x + c * b.y, yaw: wrap(a.yaw + b.yaw) };
}

/** Semi-axes (m, 1 sigma) and direction of the position's ellipse, from the 9 numbers of a covariance of x, y, yaw. */
export function ellipse(cov) {
  const a = cov[0], b = (cov[1] + cov[3]) / 2, d = cov[4];
  const middle = (a + d) / 2, half = Math.hypot((a - d) / 2, b);
  return {
    major: Math.sqrt(Math.max(0, middle + half)),
    minor: Math.sqrt(Math.max(0, middle - half)),
    angle: 0.5 * Math.atan2(2 * b, a - d),
  };
}

/** The smallest of 1, 2, 5, 10, 20, … that is at least the value. */
export function niceAtLeast(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  for (const step of [1, 2, 5]) if (step * power >= value * (1 - 1e-9)) return step * power;
  return 10 * power;
}

/** Corners of a box or polygon; null for a circle. */
export function ring(obstacle) {
  if (obstacle.polygon) return obstacle.polygon;
  if (!obstacle.box) return null;
  const { center, size, yaw_deg: yaw = 0 } = obstacle.box;
  const pose = { x: center[0], y: center[1], yaw: (yaw * Math.PI) / 180 };
  return [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([sx, sy]) => {
    const corner = compose(pose, { x: (sx * size[0]) / 2, y: (sy * size[1]) / 2, yaw: 0 });
    return [corner.x, corner.y];
  });
}

/** The point about which an obstacle is turned. */
export function middle(obstacle) {
  if (obstacle.circle) return obstacle.circle.center;
  if (obstacle.box) return obstacle.box.center;
  const points = obstacle.polygon;
  return [0, 1].map((k) => points.reduce((sum, point) => sum + point[k], 0) / points.length);
}

/** Distance in m from a point to an obstacle; 0 inside. */
export function distance(obstacle, x, y) {
  if (obstacle.circle) {
    const [cx, cy] = obstacle.circle.center;
    return Math.max(0, Math.hypot(x - cx, y - cy) - obstacle.circle.radius);
  }
  const corners = ring(obstacle);
  if (inside(corners, x, y)) return 0;
  return Math.min(...corners.map((a, i) => toSegment(a, corners[(i + 1) % corners.length], x, y)));
}

/** Whether a point is in a polygon. */
export function inside(corners, x, y) {
  let found = false;
  for (let i = 0, j = corners.length - 1; i < corners.length; j = i++) {
    const [xi, yi] = corners[i], [xj, yj] = corners[j];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) found = !found;
  }
  return found;
}

function toSegment([ax, ay], [bx, by], x, y) {
  const dx = bx - ax, dy = by - ay;
  const u = Math.max(0, Math.min(1, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - ax - u * dx, y - ay - u * dy);
}

const round = (value) => Math.round(value * 1000) / 1000;

/** The obstacle, moved by dx, dy (m) and turned about its middle by `turn` (rad). */
export function moved(obstacle, dx, dy, turn = 0) {
  const shift = ([x, y]) => [round(x + dx), round(y + dy)];
  const { name } = obstacle;
  if (obstacle.circle) return { name, circle: { ...obstacle.circle, center: shift(obstacle.circle.center) } };
  if (obstacle.box) {
    const { box } = obstacle;
    return { name, box: { ...box, center: shift(box.center), yaw_deg: round((box.yaw_deg ?? 0) + (turn * 180) / Math.PI) } };
  }
  const [cx, cy] = middle(obstacle);
  const c = Math.cos(turn), s = Math.sin(turn);
  const turned = ([x, y]) => [cx + c * (x - cx) - s * (y - cy), cy + s * (x - cx) + c * (y - cy)];
  return { name, polygon: obstacle.polygon.map((point) => shift(turned(point))) };
}

/** Closed lines of a world's walls; with a ROS map, its edge. */
export function wallsOf(world) {
  return world.floors?.length && !world.grid ? world.floors.map((floor) => floor.boundary) : [world.boundary];
}

/** Bounding rectangle x0, y0, x1, y1 of points. */
export function boundsOf(points) {
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

/** The floor of a building on which a place (m in map) is; undefined between floors, and without any. */
export function floorAt(floors, { x, y }) {
  return floors.find(({ boundary }) => {
    const [x0, y0, x1, y1] = boundsOf(boundary);
    return x0 <= x && x <= x1 && y0 <= y && y <= y1;
  });
}

/** A place (m in map) for messages; on a floor, its name and the place in its frame. */
export function placeText(floors, { x, y }) {
  const floor = floorAt(floors, { x, y }), [dx, dy] = floor?.offset ?? [0, 0];
  const text = `(${[x - dx, y - dy].map((value) => value.toFixed(2)).join(", ")})`;
  return floor ? `${text} on floor '${floor.name}'` : text;
}
