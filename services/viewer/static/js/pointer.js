// Mouse, pen and touch on the map. What a click does depends on the mode (modes.js).

const MAX_CLICK_DISTANCE = 6; // px; a pointer that moves farther drags
const ZOOM_PER_PIXEL = 0.0016; // of the wheel

/** `mode` has begin(point), drag(point, start), end(point, start, clicked), cancel() and hover(point). */
export class Pointer {
  constructor(canvas, view, mode) {
    Object.assign(this, { canvas, view, mode });
    this.down = new Map(); // fingers and buttons by id
    this.start = null; // point at which the mode's gesture began
    this.panning = false;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.release(event, true));
    canvas.addEventListener("pointerleave", () => this.down.size || mode.hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    const px = event.clientX - box.left, py = event.clientY - box.top;
    const [x, y] = this.view.camera.toWorld(px, py);
    return { px, py, x, y, shift: event.shiftKey };
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const point = this.at(event);
    this.down.set(event.pointerId, point);
    if (this.down.size > 1 || event.button === 1 || event.button === 2) {
      if (this.start) this.mode.cancel();
      this.start = null;
      this.panning = true;
    } else {
      this.start = point;
      this.panning = this.mode.begin(point) === "pan";
    }
  }

  move(event) {
    const point = this.at(event), before = this.down.get(event.pointerId);
    if (!before) {
      this.canvas.style.cursor = this.mode.hover(point);
      return;
    }
    if (this.down.size > 1) this.pinch(event.pointerId, point);
    else if (this.panning) {
      this.canvas.style.cursor = "grabbing";
      this.view.camera.pan(point.px - before.px, point.py - before.py);
    } else if (this.start && this.isDrag(point)) this.mode.drag(point, this.start);
    this.down.set(event.pointerId, point);
    this.view.invalidate();
  }

  isDrag(point) {
    this.dragged ||= Math.hypot(point.px - this.start.px, point.py - this.start.py) > MAX_CLICK_DISTANCE;
    return this.dragged;
  }

  /** Two fingers: pans and zooms so that the world stays under them. */
  pinch(id, point) {
    const [otherId] = [...this.down.keys()].filter((key) => key !== id);
    const other = this.down.get(otherId), before = this.down.get(id);
    const span = (a) => Math.max(20, Math.hypot(a.px - other.px, a.py - other.py));
    const { camera } = this.view;
    camera.pan((point.px - before.px) / 2, (point.py - before.py) / 2);
    camera.zoomAt((point.px + other.px) / 2, (point.py + other.py) / 2, span(point) / span(before));
  }

  release(event, cancelled = false) {
    const point = this.at(event), start = this.start;
    if (!this.down.delete(event.pointerId)) return;
    if (start && !this.panning && this.down.size === 0) {
      if (cancelled) this.mode.cancel();
      else this.mode.end(point, start, !this.dragged);
    }
    if (this.down.size === 0) {
      this.start = null;
      this.dragged = this.panning = false;
      this.canvas.style.cursor = this.mode.hover(point);
    }
    this.view.invalidate();
  }

  wheel(event) {
    event.preventDefault();
    const { px, py } = this.at(event);
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.view.camera.zoomAt(px, py, Math.exp(-event.deltaY * lines * ZOOM_PER_PIXEL * (event.ctrlKey ? 4 : 1)));
    this.view.invalidate();
  }
}
