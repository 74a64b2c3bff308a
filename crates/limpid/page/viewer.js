// The moving scene: time, camera, what is shown, and the loop that draws it.

/** Frames of the video a second at speed 1: slow enough to see how things move. */
const FRAME_RATE = 12;
/** While things move pictures take at most this long, ms, or they become smaller, down to a share of the canvas's sides. */
const SLOW = 45;
const LEAST_SHARE = 0.3;
/** After so long without a move, ms, the picture is drawn at its full size. */
const REST = 300;
/** Canvas pixels per CSS pixel at most. */
const MOST_RATIO = 2;

class Viewer {
  constructor(facts, scene) {
    this.canvas = $("canvas");
    this.renderer = Renderer.on(this.canvas, scene);
    if (!this.renderer) throw new Error("This browser has no WebGL2, which draws the scene. The rest of the report is below.");
    this.take(facts, scene);
    this.first = this.stops[0].time;
    this.last = this.stops[this.stops.length - 1].time;
    const ups = this.stops.map((stop) => axesOf(stop)[1]);
    const up = unit3(ups.reduce((sum, down) => add3(sum, down, -1), [0, 0, 0]));
    this.controls = new Controls(this.canvas, up, facts.scene_size, (place) => this.free(place));
    this.time = this.first;
    this.forward = true;
    this.playing = false;
    this.show = "both";
    /** "follow", the number of a camera, or null for a free view. */
    this.camera = "follow";
    /** The number of the camera whose lens a view has. */
    this.lens = 0;
    this.share = 1;
    /** When somebody last moved the camera. */
    this.moved = -Infinity;
    this.costs = { pose: [], sort: [], frame: [] };
    this.drawn = 0;
    this.connect();
    this.restore();
  }

  /** All that depends on which state of the scene is shown. */
  take(facts, scene) {
    this.facts = facts;
    this.scene = scene;
    this.motion = new Motion(scene);
    this.sorter = new Sorter(scene.count);
    this.renderer.place(this.motion, scene.count);
    const camera = (test) => (view) => ({ ...view, test, lens: view, place: { ...placeOf(view.pose), pose: view.pose } });
    /** Training views, then test views. */
    this.cameras = [...facts.train.map(camera(false)), ...facts.test.map(camera(true))];
    this.stops = facts.train.map((view) => ({ time: view.time, ...placeOf(view.pose) })).sort((a, b) => a.time - b.time);
    this.overlay = new Overlay($("overlay"), this.cameras, 0.05 * facts.scene_size);
    for (const option of $("show").options) option.disabled = scene.movers === 0 && option.value !== "both";
  }

  /** Shows another state of the same scene, from where and when this one is shown. */
  load(facts, scene) {
    this.renderer.load(scene);
    this.take(facts, scene);
    if (typeof this.camera === "number") this.controls.place = this.cameras[this.camera].place;
    this.invalidate();
  }

