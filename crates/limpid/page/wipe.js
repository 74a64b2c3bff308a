// Frame by frame: two pictures of a view, one wiped over the other; of several runs side by side, at the same view and edge.

const PICTURES = [
  ["input", "blurry frame"],
  ["seen", "what the camera is said to have seen"],
  ["sharp", "sharp render"],
  ["first", "the first run's sharp render"],
  ["truth", "truth"],
];
const pictureName = (key) => PICTURES.find(([name]) => name === key)[1];

/** A picture over another, up to an edge. */
class Pane {
  /** `moved(percent)` hears where somebody wants the edge, and `clicked(x, y)` of clicks, in shares of the sides. */
  constructor(moved, clicked) {
    this.under = el("img", { alt: "" });
    this.over = el("img", { alt: "", class: "over" });
    this.left = el("span", { class: "tag" });
    this.right = el("span", { class: "tag right" });
    this.input = el("input", { type: "range", min: 0, max: 100, step: 0.5, value: 50, "aria-label": "Where the left picture ends" });
    this.box = el("div", { class: "wipe" }, this.under, this.over, this.left, this.right, el("div", { class: "seam" }), this.input);
    this.caption = el("figcaption", { class: "figures" });
    this.figure = el("figure", { class: "pane" }, this.box, this.caption);
    this.input.addEventListener("input", () => moved(Number(this.input.value)));
    const share = (event) => {
      const box = this.box.getBoundingClientRect();
      return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    };
    const follow = (event) => moved(clamp(100 * share(event)[0], 0, 100));
    this.box.addEventListener("pointerdown", (event) => { this.box.setPointerCapture(event.pointerId); follow(event); });
    this.box.addEventListener("pointermove", (event) => {
      if (event.pointerType === "mouse" || event.buttons) follow(event);
    });
    this.box.addEventListener("click", (event) => clicked(...share(event)));
  }

  edge(percent) {
    this.input.value = percent;
    this.box.style.setProperty("--edge", `${percent}%`);
  }

  /** Shows two pictures of a view; where it has none of a kind, another. */
  show(view, pictures, { left, right }) {
    const put = (image, tag, keys) => {
      const key = keys.find((key) => pictures[key]) ?? "sharp";
      if (pictures[key]) image.src = `data:image/jpeg;base64,${pictures[key]}`;
      else image.removeAttribute("src");
      image.alt = `${pictureName(key)} of ${view.name}`;
      tag.textContent = pictureName(key);
    };
    put(this.over, this.left, [left, "input", "truth"]);
    put(this.under, this.right, [right, "sharp"]);
    this.box.style.aspectRatio = `${view.width} / ${view.height}`;
  }
}

class Wipe {
  /**
   * `runs` are { name, facts, gallery }, with the views of the first; `go(index)` shows a view in the scene. `this.shown` are called
   * with every view that is shown, `this.clicked` with clicks.
   */
  constructor(runs, go) {
    this.chosen = { left: "input", right: "sharp" };
    this.shown = [];
    this.panes = runs.map(() => new Pane((percent) => this.edge(percent), (x, y) => this.clicked?.(x, y)));
    $("panes").append(...this.panes.map((pane) => pane.figure));
    $("view").addEventListener("change", () => this.set(Number($("view").value)));
    $("frame").addEventListener("input", () => this.set(this.pictured[Number($("frame").value)].index));
    for (const side of ["left", "right"]) {
      $(side).addEventListener("change", () => { this.chosen[side] = $(side).value; this.set(this.index); });
    }
    $("go").addEventListener("click", () => go?.(this.index));
    $("go").hidden = !go;
    this.load(runs);
  }

  /** Takes other pictures of the same views, and stays where it is. */
  load(runs) {
    this.runs = runs;
    const { train, test } = runs[0].facts;
    this.views = [...train, ...test].map((view, index) => ({
      ...view, index, test: index >= train.length, pictures: runs.map(({ gallery }) => gallery.views[index] ?? {}),
    }));
    this.pictured = this.views.filter((view) => view.pictures.some((pictures) => pictures.sharp));
    $("frames").hidden = this.pictured.length === 0;
    if (this.pictured.length === 0) return;
    $("frame").max = this.pictured.length - 1;
    $("view").replaceChildren();
    for (const [label, test] of [["training views", false], ["test views", true]]) {
      const group = el("optgroup", { label });
      for (const view of this.pictured) if (view.test === test) group.append(el("option", { value: view.index }, view.name));
      if (group.children.length) $("view").append(group);
    }
    const frames = this.pictured.filter((view) => !view.test);
    const first = (frames[Math.floor((frames.length - 1) / 2)] ?? this.pictured[0]).index;
    this.set(this.has(this.index) ? this.index : first);
  }

  /** Whether there are pictures of a view. */
  has(index) {
    return this.pictured.some((view) => view.index === index);
  }

  edge(percent) {
    for (const pane of this.panes) pane.edge(percent);
  }

  /** Shows a view. */
  set(index) {
    this.index = index;
    const view = this.views[index];
    $("view").value = String(index);
    $("frame").value = this.pictured.findIndex((other) => other.index === index);
    const there = PICTURES.map(([key]) => key).filter((key) => view.pictures.some((pictures) => pictures[key]));
    const choose = (side, others) => {
      const list = $(side);
      list.replaceChildren(...there.map((key) => el("option", { value: key }, pictureName(key))));
      list.value = [this.chosen[side], ...others].find((key) => there.includes(key)) ?? "sharp";
      return list.value;
    };
    const chosen = { left: choose("left", ["input", "truth"]), right: choose("right", ["sharp"]) };
    this.panes.forEach((pane, k) => pane.show(view, view.pictures[k], chosen));
    this.tell(view);
    for (const show of this.shown) show(view, index);
  }

  tell(view) {
    const parts = [`${view.test ? "test view" : "frame"} ${view.name}, time ${decimals(view.time, view.time % 1 ? 2 : 0)}`, `${view.width} × ${view.height}`];
    const told = ({ facts, gallery }) => [...viewScores(view, facts), ...(gallery.factor > 1 ? [`shown ${gallery.factor} times smaller`] : [])];
    if (this.runs.length === 1) parts.push(...told(this.runs[0]));
    else this.panes.forEach((pane, k) => { pane.caption.textContent = [this.runs[k].name, ...told(this.runs[k])].join(" · "); });
    $("frame-figures").textContent = parts.join(" · ");
  }
}

/** What a run's scores say of a view. */
function viewScores(view, { metrics }) {
  const parts = [];
  const list = view.test ? metrics?.test?.views : metrics?.train_sharp?.views;
  const scores = list?.find((scored) => scored.name === view.name);
  if (scores) parts.push(`sharp render against truth: PSNR ${decimals(scores.psnr, 2)} dB` + (isNumber(scores.ssim) ? `, SSIM ${decimals(scores.ssim, 4)}` : ""));
  const deed = view.test ? null : metrics?.frames?.[view.index];
  if (isNumber(deed?.psnr)) parts.push(`blurred against the frame: ${decimals(deed.psnr, 2)} dB`);
  return parts;
}
