//! How far a run is: a bar on a terminal, a line now and then elsewhere.

use crate::say::say;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};
use trainer::StepReport;

/// Lines of a run whose output is no terminal.
const LINES: usize = 20;
/// The pace is that of the last part of a run that took so long: an iteration costs more once blur is modelled.
const LOOKED_BACK: Duration = Duration::from_secs(20);

/// Names what is done before and after training, where it takes seconds; on a terminal until it is over.
pub(crate) fn during<T>(what: &'static str, work: impl FnOnce() -> T) -> T {
    if !std::io::stderr().is_terminal() {
        say!("{what} …");
        return work();
    }
    let spinner = ProgressBar::with_draw_target(None, target());
    spinner.set_style(style("{spinner} {msg} … {elapsed}"));
    spinner.set_message(what);
    spinner.enable_steady_tick(Duration::from_millis(200));
    let done = work();
    spinner.finish_and_clear();
    done
}

/// The iterations of a run.
pub(crate) struct Progress {
    bar: ProgressBar,
    plain: bool,
    iterations: usize,
    pace: Pace,
    psnr: f64,
}

impl Progress {
    /// Of a run that has done `from` of its iterations.
    pub(crate) fn new(from: usize, iterations: usize) -> Self {
        let bar = ProgressBar::with_draw_target(Some(iterations as u64), target());
        bar.set_style(style("{bar:16} {pos}/{len} {msg}"));
        bar.set_position(from as u64);
        Self {
            bar,
            plain: !std::io::stderr().is_terminal(),
            iterations,
            pace: Pace::new(from, Instant::now()),
            psnr: f64::NAN,
        }
    }

    /// After an iteration.
    pub(crate) fn show(&mut self, report: &StepReport) {
        if let Some(decided) = &report.decided {
            self.bar.suspend(|| say!("{decided}"));
        }
        let StepReport {
            iteration,
            loss,
            psnr,
            gaussians,
            ..
        } = report;
        self.psnr = if self.psnr.is_nan() {
            *psnr
        } else {
            0.9 * self.psnr + 0.1 * psnr
        };
        self.pace.went_to(*iteration, Instant::now());
        let left = self.pace.seconds(self.iterations - iteration);
        self.bar.set_position(*iteration as u64);
        self.bar.set_message(format!(
            "PSNR {:.1} dB · {gaussians} Gaussians · {left:.0} s left",
            self.psnr
        ));
        let every = (self.iterations / LINES).max(1);
        if self.plain && (iteration.is_multiple_of(every) || *iteration == self.iterations) {
            say!(
                "{iteration}/{} loss {loss:.4} · PSNR {psnr:.1} dB · {gaussians} Gaussians · mean PSNR {:.1} dB · {left:.0} s left",
                self.iterations,
                self.psnr
            );
        }
    }

    /// Says a line without disturbing the bar.
    pub(crate) fn say(&self, line: &str) {
        self.bar.suspend(|| say!("{line}"));
    }

    /// Takes the bar away.
    pub(crate) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

fn target() -> ProgressDrawTarget {
    if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).expect("the template is valid")
}

/// How long an iteration takes of late.
struct Pace {
    /// Where the run was, and when: in equal steps of time, the last [`LOOKED_BACK`] and what was last before them.
    marks: Vec<(usize, Instant)>,
    now: (usize, Instant),
}

impl Pace {
    fn new(iteration: usize, now: Instant) -> Self {
        Self {
            marks: vec![(iteration, now)],
            now: (iteration, now),
        }
    }

    fn went_to(&mut self, iteration: usize, now: Instant) {
        self.now = (iteration, now);
        let last = self.marks[self.marks.len() - 1].1;
        if now - last >= LOOKED_BACK / 10 {
            self.marks.push(self.now);
        }
        while self.marks.len() > 1 && now - self.marks[1].1 >= LOOKED_BACK {
            self.marks.remove(0);
        }
    }

    /// Of so many iterations.
    fn seconds(&self, iterations: usize) -> f64 {
        let (from, since) = self.marks[0];
        let done = (self.now.0 - from).max(1) as f64;
        (self.now.1 - since).as_secs_f64() / done * iterations as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_is_told_by_the_last_part() {
        let start = Instant::now();
        let mut pace = Pace::new(100, start);
        assert_eq!(pace.seconds(50), 0.0, "nothing is known yet");
        // A hundred iterations of 0.1 s, and then of 0.4 s.
        let mut now = start;
        for it in 101..=200 {
            now += Duration::from_millis(100);
            pace.went_to(it, now);
        }
        assert!(
            (pace.seconds(10) - 1.0).abs() < 1e-9,
            "{}",
            pace.seconds(10)
        );
        for it in 201..=260 {
            now += Duration::from_millis(400);
            pace.went_to(it, now);
        }
        assert!((pace.seconds(10) - 4.0).abs() < 0.2, "{}", pace.seconds(10));
        assert!(pace.marks.len() < 15, "few are kept");
    }
}
