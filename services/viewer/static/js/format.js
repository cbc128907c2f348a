// Numbers as people read them.

/** Metres with a fitting prefix. */
export function metres(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size < 0.0995) return `${(value * 1000).toFixed(size < 0.00995 ? 1 : 0)} mm`;
  return `${value.toFixed(size < 9.995 ? 2 : 1)} m`;
}

/** rad as whole degrees. */
export function degrees(radians, digits = 0) {
  return `${((radians * 180) / Math.PI).toFixed(digits)}°`;
}

/** A probability in percent, rounded down so that only certainty is shown as 100 %. */
export function percent(probability) {
  const digits = probability < 0.99 ? 0 : 2, steps = 10 ** digits;
  return `${(Math.floor(probability * 100 * steps + 1e-9) / steps).toFixed(digits)} %`;
}

/** s as minutes and seconds. */
export function clock(seconds) {
  const whole = Math.max(0, seconds);
  const minutes = Math.floor(whole / 60);
  return `${minutes}:${(whole - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

/** s since a start, roughly. */
export function span(seconds) {
  if (seconds < 100) return `${Math.floor(seconds)} s`;
  if (seconds < 6000) return `${Math.floor(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h`;
}

/** Bytes with a fitting prefix. */
export function bytes(count) {
  if (count < 1e3) return `${count} B`;
  return count < 1e6 ? `${(count / 1e3).toFixed(0)} kB` : `${(count / 1e6).toFixed(1)} MB`;
}

/** A fixed number of digits, or a dash. */
export function number(value, digits) {
  return value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits).replace("-", "−");
}
