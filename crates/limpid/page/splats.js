// The scene's bytes, whose layout crates/limpid/src/report/splats.rs describes.

const SPLATS_VERSION = 1;

/** All numbers of f16, by their bits. */
function halfTable() {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    table[bits] = exponent === 0 ? sign * fraction * 2 ** -24
      : exponent === 31 ? (fraction ? NaN : sign * Infinity)
      : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  }
  return table;
}

/**
 * Gaussians in rows, movers first: centres [N, 3] (of movers in the canonical frame), quaternions [N, 4] (w, x, y, z), scales [N, 3],
 * opacities [N], colours of degree 0 [N, 3] and of the others [N, K, 3] in 127ths of a factor [N]; motion bases [T, B, 9] and
 * weights [F, B].
 */
function readSplats(bytes) {
  const head = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 32 || String.fromCharCode(...bytes.subarray(0, 4)) !== "LMPD") throw new Error("The splats are damaged.");
  const [version, count, movers, bases, frames, degree] = [4, 8, 12, 16, 20, 24].map((at) => head.getUint32(at, true));
  if (version !== SPLATS_VERSION) throw new Error(`The splats are of version ${version}, and this page reads ${SPLATS_VERSION}.`);
  const others = (degree + 1) ** 2 - 1;
  if (bytes.length !== 32 + count * (36 + 3 * others) + frames * bases * 36 + movers * bases * 4 || movers > count) {
    throw new Error("The splats are not whole.");
  }
  let at = bytes.byteOffset + 32;
  const section = (type, length) => {
    const values = new type(bytes.buffer, at, length);
    at += values.byteLength;
    return values;
  };
  const centers = section(Float32Array, 3 * count);
  const shortQuats = section(Int16Array, 4 * count);
  const halves = section(Uint16Array, 8 * count);
  const basisFrames = section(Float32Array, frames * bases * 9);
  const logits = section(Float32Array, movers * bases);
  const otherColors = section(Int8Array, count * others * 3);

  const table = halfTable();
  const quats = Float32Array.from(shortQuats, (v) => v / 32767);
  const scales = new Float32Array(3 * count);
  const opacities = new Float32Array(count);
  const colors = new Float32Array(3 * count);
  const factors = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      scales[3 * i + k] = Math.exp(table[halves[8 * i + k]]);
      colors[3 * i + k] = table[halves[8 * i + 4 + k]];
    }
    opacities[i] = 1 / (1 + Math.exp(-table[halves[8 * i + 3]]));
    factors[i] = table[halves[8 * i + 7]];
  }
  return {
    count, movers, bases, frames, degree, centers, quats, scales, opacities, colors, factors, otherColors, basisFrames,
    weights: softmaxRows(logits, bases),
  };
}

/** Logits [F, B] as weights whose rows sum to 1. */
function softmaxRows(logits, width) {
  const weights = new Float32Array(logits.length);
  for (let from = 0; from < logits.length; from += width) {
    const row = logits.subarray(from, from + width);
    const largest = row.reduce((a, b) => Math.max(a, b), -Infinity);
    let total = 0;
    for (let b = 0; b < width; b++) total += Math.exp(row[b] - largest);
    for (let b = 0; b < width; b++) weights[from + b] = Math.exp(row[b] - largest) / total;
  }
  return weights;
}
