//! All runs of a plan on this machine, side by side.

use crate::children::Children;
use crate::error::LabError;
use crate::execute::{Failed, Outcome, execute, progress};
use crate::plan::{Plan, PlannedRun};
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::io::IsTerminal as _;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// What became of a study's runs.
#[derive(Debug, Default)]
pub struct Tally {
    /// Trained to their end now.
    pub finished: usize,
    /// There already.
    pub there: usize,
    /// Not begun or not finished, since all was ended or another process is at them.
    pub left: usize,
    /// Died.
    pub failed: Vec<(PlannedRun, Failed)>,
}

/// What a worker tells.
enum Event {
    Began(usize),
    Ended(usize, Result<Outcome, LabError>),
}

/// Works through a plan with so many runs at a time. `say` prints a line.
///
/// # Errors
/// Files of the laboratory cannot be written, or the program cannot be started; what is running is asked to end.
pub fn run_all(
    plan: &Plan,
    jobs: usize,
    children: &Children,
    say: impl Fn(&str),
) -> Result<Tally, LabError> {
    let next = AtomicUsize::new(0);
    let (events, told) = channel();
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, plan.runs.len().max(1)) {
            let events = events.clone();
            scope.spawn(|| work(plan, &next, children, events));
        }
        drop(events);
        let mut line = Line::new(plan);
        let mut tally = Tally {
            left: plan.runs.len(),
            ..Tally::default()
        };
        let mut error = None;
        loop {
            match told.recv_timeout(Duration::from_millis(500)) {
                Ok(Event::Began(index)) => line.began(index),
                Ok(Event::Ended(index, outcome)) => {
                    let run = &plan.runs[index];
                    line.ended(index, outcome.as_ref().ok());
                    match outcome {
                        Ok(outcome) => {
                            let is_news = outcome != Outcome::WasThere;
                            if let Some(text) = count(&mut tally, run, outcome) {
                                line.aside(&say, &text);
                            }
                            if is_news {
                                line.plain(&say, &tally);
                            }
                        }
                        Err(problem) => {
                            children.stop();
                            error.get_or_insert(problem);
                        }
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            line.show(&tally);
        }
        line.bar.finish_and_clear();
        error.map_or(Ok(tally), Err)
    })
}

/// Takes one run after the other until none is left.
fn work(plan: &Plan, next: &AtomicUsize, children: &Children, events: Sender<Event>) {
    while !children.are_stopped() {
        let index = next.fetch_add(1, Ordering::Relaxed);
        let Some(run) = plan.runs.get(index) else {
            return;
        };
        // Who listens is there until all workers have ended.
        events.send(Event::Began(index)).ok();
        let outcome = execute(run, &plan.program, children);
        events.send(Event::Ended(index, outcome)).ok();
    }
}

/// Counts an outcome; the text is what the user has to know at once.
fn count(tally: &mut Tally, run: &PlannedRun, outcome: Outcome) -> Option<String> {
    match outcome {
        Outcome::Finished => tally.finished += 1,
        Outcome::WasThere => tally.there += 1,
        Outcome::Stopped => return None,
        Outcome::Elsewhere => {
            let what = describe(run);
            return Some(format!(
                "{what}: another process is at it; left to that one"
            ));
        }
        Outcome::Failed(failed) => {
            let text = failure(run, &failed);
            tally.failed.push((run.clone(), failed));
            tally.left -= 1;
            return Some(text);
        }
    }
    tally.left -= 1;
    None
}

/// A run in the study's words.
fn describe(run: &PlannedRun) -> String {
    let PlannedRun {
        id,
        scene,
        arms,
        seed,
        ..
    } = run;
    format!("{scene}, {}, seed {seed} ({id})", arms.join(" and "))
}

/// What is said of a run that died.
#[must_use]
pub fn failure(run: &PlannedRun, failed: &Failed) -> String {
    let mut text = format!("failed: {}: {}", describe(run), failed.how);
    for line in &failed.last_lines {
        text.push_str("\n    ");
        text.push_str(line);
    }
    text
}

