// The state of the page: the latest messages, and the history of the last minute.

export const WINDOW = 60; // s of history
const SERIES = ["free_energy", "accuracy", "complexity", "error", "speed"];
const JUMP = 0.4; // m between two frames, above which no line connects them: the robot was carried

const nan = (value) => (value === null || value === undefined ? NaN : value);

export class Store {
  constructor() {
    this.hello = null;
    this.connected = false;
    this.clear();
  }

  /** Forgets everything about the current robot. */
  clear() {
    this.world = this.knownWorld = this.scanner = this.robot = this.frame = this.field = null;
    this.map = null; // the mapper's: its world, the path of the key scans, loop closures
    this.journal = []; // {t, state, reason} of the controller, the oldest first
    this.stoppedAt = 0; // ms, when the present obstacle stop began
    this.services = [];
    this.missing = [];
    this.servicesKnown = false;
    this.simulated = true; // false once the scans come from a real robot, until a simulator starts
    this.player = null;
    this.paused = false;
    this.pausedAt = 0; // ms, time of the last pause or step
    this.arrivals = [];
    this.forget();
  }

  /** Forgets only the history. */
  forget() {
    this.history = Object.fromEntries(["t", ...SERIES].map((name) => [name, []]));
    this.trail = { t: [], belief: [], truth: [] };
    this.events = []; // {t, state}, changes of the estimator's state
  }

  get control() {
    return Boolean(this.hello?.control);
  }

  /** Services that are connected but send no health messages. */
  get stuck() {
    return this.services.filter((one) => one.state === "silent");
  }

  /** Rows of the running services and those that are missing; a real robot has neither a simulator nor misses one. */
  takeServices(services, missing) {
    Object.assign(this, { services, missing, servicesKnown: true });
    const among = (rows) => rows.some((one) => one.name === "simulator");
    if (among(services)) this.simulated = true;
    else if (!among(missing)) this.simulated = false;
  }

  /** The distance field of the current goal; null if there is none. */
  get fieldOfGoal() {
    const goal = this.frame?.status?.goal, { field } = this;
    const same = goal && field?.robot === this.frame.robot && Math.hypot(field.goal.x - goal.x, field.goal.y - goal.y) < 0.01;
    return same ? field : null;
  }

  /** Rate of frames in Hz; 0 if none has come for two seconds. */
  rate(now) {
    const times = this.arrivals;
    if (times.length < 2 || now - times[times.length - 1] > 2000) return 0;
    return ((times.length - 1) * 1000) / (times[times.length - 1] - times[0]);
  }

  takeHistory(samples) {
    this.forget();
    this.history.t = [...samples.t];
    for (const name of SERIES) this.history[name] = (samples[name] ?? []).map(nan);
  }

  takeFrame(frame, now) {
    const before = this.frame;
    if (before && frame.robot !== before.robot) this.forget();
    if (!before?.truth?.stopped) this.stoppedAt = now;
    if ([...this.missing, ...this.stuck].some((one) => one.name === "controller")) frame.status = null; // it is outdated
    this.frame = frame;
    this.arrivals.push(now);
    while (now - this.arrivals[0] > 4000) this.arrivals.shift();
    this.cut(frame.t);
    const { history } = this;
    history.t.push(frame.t);
    history.free_energy.push(nan(frame.belief?.free_energy));
    history.accuracy.push(nan(frame.belief?.accuracy));
    history.complexity.push(nan(frame.belief?.complexity));
    history.error.push(nan(frame.error));
    history.speed.push(nan(frame.speed ?? speedOf(frame.odom)));
    this.trail.t.push(frame.t);
    this.trail.belief.push(step(this.trail.belief, frame.belief));
    this.trail.truth.push(step(this.trail.truth, frame.truth));
    if (before?.belief && frame.belief && before.belief.state !== frame.belief.state) {
      this.events.push({ t: frame.t, state: frame.belief.state });
    }
    this.trim(frame.t - WINDOW);
  }

  /** Removes everything from time `t` on, in case time went back (a reset or a seek). */
  cut(t) {
    const times = this.history.t;
    if (times.length === 0 || times[times.length - 1] < t) return;
    const keep = times.findIndex((value) => value >= t);
    for (const values of Object.values(this.history)) values.length = keep;
    const keepTrail = this.trail.t.filter((value) => value < t).length;
    for (const values of Object.values(this.trail)) values.length = keepTrail;
    this.events = this.events.filter((event) => event.t < t);
  }

  trim(oldest) {
    const drop = this.history.t.findIndex((value) => value >= oldest);
    if (drop > 0) for (const values of Object.values(this.history)) values.splice(0, drop);
    const dropTrail = this.trail.t.findIndex((value) => value >= oldest);
    if (dropTrail > 0) for (const values of Object.values(this.trail)) values.splice(0, dropTrail);
    this.events = this.events.filter((event) => event.t >= oldest);
  }
}

/** The next point of a path: [x, y, whether it begins a new line]; null without a pose. */
function step(path, pose) {
  if (!pose) return null;
  const last = path[path.length - 1];
  return [pose.x, pose.y, !last || Math.hypot(pose.x - last[0], pose.y - last[1]) > JUMP];
}

const speedOf = (twist) => (twist && Number.isFinite(twist.vx) ? Math.hypot(twist.vx, twist.vy) : null);
