// Cameras over the scene: frusta of training and test views, and the path of the video's camera.

const TRAIN_COLOR = "#7fe0e4";
const TEST_COLOR = "#ffb37a";
/** A click this near to a camera means it, CSS px. */
const NEAR_ENOUGH = 14;

class Overlay {
  /** `cameras` are views of training and test with their places; frusta are `size` deep, scene units. */
  constructor(canvas, cameras, size) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.cameras = cameras;
    this.size = size;
    this.path = cameras.filter((camera) => !camera.test).map((camera) => camera.place.center);
    /** Where cameras are on the canvas, CSS px. */
    this.spots = [];
  }

  /** Corners of a camera's picture, so far ahead of it. */
  corners({ place, lens }) {
    const [right, down, ahead] = axesOf(place);
    return [[0, 0], [1, 0], [1, 1], [0, 1]].map(([u, v]) => {
      const [x, y] = [(u * lens.width - lens.cx) / lens.fx, (v * lens.height - lens.cy) / lens.fy];
      return add3(add3(add3(place.center, ahead, this.size), right, x * this.size), down, y * this.size);
    });
  }

  clear() {
    this.spots = [];
    const { canvas, context } = this;
    context.clearRect(0, 0, canvas.width, canvas.height);
  }

  /** Draws all cameras as a view sees them; `ratio` is canvas pixels per CSS pixel, `current` the camera of the time. */
  draw(view, ratio, current) {
    this.clear();
    const { context } = this;
    const line = (points, closed) => {
      context.beginPath();
      let open = false;
      for (const point of points) {
        const p = projected(view, point);
        if (p && open) context.lineTo(...p);
        else if (p) context.moveTo(...p);
        open = Boolean(p);
      }
      if (closed && open) context.closePath();
      context.stroke();
    };
    context.lineJoin = "round";
    context.strokeStyle = TRAIN_COLOR;
    context.globalAlpha = 0.7;
    context.lineWidth = 1.5 * ratio;
    if (this.path.length > 1) line(this.path, false);
    this.cameras.forEach((camera, index) => {
      const eye = camera.place.center;
      // The camera that is looked through would hide the scene.
      if (length3(add3(eye, view.center, -1)) < 1.2 * this.size) return;
      const spot = projected(view, eye);
      if (!spot) return;
      const chosen = index === current;
      context.strokeStyle = camera.test ? TEST_COLOR : TRAIN_COLOR;
      context.globalAlpha = chosen ? 1 : 0.55;
      context.lineWidth = (chosen ? 2 : 1) * ratio;
      const corners = this.corners(camera);
      line(corners, true);
      for (const corner of corners) line([eye, corner], false);
      this.spots.push({ index, at: spot.map((v) => v / ratio) });
    });
  }

  /** The camera at a place of the canvas, CSS px; -1 for none. */
  at(x, y) {
    let found = -1, least = NEAR_ENOUGH;
    for (const { index, at } of this.spots) {
      const distance = Math.hypot(at[0] - x, at[1] - y);
      if (distance < least) [found, least] = [index, distance];
    }
    return found;
  }
}
