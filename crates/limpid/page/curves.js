// The course of training: a drawing for each figure, with the schedule's moments as marks.

const CURVES = [
  ["loss", "Loss", (v) => decimals(v, 4)],
  ["psnr", "PSNR of what the camera is said to have seen, dB", (v) => decimals(v, 2)],
  ["gaussians", "Gaussians", whole],
  ["seconds", "Seconds of training", (v) => decimals(v, v < 100 ? 1 : 0)],
];
const CURVE = { width: 480, height: 190, left: 50, right: 8, top: 16, bottom: 22 };

function showCurves({ curves, moments }) {
  const few = curves.iteration.length < 2;
  $("training").hidden = few;
  if (few) return;
  $("curves").replaceChildren();
  const last = curves.iteration[curves.iteration.length - 1];
  const marks = [...new Set(moments.filter((moment) => moment.iteration <= last).map((moment) => moment.iteration))];
  const updates = [];
  for (const [key, title, text] of CURVES) {
    const points = curves.iteration.map((iteration, k) => [iteration, curves[key][k]]).filter(([, v]) => isNumber(v));
    if (points.length < 2) continue;
    $("curves").append(curve(title, points, text, last, marks, updates));
  }
  $("moments").replaceChildren(...marks.map((mark) => {
    const what = moments.filter((moment) => moment.iteration === mark).map((moment) => moment.what);
    return el("li", {}, `${whole(mark)}: ${what.join(", ")}`);
  }));
}

/** Round numbers between two, a few of them. */
function ticks(low, high) {
  const rough = (high - low) / 3;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
  const all = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) all.push(Number(v.toPrecision(12)));
  return all;
}

function curve(title, points, text, last, marks, updates) {
  const { width, height, left, right, top, bottom } = CURVE;
  const values = points.map(([, v]) => v);
  let [low, high] = [Math.min(...values), Math.max(...values)];
  if (high - low < 1e-9 * Math.max(Math.abs(high), 1)) [low, high] = [low - 0.5, high + 0.5];
  const x = (it) => left + (width - left - right) * it / last;
  const y = (v) => top + (height - top - bottom) * (high - v) / (high - low);
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${title}: ${text(values[0])} at first, ${text(values[values.length - 1])} at last` });
  for (const tick of ticks(low, high)) {
    drawing.append(
      svg("line", { class: "axis", x1: left, x2: width - right, y1: y(tick), y2: y(tick) }),
      svg("text", { x: left - 6, y: y(tick) + 4, "text-anchor": "end" }, tickText(tick)),
    );
  }
  for (const tick of ticks(0, last)) {
    drawing.append(svg("text", { x: x(tick), y: height - 6, "text-anchor": tick === 0 ? "start" : tick > 0.95 * last ? "end" : "middle" }, tickText(tick)));
  }
  // Numbers of marks that lie close together are left out.
  let free = -Infinity;
  marks.forEach((mark, k) => {
    drawing.append(svg("line", { class: "moment", x1: x(mark), x2: x(mark), y1: top, y2: height - bottom }));
    if (x(mark) > free + 13) {
      drawing.append(svg("text", { x: x(mark), y: top - 5, "text-anchor": "middle" }, k + 1));
      free = x(mark);
    }
  });
  drawing.append(svg("path", { class: "line", d: points.map(([it, v], k) => `${k ? "L" : "M"}${x(it).toFixed(1)} ${y(v).toFixed(1)}`).join("") }));
  const cursor = svg("line", { class: "cursor", y1: top, y2: height - bottom, visibility: "hidden" });
  drawing.append(cursor);
  const value = el("span", { class: "value" });
  // All drawings show the same moment.
  updates.push((iteration) => {
    const [it, v] = iteration === null ? points[points.length - 1]
      : points.reduce((best, point) => (Math.abs(point[0] - iteration) < Math.abs(best[0] - iteration) ? point : best));
    value.textContent = iteration === null ? text(v) : `${text(v)} after ${whole(it)}`;
    cursor.setAttribute("visibility", iteration === null ? "hidden" : "visible");
    cursor.setAttribute("x1", x(it));
    cursor.setAttribute("x2", x(it));
  });
  const all = (iteration) => updates.forEach((update) => update(iteration));
  drawing.addEventListener("pointermove", (event) => {
    const box = drawing.getBoundingClientRect();
    all(clamp(((event.clientX - box.left) / box.width * width - left) / (width - left - right), 0, 1) * last);
  });
  drawing.addEventListener("pointerleave", () => all(null));
  updates[updates.length - 1](null);
  return el("div", {}, el("h3", {}, value, title), drawing);
}

function tickText(v) {
  if (Math.abs(v) >= 1e6) return `${Number((v / 1e6).toPrecision(3))} M`;
  if (Math.abs(v) >= 1e4) return `${Number((v / 1e3).toPrecision(3))} k`;
  return String(Number(v.toPrecision(3)));
}
