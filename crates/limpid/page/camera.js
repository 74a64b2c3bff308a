// Cameras: places (a centre and a quaternion, world from camera, OpenCV axes: x right, y down, z ahead) and the views they give.

const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add3 = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const length3 = (a) => Math.hypot(...a);
const unit3 = (a) => { const l = length3(a) || 1; return [a[0] / l, a[1] / l, a[2] / l]; };

function quatProduct([a, b, c, d], [w, x, y, z]) {
  return [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w];
}

function quatUnit(q) {
  const length = Math.hypot(...q);
  return length > 1e-9 ? q.map((v) => v / length) : [1, 0, 0, 0];
}

function quatTurn(axis, angle) {
  const [x, y, z] = unit3(axis);
  const s = Math.sin(angle / 2);
  return [Math.cos(angle / 2), s * x, s * y, s * z];
}

/** Rows of a quaternion's matrix. */
function quatRows([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/** The quaternion of a matrix, given by rows. */
function quatOf([[a, b, c], [d, e, f], [g, h, i]]) {
  const squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i];
  const k = squares.indexOf(Math.max(...squares));
  return quatUnit([
    [squares[0], h - f, c - g, d - b], [h - f, squares[1], d + b, c + g], [c - g, d + b, squares[2], h + f], [d - b, c + g, h + f, squares[3]],
  ][k]);
}

function slerp(p, q, share) {
  let cosine = p.reduce((sum, v, k) => sum + v * q[k], 0);
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(Math.abs(cosine), 1);
  const angle = Math.acos(cosine);
  const [a, b] = angle < 1e-4 ? [1 - share, share] : [Math.sin((1 - share) * angle), Math.sin(share * angle)].map((v) => v / Math.sin(angle));
  return quatUnit(p.map((v, k) => a * v + sign * b * q[k]));
}

/** The place of a pose, whose rows [R | t] are camera from world. */
function placeOf(m) {
  const columns = [0, 1, 2].map((k) => [m[k], m[4 + k], m[8 + k]]);
  return { center: columns.map((column) => -dot3(column, [m[3], m[7], m[11]])), rotation: quatOf(columns) };
}

/** Rows [R | t], camera from world, of a place. */
function poseOf({ center, rotation }) {
  const [x, y, z] = [0, 1, 2].map((k) => quatRows(rotation).map((row) => row[k]));
  return [x, y, z].flatMap((axis) => [...axis, -dot3(axis, center)]);
}

/** To the right, down, and where the camera is looking. */
const axesOf = ({ rotation }) => [0, 1, 2].map((k) => quatRows(rotation).map((row) => row[k]));

function between(a, b, share) {
  return {
    center: a.center.map((v, k) => v + share * (b.center[k] - v)),
    rotation: slerp(a.rotation, b.rotation, share),
  };
}

/** The camera of the video at a time, between its frames too. `stops` are places with times, in order. */
function placeOnPath(stops, time) {
  let next = stops.findIndex((stop) => stop.time >= time);
  if (next < 0) next = stops.length - 1;
  const [a, b] = [stops[Math.max(next - 1, 0)], stops[next]];
  return b.time > a.time ? between(a, b, clamp((time - a.time) / (b.time - a.time), 0, 1)) : b;
}

/**
 * A view of a canvas: what a camera of these intrinsics sees from a place, its picture as large as fits. At the picture's own size it
 * is the renderer's view; where the canvas is larger, the low-pass grows with it, so that it shows what was trained and no finer thorns.
 */
function viewOf(place, lens, width, height) {
  const scale = Math.min(width / lens.width, height / lens.height);
  return {
    pose: place.pose ?? poseOf(place),
    center: place.center,
    width, height,
    fx: lens.fx * scale,
    fy: lens.fy * scale,
    cx: (lens.cx - lens.width / 2) * scale + width / 2,
    cy: (lens.cy - lens.height / 2) * scale + height / 2,
    near: lens.near,
    lowPass: 0.3 * Math.max(1, scale * scale),
  };
}

/** A point of the world in pixels of a view, or null behind the camera. */
function projected({ pose: m, fx, fy, cx, cy, near }, p) {
  const [x, y, z] = [0, 4, 8].map((k) => m[k] * p[0] + m[k + 1] * p[1] + m[k + 2] * p[2] + m[k + 3]);
  return z > near ? [fx * x / z + cx, fy * y / z + cy] : null;
}
