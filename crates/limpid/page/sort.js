// The order in which Gaussians are drawn: from far to near, by where they are now.

const BUCKETS = 65536;
/** As the renderer's: fainter ones are not drawn. */
const MIN_ALPHA = 1 / 255;

/** Sorts by counting, over the bits of the depths: for positive numbers they are in the numbers' order, finer near the camera. */
class Sorter {
  constructor(count) {
    this.depths = new Float32Array(count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.rows = new Uint32Array(count);
    this.keys = new Uint16Array(count);
    this.starts = new Uint32Array(BUCKETS);
    /** Rows from far to near, as many as `sort` says. */
    this.order = new Uint32Array(count);
  }

  /**
   * Sorts those of the rows `from` to `to` that lie beyond the near plane. `pose` are the rows [R | t] of the camera. At equal depth
   * the lower row lies in front, as in the renderer.
   */
  sort({ centers, opacities }, pose, near, from, to) {
    const { depths, bits, rows, keys, starts, order } = this;
    const [a, b, c, d] = pose.slice(8);
    let count = 0, least = Infinity, most = 0;
    for (let i = from, at = 3 * from; i < to; i++, at += 3) {
      const depth = a * centers[at] + b * centers[at + 1] + c * centers[at + 2] + d;
      if (depth > near && depth < Infinity && opacities[i] >= MIN_ALPHA) {
        depths[count] = depth;
        rows[count++] = i;
        if (depth < least) least = depth;
        if (depth > most) most = depth;
      }
    }
    if (count === 0) return 0;
    const [low, high] = new Uint32Array(new Float32Array([least, most]).buffer);
    let shift = 0;
    while ((high - low) >>> shift >= BUCKETS) shift++;
    starts.fill(0);
    for (let k = 0; k < count; k++) {
      const key = (bits[k] - low) >>> shift;
      keys[k] = key;
      starts[key]++;
    }
    // The farthest begin.
    for (let key = (high - low) >>> shift, sum = 0; key >= 0; key--) {
      const size = starts[key];
      starts[key] = sum;
      sum += size;
    }
    for (let k = count - 1; k >= 0; k--) order[starts[keys[k]]++] = rows[k];
    return count;
  }
}
