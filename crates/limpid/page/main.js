// Puts the report together.

const report = { facts: readJson("facts"), gallery: readJson("gallery"), viewer: null, wipe: null, ready: null };

function showHead({ name, metrics, iterations, seconds, gaussians, version, live }) {
  $("title").textContent = name;
  const parts = [`${whole(gaussians)} Gaussians`, `${whole(iterations)} iterations in ${duration(seconds)}`];
  if (isNumber(metrics?.test?.psnr)) parts.unshift(`test PSNR ${decimals(metrics.test.psnr, 2)} dB`);
  $("summary").textContent = parts.join(" · ");
  $("footer").textContent = `Made by Limpid ${version}. ${live ? "The training process serves this page, to this machine alone." : "This page is one file and asks no network."}`;
}

async function showScene(facts) {
  try {
    const scene = readSplats(await splatBytes(facts.side_file));
    report.viewer = new Viewer(facts, scene);
    if (!prefersStill() && !location.hash) report.viewer.play();
  } catch (problem) {
    $("message").textContent = problem.message;
    $("message").hidden = false;
    for (const useless of document.querySelectorAll("#hint, #scene .bar")) useless.hidden = true;
    const { width, height } = facts.train[0];
    $("stage").style.aspectRatio = `${width} / ${height}`;
  }
}

function goTo(index) {
  if (!report.viewer) return;
  report.viewer.pause();
  report.viewer.jump(index);
  bringUp("scene");
}

/** What there is to read, of a run as it is now. */
function showRest(facts) {
  showHead(facts);
  showCurves(facts);
  showScores(facts.metrics, (test, name) => {
    const index = report.wipe.views.findIndex((view) => view.test === test && view.name === name);
    if (!report.wipe.has(index)) return;
    report.wipe.set(index);
    bringUp("frames");
  });
  showNotes(facts);
  showRun(facts);
}

report.ready = (async () => {
  const { facts, gallery } = report;
  const runs = (facts, gallery) => [{ name: facts.name, facts, gallery }];
  showHead(facts);
  // The rest first has its place, then the scene comes: nothing jumps.
  await showScene(facts);
  report.wipe = new Wipe(runs(facts, gallery), report.viewer && goTo);
  showBlur(report.wipe);
  showRest(facts);
  followTraining(facts, (facts, gallery, scene) => {
    Object.assign(report, { facts, gallery });
    report.viewer?.load(facts, scene);
    report.wipe.load(runs(facts, gallery));
    showRest(facts);
  });
})();
