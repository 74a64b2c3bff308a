// The report of a run that is being trained: shows its next snapshot when there is one, and keeps time, view and edge.

/** How often it is looked for, ms. */
const LOOK_EVERY = 2000;

/** Looks for snapshots until training ends; `show(facts, gallery, scene)` is given each. */
function followTraining(facts, show) {
  if (!facts.live) return;
  let known = facts.live.snapshot;
  let lost = 0;
  const tell = (text) => {
    $("live").hidden = false;
    $("live").textContent = text;
  };
  const told = ({ live, iterations }) => `being trained: iteration ${whole(iterations)} of ${whole(live.iterations)}; this page follows by itself`;
  const look = async () => {
    try {
      const head = await fetch(location.pathname, { method: "HEAD", cache: "no-store" });
      if (head.headers.get("ETag") !== `"${known}"`) {
        const reply = await fetch(location.pathname, { cache: "no-store" });
        const page = new DOMParser().parseFromString(await reply.text(), "text/html");
        const next = readJson("facts", page);
        if (!isSameRun(facts, next)) {
          location.reload();
          return;
        }
        facts = next;
        show(facts, readJson("gallery", page), readSplats(await splatBytes(facts.side_file, page)));
        known = facts.live?.snapshot;
      }
      lost = 0;
      tell(facts.live ? told(facts) : "trained: this is the run's report, which lies in its folder");
    } catch {
      lost++;
      if (lost > 2) tell(`this was iteration ${whole(facts.iterations)}; the training process does not answer any more`);
    }
    if (facts.live) setTimeout(look, LOOK_EVERY);
  };
  tell(told(facts));
  setTimeout(look, LOOK_EVERY);
}

/** Whether two pages show the same views: another process may serve where the first one did. */
function isSameRun(one, other) {
  const views = ({ name, train, test }) => JSON.stringify([name, ...[train, test].map((list) => list.map((view) => [view.name, view.width, view.height]))]);
  return views(one) === views(other);
}
