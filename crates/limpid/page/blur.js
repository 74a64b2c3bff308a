// How a frame was blurred: what points become by the camera's path and lens, and the kernel of a pixel that was chosen.

/** Shows the blur of what a wipe shows. */
function showBlur(wipe) {
  const box = $("blur");
  const kernels = { mark: null, at: [0.5, 0.5] };
  const show = (view) => {
    kernels.mark?.remove();
    kernels.mark = null;
    const { camera, kernels: grid } = view.pictures[0];
    box.replaceChildren();
    box.hidden = !camera && !grid;
    if (camera) box.append(...cameraFigures(view, camera));
    if (grid) box.append(...kernelFigure(wipe.panes[0].box, grid, kernels));
  };
  wipe.shown.push(show);
  kernels.choose = (x, y) => {
    kernels.at = [x, y];
    show(wipe.views[wipe.index]);
  };
  wipe.clicked = kernels.choose;
  if (wipe.pictured.length) show(wipe.views[wipe.index]);
}

function cameraFigures(view, { path_px, disc_px, focus, spots }) {
  const reach = Math.max(1, ...spots.flatMap((spot) => spot.places.map(([x, y]) => Math.hypot(x, y)).filter(Number.isFinite)));
  const names = ["near", "middle", "far"];
  const figures = spots.map((spot, k) => {
    const picture = svg("svg", { viewBox: `${-1.12 * reach} ${-1.12 * reach} ${2.24 * reach} ${2.24 * reach}`, role: "img", "aria-label": "where the light of a point falls" });
    picture.append(
      svg("path", { d: `M${-reach} 0H${reach}M0 ${-reach}V${reach}`, stroke: "#2b3338", "stroke-width": 0.012 * reach }),
      ...spot.places.filter((place) => place.every(Number.isFinite)).map(([x, y]) => svg("circle", { cx: x, cy: y, r: 0.035 * reach, fill: "#7fe0e4", "fill-opacity": 0.35 })),
    );
    const name = spots.length === 3 ? names[k] : `point ${k + 1}`;
    return el("figure", {}, picture, el("figcaption", {}, `${name}: depth ${decimals(spot.depth, 2)}`));
  });
  const lens = disc_px > 0.05 ? ` The largest disc of its lens is ${decimals(disc_px, 1)} px wide, and the focus lies at ${decimals(focus, 2)}.` : "";
  const text = `While the shutter was open, points at these depths in the middle of the picture left light here: ${decimals(reach, 1)} px from middle to edge. `
    + `The camera's path is ${decimals(path_px, 1)} px long.${lens}`;
  return [...figures, el("p", {}, text)];
}

function kernelFigure(pane, grid, state) {
  const [column, row] = [Math.floor(state.at[0] * grid.columns), Math.floor(state.at[1] * grid.rows)]
    .map((v, k) => clamp(v, 0, (k ? grid.rows : grid.columns) - 1));
  const place = row * grid.columns + column;
  const area = grid.size * grid.size;
  const weights = fromBase64(grid.weights).subarray(place * area, (place + 1) * area);
  const intensity = fromBase64(grid.intensity)[place] / 255;
  const canvas = el("canvas", { width: grid.size, height: grid.size, role: "img", "aria-label": "kernel" });
  const image = new ImageData(grid.size, grid.size);
  weights.forEach((weight, k) => image.data.set([weight, weight, weight, 255], 4 * k));
  canvas.getContext("2d").putImageData(image, 0, 0);
  state.mark = el("button", { class: "mark", type: "button", "aria-label": "Place of the kernel that is shown; arrow keys move it" });
  state.mark.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    event.stopPropagation();
    state.choose((column + way[0] + 0.5) / grid.columns, (row + way[1] + 0.5) / grid.rows);
    state.mark.focus();
  });
  state.mark.style.left = `${100 * (column + 0.5) / grid.columns}%`;
  state.mark.style.top = `${100 * (row + 0.5) / grid.rows}%`;
  pane.append(state.mark);
  return [
    el("figure", {}, canvas, el("figcaption", {}, `kernel of ${grid.size} × ${grid.size} px, intensity ${decimals(intensity, 2)}`)),
    el("p", {}, `Click the picture for the kernel there, or go by arrow keys from its mark: ${grid.columns} × ${grid.rows} of them are kept of every frame.`),
  ];
}
