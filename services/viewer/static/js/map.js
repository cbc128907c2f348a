// The map view: draws the store through the camera, only when something has changed.

import { Camera } from "./camera.js";
import { oncePerFrame, fitToScreen } from "./canvas.js";
import { $, h, storedSetting, reducedMotion } from "./dom.js";
import * as robot from "./draw_belief.js";
import { drawMapping } from "./draw_mapping.js";
import * as scan from "./draw_scan.js";
import * as motion from "./draw_motion.js";
import * as ground from "./draw_world.js";
import { drawField } from "./draw_field.js";
import { boundsOf } from "./geometry.js";
import { palette } from "./theme.js";

const LAYERS = [
  { key: "measured", label: "measured scan", tone: "measured", mark: "dots" },
  { key: "predicted", label: "predicted scan", tone: "predicted", mark: "line" },
  { key: "belief", label: "believed pose, uncertainty", tone: "predicted", mark: "disc" },
  { key: "hypotheses", label: "other possible poses", tone: "hypothesis", mark: "disc" },
  { key: "truth", label: "true pose, people", tone: "truth", mark: "ring" },
  { key: "path", label: "path of the last minute", tone: "predicted", mark: "trail" },
  { key: "motion", label: "predicted motion", tone: "predicted", mark: "thick" },
  { key: "goal", label: "goal", tone: "goal", mark: "disc" },
  { key: "plan", label: "planned path", tone: "goal", mark: "plain" },
  { key: "field", label: "distance to the goal", tone: "goal", mark: "rings" },
  { key: "mapping", label: "key scans, loop closures", tone: "hypothesis", mark: "line" },
  { key: "unmapped", label: "obstacles not in the map", tone: "unmapped", mark: "diamond" },
];

const NARROW = 620, LOW = 340; // px; in a smaller map the legend would cover too much

export class MapView {
  constructor(store) {
    this.store = store;
    this.camera = new Camera();
    const initial = (key) => (key === "field" && innerWidth <= 760 ? "off" : "on"); // a phone's map is small
    this.shown = Object.fromEntries(LAYERS.map(({ key }) => [key, (storedSetting(`layer.${key}`) ?? initial(key)) === "on"]));
    this.floor = null; // of the building, to which the view is fitted; null for the whole world
    this.gesture = {}; // of the pointer: ghost, plan, goal, carry, hovered, selected
    this.invalidate = oncePerFrame(() => this.draw());
    this.surface = fitToScreen($("map"), ({ width, height }) => {
      const roomy = width >= NARROW && height >= LOW;
      if (roomy !== this.roomy) $("legend").open = this.roomy = roomy;
      this.arrange(width);
      this.camera.resize(width, height);
      this.invalidate();
    });
    this.buildLegend();
    this.buildZoom();
  }

  /** Sets the padding that the legend and the tools need; on a phone the tools are below the map. */
  arrange(width) {
    const stick = $("joystick").hidden ? 0 : 114;
    const floors = !$("floor").parentElement.hidden;
    const dock = Math.max(0, $("map").getBoundingClientRect().bottom - $("dock").getBoundingClientRect().top);
    this.camera.padding = width < NARROW
      ? { left: 26, right: 16, top: floors ? 108 : 56, bottom: 26 + dock + stick }
      : { left: $("legend").open ? $("legend").offsetWidth + 44 : 40, right: 64, top: floors ? 50 : 28, bottom: 24 + dock };
  }

  buildLegend() {
    $("legend").addEventListener("toggle", () => this.rearrange());
    for (const { key, label, tone, mark } of LAYERS) {
      const box = h("input", { type: "checkbox", onchange: () => this.show(key, box.checked) });
      box.checked = this.shown[key];
      const swatch = h("i", { data: { mark }, "aria-hidden": "true" });
      swatch.style.setProperty("--tone", `var(--${tone})`);
      $("legend").append(h("label", { data: { layer: key } }, box, swatch, h("span", {}, label)));
    }
  }

  /** Call it when the legend or the tools appear, disappear or change their size. */
  rearrange() {
    const { width, height } = this.surface;
    this.arrange(width);
    this.camera.resize(width, height);
    this.invalidate();
  }

  show(key, shown) {
    this.shown[key] = shown;
    storedSetting(`layer.${key}`, shown ? "on" : "off");
    const box = $("legend").querySelector(`[data-layer="${key}"] input`);
    box.checked = shown;
    this.invalidate();
  }

