// The binary frame: uint32 length of a JSON header, the header, then float32 arrays. All little-endian.

/** {header, ranges, predicted, sigma}; throws RangeError or SyntaxError where it is none. */
export function decodeFrame(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const base = 4 + length;
  const array = (name) => {
    const [offset, count] = header.arrays?.[name] ?? [0, 0];
    return new Float32Array(buffer, base + 4 * offset, count);
  };
  return { ...header, ranges: array("ranges"), predicted: array("predicted"), sigma: array("sigma") };
}