/// The one line about all runs: a bar on a terminal, a line after each run elsewhere.
struct Line<'a> {
    plan: &'a Plan,
    bar: ProgressBar,
    began: Instant,
    /// Runs that are running, and the iterations that they had when they began here.
    running: BTreeMap<usize, usize>,
    /// Iterations of runs that have ended, whether done here or before.
    settled: usize,
    /// Of these, done here.
    here: usize,
}

impl<'a> Line<'a> {
    fn new(plan: &'a Plan) -> Self {
        let bar = if std::io::stderr().is_terminal() {
            ProgressBar::new(plan.runs.iter().map(|run| run.iterations as u64).sum())
        } else {
            ProgressBar::hidden()
        };
        let style = ProgressStyle::with_template("{bar:30} {percent} % {msg}");
        bar.set_style(style.expect("the template is valid"));
        Self {
            plan,
            bar,
            began: Instant::now(),
            running: BTreeMap::new(),
            settled: 0,
            here: 0,
        }
    }

    fn began(&mut self, index: usize) {
        self.running.insert(index, progress(&self.plan.runs[index]));
    }

    fn ended(&mut self, index: usize, outcome: Option<&Outcome>) {
        let before = self.running.remove(&index).unwrap_or(0);
        let iterations = self.plan.runs[index].iterations;
        self.settled += iterations;
        if outcome == Some(&Outcome::Finished) {
            self.here += iterations.saturating_sub(before);
        }
    }

    /// Iterations that are done, and those done since the start.
    fn done(&self) -> (usize, usize) {
        let running = self.running.iter().map(|(index, before)| {
            let done = progress(&self.plan.runs[*index]);
            (done, done.saturating_sub(*before))
        });
        running.fold((self.settled, self.here), |(all, here), (done, new)| {
            (all + done, here + new)
        })
    }

    fn message(&self, tally: &Tally) -> (usize, String) {
        let (done, here) = self.done();
        let all: usize = self.plan.runs.iter().map(|run| run.iterations).sum();
        let runs = self.plan.runs.len();
        let ended = runs - tally.left;
        let left = if tally.left == 0 {
            "done".to_owned()
        } else {
            time_left(self.began.elapsed(), here, all.saturating_sub(done))
        };
        let failed = match tally.failed.len() {
            0 => String::new(),
            n => format!(" ({n} failed)"),
        };
        (done, format!("{ended}/{runs} runs{failed} · {left}"))
    }

    fn show(&self, tally: &Tally) {
        if !self.bar.is_hidden() {
            let (done, text) = self.message(tally);
            self.bar.set_position(done as u64);
            self.bar.set_message(text);
        }
    }

    fn plain(&self, say: &impl Fn(&str), tally: &Tally) {
        if self.bar.is_hidden() {
            say(&self.message(tally).1);
        }
    }

    fn aside(&self, say: &impl Fn(&str), text: &str) {
        self.bar.suspend(|| say(text));
    }
}

/// How long the rest takes at the pace so far.
fn time_left(elapsed: Duration, done: usize, left: usize) -> String {
    if done == 0 && left > 0 {
        return "time left not known yet".to_owned();
    }
    let seconds = elapsed.as_secs_f64() * left as f64 / done.max(1) as f64;
    let minutes = (seconds / 60.0).round() as u64;
    match (minutes / 60, minutes % 60) {
        (0, 0) => "less than a minute left".to_owned(),
        (0, minutes) => format!("{minutes} min left"),
        (hours, minutes) => format!("{hours} h {minutes} min left"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_goes_by_the_pace() {
        let minute = Duration::from_secs(60);
        for (done, left, expected) in [
            (0, 100, "time left not known yet"),
            // Pictures and scores are still being written.
            (100, 0, "less than a minute left"),
            (0, 0, "less than a minute left"),
            (100, 10, "less than a minute left"),
            (100, 300, "3 min left"),
            (100, 12_500, "2 h 5 min left"),
        ] {
            assert_eq!(time_left(minute, done, left), expected);
        }
    }
}
