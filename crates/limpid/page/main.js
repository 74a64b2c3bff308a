// Puts the report together.

const report = { facts: readJson("facts"), gallery: readJson("gallery"), viewer: null, wipe: null, ready: null };

function showHead({ name, metrics, iterations, seconds, gaussians, version }) {
  $("title").textContent = name;
  const parts = [`${whole(gaussians)} Gaussians`, `${whole(iterations)} iterations in ${duration(seconds)}`];
  if (isNumber(metrics?.test?.psnr)) parts.unshift(`test PSNR ${decimals(metrics.test.psnr, 2)} dB`);
  $("summary").textContent = parts.join(" · ");
  $("footer").textContent = `Made by Limpid ${version}. This page is one file and asks no network.`;
}

async function showScene(facts) {
  try {
    const scene = readSplats(await splatBytes(facts.side_file));
    report.viewer = new Viewer(facts, scene);
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches || location.hash;
    if (!still) report.viewer.play();
  } catch (problem) {
    $("message").textContent = problem.message;
    $("message").hidden = false;
    $("hint").hidden = true;
    const { width, height } = facts.train[0];
    $("stage").style.aspectRatio = `${width} / ${height}`;
  }
}

function goTo(index) {
  if (!report.viewer) return;
  report.viewer.pause();
  report.viewer.jump(index);
  $("scene").scrollIntoView({ behavior: "smooth" });
}

report.ready = (async () => {
  const { facts, gallery } = report;
  showHead(facts);
  // The rest first has its place, then the scene comes: nothing jumps.
  await showScene(facts);
  report.wipe = new Wipe([{ name: facts.name, facts, gallery }], report.viewer && goTo);
  showBlur(report.wipe);
  showCurves(facts);
  showScores(facts.metrics, (test, name) => {
    const index = report.wipe.views.findIndex((view) => view.test === test && view.name === name);
    if (index < 0) return;
    report.wipe.set(index);
    $("frames").scrollIntoView({ behavior: "smooth" });
  });
  showNotes(facts);
  showRun(facts);
})();
