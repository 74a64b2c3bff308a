// Pointer and keys over the scene: orbit, pan, move closer, walk.

const WALK_KEYS = ["w", "a", "s", "d", "q", "e"];

/** Moves a free camera; calls `moved(place)` with every new place. */
class Controls {
  /** `up` is the world's upward direction, `reach` how far ahead of the camera the point lies that it orbits. */
  constructor(canvas, up, reach, moved) {
    this.canvas = canvas;
    this.up = up;
    this.size = reach;
    this.reach = reach;
    this.moved = moved;
    this.place = null;
    /** Focal length of what is shown, CSS px. */
    this.focal = 500;
    this.pointers = new Map();
    this.pressed = new Set();
    /** Whether the pointers moved since they went down: else it was a click. */
    this.dragged = false;
    this.listen();
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      if (pointers.size === 0) this.dragged = false;
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this.pans = event.button !== 0 || event.shiftKey;
      this.travelled = 0;
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => {
        pointers.delete(event.pointerId);
        canvas.classList.toggle("dragging", pointers.size > 0);
      });
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      this.dolly(Math.exp(0.0012 * clamp(event.deltaY * lines, -300, 300)));
    }, { passive: false });
    document.addEventListener("keydown", (event) => {
      if (isForOthers(event) || !WALK_KEYS.includes(event.key.toLowerCase())) return;
      event.preventDefault();
      this.pressed.add(event.key.toLowerCase());
      this.walk();
    });
    document.addEventListener("keyup", (event) => this.pressed.delete(event.key.toLowerCase()));
    window.addEventListener("blur", () => this.pressed.clear());
  }

  drag(event) {
    const { pointers } = this;
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    this.travelled += Math.hypot(dx, dy);
    if (this.travelled > 4) this.dragged = true;
    const spread = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    if (pointers.size === 2) {
      const old = spread();
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this.pan(dx / 2, dy / 2);
      this.dolly(old / Math.max(spread(), 1));
      return;
    }
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (!this.dragged || pointers.size !== 1) return;
    this.canvas.classList.add("dragging");
    if (this.pans) this.pan(dx, dy);
    else this.orbit(dx, dy);
  }

  /** Turns about the point ahead: drags of a canvas's width turn by half a circle. */
  orbit(dx, dy) {
    const { place, reach, up } = this;
    const [right, , ahead] = axesOf(place);
    const pivot = add3(place.center, ahead, reach);
    const angle = Math.PI / this.canvas.clientWidth;
    const yaw = quatTurn(up, -dx * angle);
    // Not over the poles.
    const height = Math.asin(clamp(dot3(ahead, up), -1, 1));
    const pitch = clamp(-dy * angle, -1.5 - height, 1.5 - height);
    const turn = quatProduct(yaw, quatTurn(right, pitch));
    const rotation = quatUnit(quatProduct(turn, place.rotation));
    this.go({ center: add3(pivot, axesOf({ rotation })[2], -reach), rotation });
  }

  pan(dx, dy) {
    const [right, down] = axesOf(this.place);
    const scale = this.reach / this.focal;
    this.go({ ...this.place, center: add3(add3(this.place.center, right, -dx * scale), down, -dy * scale) });
  }

  /** The point ahead comes to so many times its distance. */
  dolly(factor) {
    const reach = clamp(this.reach * factor, 0.05 * this.size, 20 * this.size);
    const ahead = axesOf(this.place)[2];
    const center = add3(this.place.center, ahead, this.reach - reach);
    this.reach = reach;
    this.go({ ...this.place, center });
  }

  /** Goes on as long as keys are down; by a step at least, however short a key was down. */
  walk() {
    if (this.walking) return;
    this.walkFor(1 / 60);
    let before = performance.now();
    const step = (now) => {
      this.walking = this.pressed.size > 0;
      if (!this.walking) return;
      this.walkFor(clamp((now - before) / 1000, 0, 0.1));
      before = now;
      requestAnimationFrame(step);
    };
    this.walking = true;
    requestAnimationFrame(step);
  }

  walkFor(seconds) {
    const way = 0.6 * this.size * seconds;
    const [right, down, ahead] = axesOf(this.place);
    const keys = { w: [ahead, 1], s: [ahead, -1], d: [right, 1], a: [right, -1], q: [down, 1], e: [down, -1] };
    let { center } = this.place;
    for (const key of this.pressed) center = add3(center, keys[key][0], keys[key][1] * way);
    this.go({ ...this.place, center });
  }

  go(place) {
    this.place = place;
    this.moved(place);
  }
}
