// Mouse, pen and touch on the map. What a click or drag does depends on the mode (modes.js).

const MAX_CLICK_DISTANCE = 6; // px; a pointer that moves farther drags
const MIN_FINGER_DISTANCE = 20; // px, so that fingers close together do not zoom abruptly
const ZOOM_PER_PIXEL = 0.0016; // of the wheel
const PIXELS_PER_LINE = 16; // some browsers report the wheel in lines
const PINCH_FACTOR = 4; // browsers report a pinch on a touchpad as small turns of the wheel with Ctrl

/** `mode` has begin(point), drag(point, start), end(point, start, clicked), cancel() and hover(point). */
export class Pointer {
  constructor(canvas, view, mode) {
    Object.assign(this, { canvas, view, mode });
    this.pressed = new Map(); // last point of each pressed pointer by id
    this.start = null; // point at which the mode's gesture began
    this.dragged = false; // whether the gesture is a drag, not a click
    this.panning = false;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.release(event, true));
    canvas.addEventListener("pointerleave", () => { if (!this.pressed.size) mode.hover(null); });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  /** The point of an event in px on the canvas and in m in the map. */
  pointOf(event) {
    const box = this.canvas.getBoundingClientRect();
    const px = event.clientX - box.left, py = event.clientY - box.top;
    const [x, y] = this.view.camera.toWorld(px, py);
    return { px, py, x, y, shift: event.shiftKey };
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const point = this.pointOf(event);
    this.pressed.set(event.pointerId, point);
    const panButton = event.button === 1 || event.button === 2; // middle or right
    if (this.pressed.size > 1 || panButton) {
      if (this.start) this.mode.cancel();
      this.start = null;
      this.panning = true;
    } else {
      this.start = point;
      this.panning = this.mode.begin(point) === "pan";
    }
  }

  move(event) {
    const point = this.pointOf(event), before = this.pressed.get(event.pointerId);
    if (!before) {
      this.canvas.style.cursor = this.mode.hover(point);
      return;
    }
    if (this.pressed.size > 1) this.pinch(event.pointerId, point);
    else if (this.panning) {
      this.canvas.style.cursor = "grabbing";
      this.view.camera.pan(point.px - before.px, point.py - before.py);
    } else if (this.start) {
      this.dragged ||= Math.hypot(point.px - this.start.px, point.py - this.start.py) > MAX_CLICK_DISTANCE;
      if (this.dragged) this.mode.drag(point, this.start);
    }
    this.pressed.set(event.pointerId, point);
    this.view.invalidate();
  }

  /** Two fingers: pans and zooms so that the world stays under them. */
  pinch(id, point) {
    const [otherId] = [...this.pressed.keys()].filter((key) => key !== id);
    const other = this.pressed.get(otherId), before = this.pressed.get(id);
    const distance = (a) => Math.max(MIN_FINGER_DISTANCE, Math.hypot(a.px - other.px, a.py - other.py));
    const { camera } = this.view;
    camera.pan((point.px - before.px) / 2, (point.py - before.py) / 2);
    camera.zoomAt((point.px + other.px) / 2, (point.py + other.py) / 2, distance(point) / distance(before));
  }

  release(event, cancelled = false) {
    const point = this.pointOf(event);
    if (!this.pressed.delete(event.pointerId)) return;
    if (this.pressed.size === 0) {
      if (this.start && !this.panning) {
        if (cancelled) this.mode.cancel();
        else this.mode.end(point, this.start, !this.dragged);
      }
      this.start = null;
      this.dragged = this.panning = false;
      this.canvas.style.cursor = this.mode.hover(point);
    }
    this.view.invalidate();
  }

  wheel(event) {
    event.preventDefault();
    const { px, py } = this.pointOf(event);
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? PIXELS_PER_LINE : 1);
    this.view.camera.zoomAt(px, py, Math.exp(-pixels * ZOOM_PER_PIXEL * (event.ctrlKey ? PINCH_FACTOR : 1)));
    this.view.invalidate();
  }
}
