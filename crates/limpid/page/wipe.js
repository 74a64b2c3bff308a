// Frame by frame: two pictures of a view, one wiped over the other.

const PICTURES = [
  ["input", "blurry frame"],
  ["seen", "what the camera is said to have seen"],
  ["sharp", "sharp render"],
  ["truth", "truth"],
];

class Wipe {
  /** `go(index)` shows a view in the scene. */
  constructor(facts, gallery, go) {
    this.facts = facts;
    this.gallery = gallery;
    this.views = [...facts.train, ...facts.test].map((view, index) => ({ ...view, test: index >= facts.train.length, pictures: gallery.views[index] }));
    this.index = 0;
    this.chosen = { left: "input", right: "sharp" };
    this.shown = [];
    if (!this.views.some((view) => view.pictures.sharp)) return;
    $("frames").hidden = false;
    $("frame").max = this.views.length - 1;
    for (const [label, test] of [["training views", false], ["test views", true]]) {
      const group = el("optgroup", { label });
      this.views.forEach((view, index) => {
        if (view.test === test) group.append(el("option", { value: index }, view.name));
      });
      if (group.children.length) $("view").append(group);
    }
    $("view").addEventListener("change", () => this.set(Number($("view").value)));
    $("frame").addEventListener("input", () => this.set(Number($("frame").value)));
    for (const side of ["left", "right"]) {
      $(side).addEventListener("change", () => { this.chosen[side] = $(side).value; this.set(this.index); });
    }
    $("go").addEventListener("click", () => go?.(this.index));
    $("go").hidden = !go;
    this.listen();
    this.set(Math.floor((facts.train.length - 1) / 2));
  }

  listen() {
    const wipe = $("wipe");
    const edge = (value) => {
      $("edge").value = value;
      wipe.style.setProperty("--edge", `${value}%`);
    };
    $("edge").addEventListener("input", () => edge($("edge").value));
    const follow = (event) => {
      const box = wipe.getBoundingClientRect();
      edge(clamp(100 * (event.clientX - box.left) / box.width, 0, 100));
    };
    wipe.addEventListener("pointerdown", (event) => { wipe.setPointerCapture(event.pointerId); follow(event); });
    wipe.addEventListener("pointermove", (event) => {
      if (event.pointerType === "mouse" || event.buttons) follow(event);
    });
    wipe.addEventListener("click", (event) => {
      const box = wipe.getBoundingClientRect();
      this.clicked?.((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    });
  }

  /** Shows a view. */
  set(index) {
    this.index = index;
    const view = this.views[index];
    $("view").value = String(index);
    $("frame").value = index;
    const there = PICTURES.filter(([key]) => view.pictures[key]);
    const choose = (side, others) => {
      const list = $(side);
      list.replaceChildren(...there.map(([key, label]) => el("option", { value: key }, label)));
      const key = [this.chosen[side], ...others].find((key) => view.pictures[key]) ?? "sharp";
      list.value = key;
      return key;
    };
    const left = choose("left", ["input", "truth"]);
    const right = choose("right", ["sharp"]);
    const put = (image, tag, key) => {
      if (view.pictures[key]) image.src = `data:image/jpeg;base64,${view.pictures[key]}`;
      else image.removeAttribute("src");
      image.alt = `${PICTURES.find(([name]) => name === key)[1]} of ${view.name}`;
      tag.textContent = PICTURES.find(([name]) => name === key)[1];
    };
    put($("over"), $("left-tag"), left);
    put($("under"), $("right-tag"), right);
    $("wipe").style.aspectRatio = `${view.width} / ${view.height}`;
    this.tell(view);
    for (const show of this.shown) show(view, index);
  }

  tell(view) {
    const { metrics, train } = this.facts;
    const parts = [`${view.test ? "test view" : "frame"} ${view.name}, time ${decimals(view.time, view.time % 1 ? 2 : 0)}`, `${view.width} × ${view.height}`];
    const list = view.test ? metrics?.test?.views : metrics?.train_sharp?.views;
    const scores = list?.find((scored) => scored.name === view.name);
    if (scores) parts.push(`sharp render against truth: PSNR ${decimals(scores.psnr, 2)} dB` + (isNumber(scores.ssim) ? `, SSIM ${decimals(scores.ssim, 4)}` : ""));
    const deed = view.test ? null : metrics?.frames?.[train.findIndex((other) => other.name === view.name)];
    if (isNumber(deed?.psnr)) parts.push(`blurred against the frame: ${decimals(deed.psnr, 2)} dB`);
    if (this.gallery.factor > 1) parts.push(`shown ${this.gallery.factor} times smaller`);
    $("frame-figures").textContent = parts.join(" · ");
  }
}
