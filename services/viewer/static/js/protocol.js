// A binary message: uint32 length of a JSON header, the header, then float32 arrays. All little-endian.

const FRAME_ARRAYS = ["ranges", "predicted", "sigma", "path", "motion", "obstacles", "people"];
const EMPTY = new Float32Array(0);

/** Returns the header's fields and the arrays by name; throws RangeError or SyntaxError if the message is invalid. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const message = { ...header };
  if (header.type === "frame") for (const name of FRAME_ARRAYS) message[name] = EMPTY; // an older server sends fewer
  for (const [name, [offset, count]] of Object.entries(header.arrays ?? {})) {
    message[name] = new Float32Array(buffer, 4 + length + 4 * offset, count);
  }
  return message;
}