  buildZoom() {
    const { camera } = this;
    const zoom = (factor) => () => this.zoom(factor);
    $("zoom-in").addEventListener("click", zoom(1.35));
    $("zoom-out").addEventListener("click", zoom(1 / 1.35));
    $("fit").addEventListener("click", () => this.fit());
    $("follow").addEventListener("click", () => this.follow(!camera.follow));
  }

  zoom(factor) {
    this.camera.zoomAt(this.camera.width / 2, this.camera.height / 2, factor);
    this.invalidate();
  }

  fit() {
    this.arrange(this.surface.width);
    if (this.store.world) this.camera.fit(this.bounds);
    this.invalidate();
  }

  /** Bounds of the floor that is shown, or of the whole world. */
  get bounds() {
    return boundsOf((this.floor ?? this.store.world).boundary);
  }

  follow(on) {
    this.camera.follow = on;
    if (on && this.camera.scale < 60) this.camera.zoomAt(this.camera.width / 2, this.camera.height / 2, 60 / this.camera.scale);
    this.invalidate();
  }

  get radius() {
    return this.store.robot?.radius ?? 0.27;
  }

  draw() {
    const { context: ctx, width, height } = this.surface;
    const { store, camera, shown, gesture } = this;
    const colours = palette(), { world, frame } = store;
    if ($("follow").getAttribute("aria-pressed") !== String(camera.follow)) $("follow").setAttribute("aria-pressed", camera.follow);
    const centre = frame?.belief ?? frame?.truth;
    if (camera.follow && centre && camera.approach(centre.x, centre.y, reducedMotion.matches)) this.invalidate();
    ctx.fillStyle = colours.outside;
    ctx.fillRect(0, 0, width, height);
    ctx.globalAlpha = store.connected ? 1 : 0.45;
    if (world) {
      ground.drawFloor(ctx, camera, world, colours, () => this.invalidate());
      if (store.fieldOfGoal && shown.field) drawField(ctx, camera, store.fieldOfGoal, colours);
      ground.drawRulers(ctx, camera, world, colours);
    }
    const pose = frame ? scan.scannerPose(frame) : null;
    if (pose && shown.measured) scan.drawFan(ctx, camera, frame, pose, colours);
    if (world) ground.drawWalls(ctx, camera, world, colours, gesture, () => this.invalidate());
    if (world) ground.drawFloors(ctx, camera, world, colours);
    $("legend").querySelector("[data-layer=mapping]").hidden = !store.map;
    if (store.map && shown.mapping) drawMapping(ctx, camera, store.map, colours);
    if (frame) this.drawRobot(ctx, frame, pose, colours);
    this.drawGesture(ctx, colours);
    ctx.globalAlpha = 1;
  }

  drawRobot(ctx, frame, pose, colours) {
    const { store, camera, shown, radius } = this;
    if (shown.path) {
      if (shown.truth) robot.drawTrail(ctx, camera, store.trail.truth, colours.truth, { width: 1.25, dash: [4, 4] });
      robot.drawTrail(ctx, camera, store.trail.belief, colours.predicted);
    }
    if (pose && shown.predicted) scan.drawPredicted(ctx, camera, frame, pose, colours);
    if (pose && shown.measured) scan.drawMeasured(ctx, camera, frame, pose, colours);
    const goal = frame.status?.goal, planned = frame.path.length > 0;
    if (shown.plan && planned) motion.drawPath(ctx, camera, frame.path, colours);
    if (shown.goal && goal) robot.drawGoal(ctx, camera, goal, planned ? null : frame.belief ?? frame.truth, colours);
    if (shown.unmapped) motion.drawUnmapped(ctx, camera, frame.obstacles, colours);
    if (shown.truth) motion.drawPeople(ctx, camera, frame.people, colours);
    if (shown.motion && frame.belief) motion.drawMotion(ctx, camera, frame.motion, frame.belief, colours);
    if (frame.belief && shown.hypotheses) robot.drawHypotheses(ctx, camera, frame, radius, colours);
    if (frame.belief && shown.belief) robot.drawBelief(ctx, camera, frame, radius, colours);
    if (frame.truth && shown.truth) robot.drawTruth(ctx, camera, frame, radius, colours);
  }

  /** Draws what the current drag or click would do. */
  drawGesture(ctx, colours) {
    const { gesture, camera, radius } = this;
    if (gesture.goal) robot.drawGoal(ctx, camera, gesture.goal, null, colours, { planned: true });
    if (gesture.carry) robot.drawBody(ctx, camera, gesture.carry, radius, { stroke: colours.accent, fill: colours.accent, dash: [4, 3] });
    if (gesture.plan) ground.drawPlan(ctx, camera, gesture.plan, colours);
  }
}