  /** Connects the page's controls. */
  connect() {
    const { canvas } = this;
    const slider = $("time");
    slider.min = this.first;
    slider.max = this.last;
    $("play").disabled = slider.disabled = this.last <= this.first;
    slider.addEventListener("input", () => { this.pause(); this.setTime(Number(slider.value)); });
    $("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    $("back").addEventListener("click", () => this.step(-1));
    $("forth").addEventListener("click", () => this.step(1));
    $("reset").addEventListener("click", () => this.reset());
    $("save").addEventListener("click", () => this.save());
    $("full").addEventListener("click", () => this.fullScreen());
    $("full").hidden = !$("stage").requestFullscreen;
    $("cameras").addEventListener("change", () => this.invalidate());
    $("show").addEventListener("change", () => { this.show = $("show").value; this.invalidate(); });

    const list = $("camera");
    list.append(el("option", { value: "follow" }, "the video's"), el("option", { value: "", disabled: "", hidden: "" }, "free"));
    for (const [label, test] of [["training views", false], ["test views", true]]) {
      const group = el("optgroup", { label });
      this.cameras.forEach((camera, index) => {
        if (camera.test === test) group.append(el("option", { value: index }, camera.name));
      });
      if (group.children.length) list.append(group);
    }
    list.addEventListener("change", () => (list.value === "follow" ? this.follow() : this.jump(Number(list.value))));

    canvas.addEventListener("pointerdown", () => $("hint").classList.add("gone"));
    canvas.addEventListener("click", (event) => {
      const found = this.controls.dragged ? -1 : this.overlay.at(event.offsetX, event.offsetY);
      if (found >= 0) this.jump(found);
    });
    canvas.addEventListener("pointermove", (event) => {
      canvas.classList.toggle("pointing", this.overlay.at(event.offsetX, event.offsetY) >= 0);
    });
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.renderer.build();
      this.renderer.place(this.motion, this.scene.count);
      this.invalidate();
    });
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("hashchange", () => this.restore());
    new ResizeObserver(() => this.resize()).observe($("stage"));
    this.followRatio();
    this.resize();
  }

  /** Another zoom or screen has other pixels, also where the stage keeps its size. */
  followRatio() {
    matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`).addEventListener("change", () => {
      this.resize();
      this.followRatio();
    }, { once: true });
  }

  key(event) {
    if (isForOthers(event)) return;
    const actions = {
      " ": () => (this.playing ? this.pause() : this.play()),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      0: () => this.reset(),
      f: () => this.fullScreen(),
      p: () => this.follow(),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }

  /** Takes time and view from the address. */
  restore() {
    const { time, camera, view } = readAddress();
    if (time !== null) this.setTime(time);
    if (view) {
      this.controls.reach = view.reach;
      this.lens = view.lens < this.cameras.length ? view.lens : 0;
      this.free(view);
    } else if (typeof camera === "number" && camera < this.cameras.length) {
      this.jump(camera, time ?? undefined);
    } else {
      this.follow();
    }
  }

  // Camera.

  follow() {
    this.camera = "follow";
    this.lens = 0;
    this.controls.reach = this.facts.scene_size;
    this.invalidate();
  }

  /** Sees through a camera, at its time or another. */
  jump(index, time = this.cameras[index].time) {
    this.camera = index;
    this.lens = index;
    this.controls.reach = this.facts.scene_size;
    this.controls.place = this.cameras[index].place;
    this.setTime(time);
  }

  /** A view that somebody chose. */
  free({ center, rotation }) {
    this.camera = null;
    this.moved = performance.now();
    this.controls.place = { center, rotation };
    this.invalidate();
  }

  reset() {
    this.pause();
    this.setTime(this.first);
    this.follow();
  }

  // Time.

  setTime(time) {
    this.time = clamp(time, this.first, this.last);
    this.invalidate();
  }

  step(by) {
    this.pause();
    this.setTime(by > 0 ? Math.floor(this.time + 1e-6) + 1 : Math.ceil(this.time - 1e-6) - 1);
  }

  play() {
    if (this.last <= this.first) return;
    if ($("loop").value === "once" && this.time >= this.last) this.time = this.first;
    this.forward = this.forward && this.time < this.last;
    this.playing = true;
    this.before = null;
    this.costs.frame = [];
    this.invalidate();
  }

  pause() {
    this.playing = false;
    this.invalidate();
  }

  /** Goes on by so many ms. */
  advance(ms) {
    const way = FRAME_RATE * Number($("speed").value) * ms / 1000;
    const loop = $("loop").value;
    this.time += this.forward || loop !== "bounce" ? way : -way;
    if (this.time >= this.first && this.time <= this.last) return;
    if (loop === "loop") this.time = this.first;
    else this.time = clamp(this.time, this.first, this.last);
    if (loop === "bounce") this.forward = this.time <= this.first;
    if (loop === "once") this.pause();
  }

  // Pictures.

  resize() {
    const stage = $("stage");
    const full = document.fullscreenElement === stage;
    const { width, height } = this.facts.train[0];
    stage.style.aspectRatio = full ? "auto" : `${width} / ${clamp(height, width / 2.4, 1.2 * width)}`;
    const ratio = Math.min(window.devicePixelRatio || 1, MOST_RATIO);
    this.width = Math.max(Math.round(stage.clientWidth * ratio), 1);
    this.height = Math.max(Math.round(stage.clientHeight * ratio), 1);
    [$("overlay").width, $("overlay").height] = [this.width, this.height];
    this.ratio = ratio;
    this.invalidate();
  }

  /** Has a picture drawn before the next one is shown; without need nothing is. */
  invalidate() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame((now) => {
      this.asked = false;
      this.frame(now);
    });
  }

  /** Draws what is shown now; while things move smaller than the canvas is, where that comes too slowly, unless it is to be `whole`. */
  frame(now, whole = false) {
    if (this.playing) {
      const ms = this.before === null ? 0 : now - this.before;
      if (ms > 0) this.cost("frame", ms);
      this.before = now;
      this.advance(Math.min(ms, 250));
      this.adapt();
    }
    const moves = this.playing || now - this.moved < REST;
    const share = moves && !whole ? this.share : 1;
    if (!this.playing && share < 1) setTimeout(() => this.invalidate(), REST);
    const width = Math.max(Math.round(this.width * share), 1);
    const height = Math.max(Math.round(this.height * share), 1);
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    if (this.camera === "follow") this.controls.place = placeOnPath(this.stops, this.time);
    const { lens } = this.cameras[this.lens];
    const view = viewOf(this.controls.place, lens, width, height);
    this.controls.focal = view.fx * this.width / width / this.ratio;
    this.renderer.draw(view, this.sorter.order, this.arrange(view, this.time, this.show));
    if (this.camera === null && $("cameras").checked) {
      this.overlay.draw(viewOf(this.controls.place, lens, this.width, this.height), this.ratio, this.currentCamera());
    } else {
      this.overlay.clear();
    }
    this.drawn++;
    this.tell();
    if (this.playing) this.invalidate();
  }

  /** Poses and sorts what a view shows at a time; how many there are to draw. */
  arrange(view, time, show) {
    const { motion, scene } = this;
    const began = performance.now();
    if (motion.pose(time)) {
      this.cost("pose", performance.now() - began);
      this.renderer.place(motion, scene.movers);
    }
    const sorts = performance.now();
    const [from, to] = show === "static" ? [scene.movers, scene.count] : show === "movers" ? [0, scene.movers] : [0, scene.count];
    const count = this.sorter.sort({ centers: motion.centers, opacities: scene.opacities }, view.pose, view.near, from, to);
    this.cost("sort", performance.now() - sorts);
    return count;
  }

  /** A camera's picture at a time at its own size: RGBA in lines from the top. What the renderer's are compared with. */
  picture(index, time, show = "both") {
    const { place, lens } = this.cameras[index];
    const view = viewOf(place, lens, lens.width, lens.height);
    return this.renderer.pixels(view, this.sorter.order, this.arrange(view, time, show));
  }

  /** Makes pictures smaller where they come too slowly, and larger again where they come fast. */
  adapt() {
    const { frame } = this.costs;
    const ms = median(frame);
    if (frame.length < (ms > 4 * SLOW ? 2 : 12)) return;
    const wanted = ms > SLOW ? this.share * clamp(Math.sqrt(SLOW / ms), 0.4, 0.85) : ms < SLOW / 2.5 ? this.share * 1.2 : this.share;
    const share = clamp(wanted, LEAST_SHARE, 1);
    if (Math.abs(share - this.share) > 0.01) {
      this.share = share;
      this.costs.frame = [];
    }
  }

  cost(what, ms) {
    const list = this.costs[what];
    list.push(ms);
    if (list.length > 40) list.shift();
  }

  currentCamera() {
    return this.cameras.findIndex((camera) => !camera.test && Math.abs(camera.time - this.time) < 0.5);
  }

  /** What the page says of the moment. */
  tell() {
    $("play").textContent = this.playing ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", String(this.playing));
    $("time").value = this.time;
    $("clock").textContent = `frame ${this.time.toFixed(this.playing || !Number.isInteger(this.time) ? 1 : 0)} / ${this.last}`;
    $("camera").value = this.camera === null ? "" : String(this.camera);
    clearTimeout(this.writing);
    const { time, camera, lens, controls } = this;
    if (!this.playing) {
      this.writing = setTimeout(() => writeAddress({ time, camera, lens, place: controls.place, reach: controls.reach }), 300);
    }
    if (this.told && performance.now() - this.told < 250 && this.playing) return;
    this.told = performance.now();
    const { pose, sort, frame } = this.costs;
    const parts = [`${whole(this.scene.count)} Gaussians, of which ${whole(this.scene.movers)} move`];
    if (pose.length) parts.push(`posed in ${decimals(median(pose), 1)} ms`);
    if (sort.length) parts.push(`sorted in ${decimals(median(sort), 1)} ms`);
    if (frame.length > 4) parts.push(`${decimals(1000 / median(frame), 0)} pictures a second at ${this.canvas.width} × ${this.canvas.height}`);
    $("timings").textContent = parts.join(" · ");
  }

  save() {
    this.frame(performance.now(), true);
    this.canvas.toBlob((blob) => {
      const link = el("a", { href: URL.createObjectURL(blob), download: `${this.facts.name}-${short(this.time)}.png` });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }

  fullScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else $("stage").requestFullscreen?.();
  }
}

/** NaN of nothing. */
function median(values) {
  if (values.length === 0) return NaN;
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)];
}
