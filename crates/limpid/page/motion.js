// Where Gaussians are at a time: as crates/motion-bases has it, bases blended first, then made a rotation.

const MAX_ENTRY = 1e9;
const MIN_NORM = 1e-12;
const MIN_SINE = 1e-6;
const NEAR_Y_AXIS = 0.8;

/** Centres and covariances of all Gaussians, movers posed anew by `pose`. */
class Motion {
  constructor(scene) {
    this.scene = scene;
    /** [N, 3] */
    this.centers = scene.centers.slice();
    /** xx, xy, xz, yy, yz, zz: [N, 6] */
    this.covariances = new Float32Array(6 * scene.count);
    /** Rotation times scales of movers in the canonical frame, row-major, [F, 9] */
    this.axes = new Float32Array(9 * scene.movers);
    const axes = new Float32Array(9);
    for (let i = 0; i < scene.count; i++) {
      stretchedAxes(scene.quats, scene.scales, i, axes);
      if (i < scene.movers) this.axes.set(axes, 9 * i);
      covariance(axes, this.covariances, 6 * i);
    }
    this.now = new Float64Array(9 * scene.bases);
    /** Time of the last pose. */
    this.time = NaN;
  }

  /** Blends the bases of the frames beside a time, which is clamped to the video. */
  basesAt(time) {
    const { bases, frames, basisFrames } = this.scene;
    const clamped = clamp(time, 0, frames - 1);
    const floor = Math.floor(clamped);
    const part = clamped - floor;
    const next = Math.min(floor + 1, frames - 1);
    for (let k = 0; k < 9 * bases; k++) {
      const value = basisFrames[floor * bases * 9 + k] * (1 - part) + basisFrames[next * bases * 9 + k] * part;
      this.now[k] = k % 9 < 6 ? clamp(value, -MAX_ENTRY, MAX_ENTRY) : value;
    }
  }

  /** Poses the movers at a time in units of frames; whether anything changed. */
  pose(time) {
    const { scene, now, axes, centers, covariances } = this;
    if (time === this.time || scene.movers === 0) return false;
    this.time = time;
    this.basesAt(time);
    const { bases, weights } = scene;
    const rest = scene.centers;
    for (let i = 0; i < scene.movers; i++) {
      let a0 = 0, a1 = 0, a2 = 0, b0 = 0, b1 = 0, b2 = 0, t0 = 0, t1 = 0, t2 = 0;
      for (let b = 0, at = 0, w = i * bases; b < bases; b++, at += 9, w++) {
        const weight = weights[w];
        a0 += weight * now[at]; a1 += weight * now[at + 1]; a2 += weight * now[at + 2];
        b0 += weight * now[at + 3]; b1 += weight * now[at + 4]; b2 += weight * now[at + 5];
        t0 += weight * now[at + 6]; t1 += weight * now[at + 7]; t2 += weight * now[at + 8];
      }
      // Gram-Schmidt: x along a, z along x × b, y = z × x.
      let norm = a0 * a0 + a1 * a1 + a2 * a2;
      if (norm < MIN_NORM * MIN_NORM) { a0 = 1; a1 = 0; a2 = 0; norm = 1; }
      norm = 1 / Math.sqrt(norm);
      const x0 = a0 * norm, x1 = a1 * norm, x2 = a2 * norm;
      norm = 1 / Math.sqrt(Math.max(b0 * b0 + b1 * b1 + b2 * b2, MIN_NORM * MIN_NORM));
      b0 *= norm; b1 *= norm; b2 *= norm;
      let z0 = x1 * b2 - x2 * b1, z1 = x2 * b0 - x0 * b2, z2 = x0 * b1 - x1 * b0;
      if (z0 * z0 + z1 * z1 + z2 * z2 < MIN_SINE * MIN_SINE) {
        const near = x1 * x1 > NEAR_Y_AXIS;
        b1 = near ? 0 : 1; b2 = near ? 1 : 0;
        z0 = x1 * b2 - x2 * b1; z1 = -x0 * b2; z2 = x0 * b1;
      }
      norm = 1 / Math.sqrt(z0 * z0 + z1 * z1 + z2 * z2);
      z0 *= norm; z1 *= norm; z2 *= norm;
      const y0 = z1 * x2 - z2 * x1, y1 = z2 * x0 - z0 * x2, y2 = z0 * x1 - z1 * x0;

      const c = 3 * i, u = rest[c], v = rest[c + 1], w = rest[c + 2];
      centers[c] = x0 * u + y0 * v + z0 * w + t0;
      centers[c + 1] = x1 * u + y1 * v + z1 * w + t1;
      centers[c + 2] = x2 * u + y2 * v + z2 * w + t2;

      // The covariance of the axes, turned.
      let xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
      for (let k = 9 * i; k < 9 * i + 3; k++) {
        const p = axes[k], q = axes[k + 3], r = axes[k + 6];
        const e = x0 * p + y0 * q + z0 * r, f = x1 * p + y1 * q + z1 * r, g = x2 * p + y2 * q + z2 * r;
        xx += e * e; xy += e * f; xz += e * g; yy += f * f; yz += f * g; zz += g * g;
      }
      const to = 6 * i;
      covariances[to] = xx; covariances[to + 1] = xy; covariances[to + 2] = xz;
      covariances[to + 3] = yy; covariances[to + 4] = yz; covariances[to + 5] = zz;
    }
    return true;
  }
}

/** The matrix of a row's quaternion, its columns times the scales. */
function stretchedAxes(quats, scales, i, axes) {
  const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
  const [a, b, c] = scales.subarray(3 * i, 3 * i + 3);
  axes[0] = (1 - 2 * (y * y + z * z)) * a; axes[1] = 2 * (x * y - w * z) * b; axes[2] = 2 * (x * z + w * y) * c;
  axes[3] = 2 * (x * y + w * z) * a; axes[4] = (1 - 2 * (x * x + z * z)) * b; axes[5] = 2 * (y * z - w * x) * c;
  axes[6] = 2 * (x * z - w * y) * a; axes[7] = 2 * (y * z + w * x) * b; axes[8] = (1 - 2 * (x * x + y * y)) * c;
}

/** Axes times their transpose: xx, xy, xz, yy, yz, zz. */
function covariance(axes, out, at) {
  const dot = (p, q) => axes[p] * axes[q] + axes[p + 1] * axes[q + 1] + axes[p + 2] * axes[q + 2];
  out[at] = dot(0, 0); out[at + 1] = dot(0, 3); out[at + 2] = dot(0, 6);
  out[at + 3] = dot(3, 3); out[at + 4] = dot(3, 6); out[at + 5] = dot(6, 6);
}
