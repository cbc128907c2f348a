// Formats numbers for display.

/** A length in m or mm. */
export function metres(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size < 0.0995) return `${(value * 1000).toFixed(size < 0.00995 ? 1 : 0)} mm`;
  return `${value.toFixed(size < 9.995 ? 2 : 1)} m`;
}

/** An angle in rad as degrees. */
export function degrees(radians, digits = 0) {
  return `${((radians * 180) / Math.PI).toFixed(digits)}°`;
}

/** A probability in percent, rounded down so that only certainty is shown as 100 %. */
export function percent(probability) {
  const digits = probability < 0.99 ? 0 : 2, steps = 10 ** digits;
  return `${(Math.floor(probability * 100 * steps + 1e-9) / steps).toFixed(digits)} %`;
}

/** Seconds as minutes:seconds. */
export function clock(seconds) {
  const whole = Math.max(0, seconds);
  const minutes = Math.floor(whole / 60);
  return `${minutes}:${(whole - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

/** A duration in s, min or h, rounded down. */
export function span(seconds) {
  if (seconds < 100) return `${Math.floor(seconds)} s`;
  if (seconds < 6000) return `${Math.floor(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h`;
}

/** A size in B, kB or MB. */
export function bytes(count) {
  if (count < 1e3) return `${count} B`;
  return count < 1e6 ? `${(count / 1e3).toFixed(0)} kB` : `${(count / 1e6).toFixed(1)} MB`;
}

/** A number with fixed digits; a dash if there is none. */
export function number(value, digits) {
  return value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits).replace("-", "−");
}
