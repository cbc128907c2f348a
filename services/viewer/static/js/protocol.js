// A binary message: uint32 length of a JSON header, the header, then float32 arrays. All little-endian.

const OF_A_FRAME = ["ranges", "predicted", "sigma", "path", "motion", "obstacles", "people"];
const NOTHING = new Float32Array(0);

/** The header's fields and its arrays by name; throws RangeError or SyntaxError where it is none. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const message = { ...header };
  if (header.type === "frame") for (const name of OF_A_FRAME) message[name] = NOTHING; // an older server sends fewer
  for (const [name, [offset, count]] of Object.entries(header.arrays ?? {})) {
    message[name] = new Float32Array(buffer, 4 + length + 4 * offset, count);
  }
  return message;
}
