// Puts the comparison together: several runs side by side.

const comparison = readJson("comparison");
comparison.wipe = null;

/** A table of text with a column for each run; `rows` are { label, cells, best }. */
function runTable(names, rows) {
  const head = el("thead", {}, el("tr", {}, el("th", {}), ...names.map((name) => el("th", {}, name))));
  const line = ({ label, cells, best }) => el("tr", {}, el("td", {}, label), ...cells.map((cell, k) => el("td", best[k] ? { class: "best" } : {}, cell)));
  return el("table", { class: "runs" }, head, el("tbody", {}, ...rows.map(line)));
}

function showPictures({ facts, pictures, every, runs }) {
  const withPictures = (view, first) => {
    const places = { ...view, ...(runs.length > 1 && isNumber(first.sharp) ? { first: first.sharp } : {}) };
    return Object.fromEntries(Object.entries(places).map(([key, at]) => [key, pictures[at]]));
  };
  const galleryOf = ({ factor, views }) => ({ factor, views: views.map((view, index) => withPictures(view, runs[0].views[index])) });
  const shown = runs.filter((run) => run.views);
  comparison.wipe = new Wipe(shown.map((run) => ({ name: run.name, facts: { ...facts, metrics: run.metrics }, gallery: galleryOf(run) })));
  if (every > 1) $("frames").append(el("p", { class: "figures" }, `To keep this page small, one view in ${every} has its pictures here.`));
}

/** Scores of views, those that all runs together do worst first. */
function showViewScores({ runs, comparable }) {
  const shown = runs.filter((run) => run.views);
  const groups = [["Test views", "test", true], ["Sharp renders of training views", "train_sharp", false]];
  const lists = (key) => shown.map((run) => run.metrics?.[key]?.views ?? []);
  const figures = FIGURES.filter(([figure]) => groups.some(([, key]) => lists(key).flat().some((view) => isNumber(view[figure]))));
  if (figures.length === 0) return;
  $("scores").hidden = false;
  $("figure").append(...figures.map(([figure, label]) => el("option", { value: figure }, label)));
  const show = () => {
    const [figure, , digits] = figures.find(([name]) => name === $("figure").value);
    $("tables").replaceChildren();
    for (const [title, key, test] of groups) {
      const names = [...new Set(lists(key).flat().map((view) => view.name))];
      const rows = names.map((name) => {
        const values = lists(key).map((views) => views.find((view) => view.name === name)?.[figure]);
        const known = values.filter(isNumber);
        const most = decimals(Math.max(...known), digits);
        const cells = values.map((value) => decimals(value, digits));
        const isSpread = comparable && new Set(known.map((value) => decimals(value, digits))).size > 1;
        return { label: name, cells, best: cells.map((cell) => isSpread && cell === most), mean: known.reduce((sum, v) => sum + v, 0) / known.length };
      }).filter((row) => isNumber(row.mean)).sort((a, b) => a.mean - b.mean);
      if (rows.length === 0) continue;
      const table = runTable(shown.map((run) => run.name), rows);
      table.querySelector("th").textContent = "view, worst first";
      [...table.tBodies[0].rows].forEach((line, k) => linkTo(line, rows[k].label, test));
      $("tables").append(el("h3", {}, title), el("div", { class: "scroll", tabindex: "0" }, table));
    }
  };
  $("figure").addEventListener("change", show);
  show();
}

/** A line of a table leads to its view's pictures, where there are any. */
function linkTo(line, name, test) {
  const { wipe } = comparison;
  const view = wipe.views.find((view) => view.test === test && view.name === name);
  if (!view || !wipe.has(view.index)) return;
  line.className = "link";
  line.cells[0].replaceChildren(el("button", { type: "button" }, name));
  line.addEventListener("click", () => {
    wipe.set(view.index);
    bringUp("frames");
  });
}

/** What every run found, and then what each of them alone. */
function showFound({ runs }) {
  const isCommon = (note) => runs.every(({ notes }) => notes.includes(note));
  const groups = [["All runs", runs[0].notes.filter(isCommon)], ...runs.map(({ name, notes }) => [name, notes.filter((note) => !isCommon(note))])];
  for (const [title, notes] of groups) {
    if (notes.length === 0) continue;
    $("found").hidden = false;
    $("notes").append(el("h3", {}, title), el("ul", {}, ...notes.map((note) => el("li", {}, note))));
  }
}

{
  const { runs, warnings, rows, settings, version } = comparison;
  const names = runs.map((run) => run.name);
  $("title").textContent = `${names.length} runs side by side`;
  $("summary").textContent = names.join(" · ");
  $("warnings").hidden = warnings.length === 0;
  $("warnings").append(...warnings.map((warning) => el("li", {}, warning)));
  $("figures").append(runTable(names, rows));
  showPictures(comparison);
  showViewScores(comparison);
  if (settings.length) {
    $("settings").hidden = false;
    $("others").append(runTable(names, settings));
  }
  showFound(comparison);
  $("footer").textContent = `Made by Limpid ${version}. This page is one file and asks no network.`;
}
