// The address's fragment keeps time and view: #t=3.25&cam=follow, &cam=4 (a camera of the list) or &view=x,y,z,w,i,j,k,reach,lens, where
// the lens is that of such a camera (the first's if it is left out).

function readAddress() {
  const words = new URLSearchParams(location.hash.slice(1));
  const numbers = (name) => (words.get(name) ?? "").split(",").map(Number);
  const [time] = numbers("t");
  const view = numbers("view");
  const camera = words.get("cam");
  return {
    time: words.has("t") && Number.isFinite(time) ? time : null,
    camera: camera === "follow" ? "follow" : /^\d+$/.test(camera ?? "") ? Number(camera) : null,
    view: [8, 9].includes(view.length) && view.every(Number.isFinite) && view[7] > 0
      ? { center: view.slice(0, 3), rotation: quatUnit(view.slice(3, 7)), reach: view[7], lens: /^\d+$/.test(view[8] ?? "") ? view[8] : 0 }
      : null,
  };
}

const short = (value) => String(Number(value.toPrecision(6)));

function writeAddress({ time, camera, lens, place, reach }) {
  const view = camera === null ? `view=${[...place.center, ...place.rotation, reach, lens].map(short).join(",")}` : `cam=${camera}`;
  const hash = `#t=${short(time)}&${view}`;
  if (hash === location.hash) return;
  try {
    history.replaceState(null, "", hash);
  } catch {
    // Some browsers keep no history for files, or no more than so many entries a minute.
  }
}
