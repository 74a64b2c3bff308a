// Scores by view, what was decided, settings: what there is to read.

const FIGURES = [
  ["psnr", "PSNR, dB", 2], ["ssim", "SSIM", 4], ["mpsnr", "mPSNR", 2], ["mpsnr_static", "… what stands still", 2], ["mpsnr_dynamic", "… what moves", 2],
];

/** Scores, the worst view first; `go(isTest, name)` shows a view. */
function showScores(metrics, go) {
  $("tables").replaceChildren();
  const groups = [["Test views", metrics?.test, true], ["Sharp renders of training views", metrics?.train_sharp, false]];
  for (const [title, scores, test] of groups) {
    if (!scores?.views?.length) continue;
    $("scores").hidden = false;
    const columns = FIGURES.filter(([key]) => scores.views.some((view) => isNumber(view[key])));
    const views = [...scores.views].sort((a, b) => (a.psnr ?? -Infinity) - (b.psnr ?? -Infinity));
    const known = views.map((view) => view.psnr).filter(isNumber);
    const [low, high] = [Math.min(...known), Math.max(...known)];
    const cells = (figures) => columns.map(([key, , digits]) => el("td", {}, decimals(figures[key], digits)));
    const body = el("tbody", {}, el("tr", { class: "mean" }, el("td", {}, `mean of ${views.length}`), ...cells(scores), el("td", { class: "bars" })));
    for (const view of views) {
      const bar = el("span");
      bar.style.width = isNumber(view.psnr) ? `${6 + 94 * (view.psnr - low) / Math.max(high - low, 1e-9)}%` : "0";
      const name = el("button", { type: "button" }, view.name);
      const row = el("tr", { class: "link" }, el("td", {}, name), ...cells(view), el("td", { class: "bars" }, bar));
      row.addEventListener("click", () => go(test, view.name));
      body.append(row);
    }
    const head = el("thead", {}, el("tr", {}, el("th", {}, "view, worst first"), ...columns.map(([, label]) => el("th", {}, label)), el("th", { class: "bars" })));
    $("tables").append(el("h3", {}, title), el("div", { class: "scroll", tabindex: "0" }, el("table", {}, head, body)));
  }
}

function showNotes({ notes }) {
  $("found").hidden = notes.length === 0;
  $("notes").replaceChildren(...notes.map((note) => el("li", {}, note)));
}

function showRun(facts) {
  const text = (value) => (typeof value === "string" ? value : JSON.stringify(value));
  const rows = [
    ["Limpid", facts.version], ["backend", facts.backend], ["seed", facts.settings.seed], ["iterations", whole(facts.iterations)],
    ["training", duration(facts.seconds)], ["Gaussians", `${whole(facts.gaussians - facts.movers)} static, ${whole(facts.movers)} dynamic`],
  ];
  const { metrics } = facts;
  if (isNumber(metrics?.shutter)) rows.push(["shutter", `${decimals(metrics.shutter, 2)} frames`], ["aperture", `${decimals(metrics.aperture, 4)} scene units`]);
  const pairs = (list) => el("table", { class: "pair" }, el("tbody", {}, ...list.map(([key, value]) => el("tr", {}, el("td", {}, key), el("td", {}, value)))));
  const about = $("about");
  const open = about.querySelector("details")?.open;
  // A run that was changed on its way had another beginning than such a one has.
  const again = facts.changes.length ? "A run that has from its beginning what this one had in the end" : "The same run again";
  about.replaceChildren(pairs(rows), el("h3", {}, `${again}, from the folder that holds the scene`), el("pre", {}, facts.command));
  for (const heading of about.querySelectorAll("h3")) heading.style.marginTop = "1.4rem";
  if (facts.others.length) {
    about.append(el("h3", {}, "Settings that are not the default"), pairs(facts.others.map(({ setting, value, default: usual }) => [setting, `${text(value)} (default ${text(usual)})`])));
  }
  if (facts.changes.length) {
    about.append(el("h3", {}, "Changed on the way"), pairs(facts.changes.map(({ iteration, setting, from, to }) => [setting, `${text(to)} in the place of ${text(from)}, after iteration ${whole(iteration)}`])));
  }
  about.append(el("details", open ? { open: "" } : {}, el("summary", {}, "All settings"), el("pre", {}, JSON.stringify(facts.settings, null, 2))));
}
