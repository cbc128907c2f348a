// Converts between metres and pixels; pans, zooms, fits, follows.

const MIN = 0.02, MAX = 2000; // pixels per metre

export class Camera {
  constructor() {
    this.width = this.height = 1;
    this.x = this.y = 0; // m, at the centre of the view
    this.scale = 40;
    this.padding = { left: 24, right: 24, top: 24, bottom: 24 };
    this.fitted = null; // bounds that stay in view until the visitor moves the view
    this.follow = false;
  }

  toScreen(x, y) {
    return [(x - this.x) * this.scale + this.width / 2, this.height / 2 - (y - this.y) * this.scale];
  }

  toWorld(px, py) {
    return [(px - this.width / 2) / this.scale + this.x, (this.height / 2 - py) / this.scale + this.y];
  }

  resize(width, height) {
    this.width = width;
    this.height = height;
    if (this.fitted) this.fit(this.fitted);
  }

  /** Shows the whole rectangle x0, y0, x1, y1, beside the controls that cover parts of the map. */
  fit(bounds) {
    const [x0, y0, x1, y1] = bounds;
    const { left, right, top, bottom } = this.padding;
    const width = Math.max(80, this.width - left - right), height = Math.max(60, this.height - top - bottom);
    this.scale = clamp(Math.min(width / Math.max(x1 - x0, 0.1), height / Math.max(y1 - y0, 0.1)));
    this.x = (x0 + x1) / 2 + (right - left) / 2 / this.scale;
    this.y = (y0 + y1) / 2 + (top - bottom) / 2 / this.scale;
    this.fitted = bounds;
    this.follow = false;
  }

  /** Zooms; the point under the pointer stays where it is. */
  zoomAt(px, py, factor) {
    const [x, y] = this.toWorld(px, py);
    this.scale = clamp(this.scale * factor);
    const [nx, ny] = this.toWorld(px, py);
    if (!this.follow) {
      this.x += x - nx;
      this.y += y - ny;
    }
    this.fitted = null;
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
    this.fitted = null;
    this.follow = false;
  }

  /** Moves a step towards the followed point; returns whether another step is needed. */
  approach(x, y, atOnce) {
    const share = atOnce ? 1 : 0.2;
    this.x += (x - this.x) * share;
    this.y += (y - this.y) * share;
    this.fitted = null;
    return Math.hypot(x - this.x, y - this.y) * this.scale > 0.5;
  }
}

const clamp = (scale) => Math.min(MAX, Math.max(MIN, scale));
