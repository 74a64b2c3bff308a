//! How far a run is: a bar on a terminal, a line now and then elsewhere and in the log.

use crate::say::{Weight, detail, line, say, set_bar, shows_bars};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::time::{Duration, Instant};
use trainer::StepReport;

/// Lines of a run whose output is no terminal.
const LINES: usize = 20;
/// Length of the bar, characters.
const BAR: usize = 12;
/// The pace is that of the last part of a run that took so long: an iteration costs more once blur is modelled.
const LOOKED_BACK: Duration = Duration::from_secs(20);

/// Names what is done before and after training, where it takes seconds; on a terminal until it is over.
pub(crate) fn during<T>(what: &'static str, work: impl FnOnce() -> T) -> T {
    let began = Instant::now();
    let spinner = shows_bars().then(|| {
        let spinner = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        spinner.set_style(style("{spinner} {msg} … {elapsed}"));
        spinner.set_message(what);
        spinner.enable_steady_tick(Duration::from_millis(200));
        spinner
    });
    set_bar(spinner.as_ref());
    line(beside_a_bar(), format_args!("{what} …"));
    let done = work();
    set_bar(None);
    if let Some(spinner) = spinner {
        spinner.finish_and_clear();
    }
    detail!("{what}: {:.1} s", began.elapsed().as_secs_f64());
    done
}

/// How much a line matters that says what a bar shows, where there is one.
fn beside_a_bar() -> Weight {
    if shows_bars() {
        Weight::Detail
    } else {
        Weight::Usual
    }
}

/// The iterations of a run.
pub(crate) struct Progress {
    bar: ProgressBar,
    iterations: usize,
    pace: Pace,
    psnr: f64,
}

impl Progress {
    /// Of a run that has done `from` of its iterations.
    pub(crate) fn new(from: usize, iterations: usize) -> Self {
        let target = if shows_bars() {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(iterations as u64), target);
        bar.set_style(style(&format!("{{bar:{BAR}}} {{pos}}/{{len}} {{msg}}")));
        bar.set_position(from as u64);
        set_bar(Some(&bar));
        Self {
            bar,
            iterations,
            pace: Pace::new(from, Instant::now()),
            psnr: f64::NAN,
        }
    }

    /// After an iteration.
    pub(crate) fn show(&mut self, report: &StepReport) {
        if let Some(decided) = &report.decided {
            say!("{decided}");
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
        self.bar.set_message(message(self.psnr, *gaussians, left));
        let every = (self.iterations / LINES).max(1);
        if iteration.is_multiple_of(every) || *iteration == self.iterations {
            line(
                beside_a_bar(),
                format_args!(
                    "{iteration}/{} loss {loss:.4} · PSNR {psnr:.1} dB · {gaussians} Gaussians · mean PSNR {:.1} dB · {} left",
                    self.iterations,
                    self.psnr,
                    duration(left)
                ),
            );
            let terms = report.terms.iter();
            let terms: Vec<String> = terms
                .map(|(name, value)| format!("{name} {value:.4}"))
                .collect();
            detail!("  of view {}: {}", report.view, terms.join(", "));
        }
    }

    /// Takes the bar away.
    pub(crate) fn finish(&self) {
        set_bar(None);
        self.bar.finish_and_clear();
    }
}

/// What stands beside the bar.
fn message(psnr: f64, gaussians: usize, left: f64) -> String {
    format!(
        "PSNR {psnr:.1} dB · {gaussians} Gaussians · {} left",
        duration(left)
    )
}

/// Seconds as people say them.
pub(crate) fn duration(seconds: f64) -> String {
    if seconds < 120.0 {
        format!("{seconds:.0} s")
    } else if seconds < 7200.0 {
        format!("{:.0} min", seconds / 60.0)
    } else {
        format!("{:.1} h", seconds / 3600.0)
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
    fn the_bar_fits_a_terminal() {
        for (psnr, gaussians, left) in [
            (-10.5, 12_345_678, 359_999.0),
            (f64::NAN, 99_999, 7199.0),
            (123.4, 9_999_999, 119.9),
        ] {
            let counts = " 1000000/1000000 ".len();
            let length = BAR + counts + message(psnr, gaussians, left).chars().count();
            assert!(length <= 80, "{length}");
        }
        assert_eq!(duration(119.4), "119 s");
        assert_eq!(duration(3600.0), "60 min");
        assert_eq!(duration(9000.0), "2.5 h");
    }

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
