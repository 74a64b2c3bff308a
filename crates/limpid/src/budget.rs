//! How long a run takes: as many iterations as fit into a time, and what a run will take as it is. All of it is measured in this
//! very run: no machine's speed is known beforehand.

use crate::failure::Failure;
use crate::memory::mib;
use crate::progress::duration;
use std::time::Instant;
use trainer::{BlurModel, Course, Settings, Trainer};

/// The first iterations of a part of a run take longer, and do not count.
const WARM: usize = 5;
/// So many behind them do.
const TIMED: usize = 20;
/// Trying a longer run until its first trial is over may take this share of the time that is left.
const TRIED: f64 = 0.25;
/// Where no trial was timed: one looks at each frame as long as so many iterations do, about.
const TRIAL_LOOKS: f64 = 4.0;
/// Kernels over the camera begin in the middle of a run, where nobody tries: a run is so many times longer for them (RESULTS.md).
const KERNELS_ON_TOP: f64 = 1.2;
/// What is aimed at: iterations become a little slower while Gaussians are added.
const AIM: f64 = 0.93;
/// At the end each picture is rendered, encoded and scored, which takes so many times what rendering it takes, about.
const SHOWN: f64 = 2.5;

/// Gives a run that is to begin as many iterations as fit into some minutes since `began`, no more than it was to have. Says how
/// many, and what to expect of them.
pub(crate) fn fit(
    trainer: &mut Trainer,
    minutes: f64,
    began: Instant,
) -> Result<Vec<String>, Failure> {
    let (start, most) = (trainer.start(), trainer.settings().iterations);
    let least = Trainer::LEAST_ITERATIONS;
    let (total, up) = (60.0 * minutes, began.elapsed().as_secs_f64());

    trainer.begin_again(&start, least)?;
    let course = trainer.course(least)?;
    let far = course.blur_trained_from.unwrap_or(0) + WARM + TIMED;
    let mut tried = Tried::of(trainer, far.min(least), &course)?;
    let left = |ending: f64| AIM * (total - began.elapsed().as_secs_f64()) - ending;
    let mut chosen = tried.longest(trainer, least, most, left(tried.ending))?;

    // The camera may become cheaper or dearer at its first trial, but not in the same way in a run that is much shorter.
    let course = trainer.course(chosen)?;
    if chosen < most
        && let Some(trial) = course.trials.first()
    {
        let far = trial + 1 + WARM + TIMED;
        if far < chosen && tried.seconds(far, &course) < TRIED * left(tried.ending) {
            trainer.begin_again(&start, chosen)?;
            tried = Tried::of(trainer, far, &course)?;
            chosen = tried.longest(trainer, least, most, left(tried.ending))?;
        }
    }
    let needed = tried.seconds(chosen, &trainer.course(chosen)?) + tried.ending;
    let spent = began.elapsed().as_secs_f64();
    trainer.begin_again(&start, chosen)?;
    let blurred = course.blur_trained_from.map_or_else(String::new, |_| {
        format!(" ({:.3} s where a model of blur is trained)", tried.settled)
    });
    let fits = spent + needed <= total;
    let mut lines = vec![format!(
        "{chosen} iterations{}: at {:.3} s an iteration{blurred} on {} threads about {} with pictures and scores, \
         behind {} of reading and placing and {} of trying",
        if chosen < most {
            format!(" in the place of {most}")
        } else if fits {
            " fit, as many as were asked for".to_owned()
        } else {
            String::new()
        },
        tried.sharp,
        rayon::current_num_threads(),
        duration(needed),
        duration(up),
        duration(spent - up),
    )];
    if !fits {
        lines.push(format!(
            "warning: that is more than {}, but no run is shorter than {least} iterations; a larger --downscale makes each faster",
            duration(total)
        ));
    }
    if chosen < most {
        lines.push(expected_loss(chosen).to_owned());
    }
    Ok(lines)
}

/// What to expect of the length of a run, by what is in RESULTS.md (What a shorter run loses).
fn expected_loss(iterations: usize) -> &'static str {
    match iterations {
        3000.. => {
            "no loss is expected against longer runs: 5,000 iterations gained 0.2 dB at most where frames are blurred"
        }
        2000.. => "a loss of up to 0.4 dB against 3,000 iterations is expected",
        1000.. => "a loss of up to 1.5 dB against 3,000 iterations is expected",
        500.. => "a loss of 0.8 to 2.9 dB against 3,000 iterations is expected",
        _ => "a loss of 1.5 to 7 dB against 3,000 iterations is expected",
    }
}

/// What runs with such settings would take, by the first iterations of one; the trainer has made them then.
pub(crate) fn foretell(trainer: &mut Trainer, runs: &[Settings]) -> Result<Vec<f64>, Failure> {
    let seconds = timed(trainer, WARM + TIMED)?;
    let frames = trainer.run().views().train.len();
    let one = |settings: &Settings| {
        let course = trainer.course_with(settings)?;
        Ok(Tried::by(&seconds, &course, frames).seconds(settings.iterations, &course))
    };
    runs.iter().map(one).collect()
}

/// Trains so many iterations, and says how many seconds each took.
fn timed(trainer: &mut Trainer, iterations: usize) -> Result<Vec<f64>, Failure> {
    let mut seconds = Vec::with_capacity(iterations);
    for _ in 0..iterations {
        let before = Instant::now();
        trainer.step()?;
        seconds.push(before.elapsed().as_secs_f64());
    }
    Ok(seconds)
}

/// Seconds that parts of a run take, as tried.
#[derive(Clone, Copy, Debug)]
struct Tried {
    /// An iteration before a model of blur is trained.
    sharp: f64,
    /// One behind that, before the first trial.
    blurred: f64,
    /// One behind the first trial.
    settled: f64,
    /// A trial.
    trial: f64,
    /// Pictures, scores and report.
    ending: f64,
}

impl Tried {
    /// Trains so many iterations, and looks at a view.
    fn of(trainer: &mut Trainer, iterations: usize, course: &Course) -> Result<Self, Failure> {
        let seconds = timed(trainer, iterations)?;
        let views = trainer.run().views();
        let before = Instant::now();
        trainer.run().render_training_view(views.train.len() / 2)?;
        let pictures = views.train.len() + views.test.len();
        let ending = SHOWN * pictures as f64 * before.elapsed().as_secs_f64();
        let mut tried = Self::by(&seconds, course, views.train.len());
        if matches!(trainer.model().blur, BlurModel::Both(_)) {
            tried.settled *= KERNELS_ON_TOP;
        }
        Ok(Self { ending, ..tried })
    }

    /// By the seconds of the first iterations of such a run; those of parts that these do not reach are foretold.
    fn by(seconds: &[f64], course: &Course, frames: usize) -> Self {
        let done = seconds.len();
        let from = course.blur_trained_from.unwrap_or(done).min(done);
        let trial = course.trials.first().copied().filter(|t| t + 1 < done);
        let mean = |from: usize, until: usize| {
            let from = (from + WARM).min(until.saturating_sub(1));
            let part = &seconds[from..until];
            (!part.is_empty()).then(|| part.iter().sum::<f64>() / part.len() as f64)
        };
        let blurred = mean(from, trial.unwrap_or(done)).filter(|_| from < done);
        let sharp = mean(0, from).or(blurred).unwrap_or(0.0);
        let blurred = blurred.unwrap_or(sharp * course.blur_pace);
        let settled = trial.and_then(|t| mean(t + 1, done)).unwrap_or(blurred);
        let trial = trial.map(|t| (seconds[t] - settled).max(0.0));
        Self {
            sharp,
            blurred,
            settled,
            trial: trial.unwrap_or_else(|| supposed_trial(frames, blurred)),
            ending: 0.0,
        }
    }

    /// Of so many iterations of a run with such a course.
    fn seconds(&self, iterations: usize, course: &Course) -> f64 {
        let from = course
            .blur_trained_from
            .unwrap_or(iterations)
            .min(iterations);
        let trial = course.trials.first().copied().unwrap_or(iterations);
        let trial = trial.clamp(from, iterations);
        let trials = course.trials.iter().filter(|t| **t < iterations).count();
        from as f64 * self.sharp
            + (trial - from) as f64 * self.blurred
            + (iterations - trial) as f64 * self.settled
            + trials as f64 * self.trial
    }

    /// The longest run that takes no more than so many seconds; the shortest there is where none does.
    fn longest(
        &self,
        trainer: &Trainer,
        least: usize,
        most: usize,
        seconds: f64,
    ) -> Result<usize, Failure> {
        largest(least, most, |n| {
            Ok(self.seconds(n, &trainer.course(n)?) <= seconds)
        })
    }
}

/// Seconds of a trial that looks at so many frames, where none was timed.
fn supposed_trial(frames: usize, pace: f64) -> f64 {
    TRIAL_LOOKS * frames as f64 * pace
}

/// The largest number from `least` to `most` that fits, where all below one that fits do; `least` where none does.
fn largest(
    least: usize,
    most: usize,
    mut fits: impl FnMut(usize) -> Result<bool, Failure>,
) -> Result<usize, Failure> {
    let (mut low, mut high) = (least, most.max(least));
    while low < high {
        let middle = (low + high).div_ceil(2);
        if fits(middle)? {
            low = middle;
        } else {
            high = middle - 1;
        }
    }
    Ok(low)
}

/// Tells behind the first iterations of a run how long it will take, about, and then of its part with blur and of that behind its
/// first trial, as measured.
pub(crate) struct Forecast {
    /// The iterations behind which these parts begin, the next one last.
    parts: Vec<usize>,
    course: Course,
    /// How many frames a trial looks at; `None` where a law for the CPU says nothing.
    frames: Option<usize>,
    /// When the iteration before was over.
    before: Option<Instant>,
    /// When the first iterations of the part were over.
    warm: Option<Instant>,
    /// What the last trial took, seconds.
    trial: Option<f64>,
    /// Trials among the iterations that count of the part, and what they took, seconds.
    among: (usize, f64),
    iterations: usize,
    /// What else there is to say behind the first part.
    besides: String,
}

impl Forecast {
    /// Of a run as it is now, and its memory where it trains on the CPU; with a remark on the times that it foretells.
    pub(crate) fn new(
        trainer: &Trainer,
        memory: Option<u64>,
        remark: &str,
    ) -> Result<Self, Failure> {
        let iterations = trainer.settings().iterations;
        let frames = memory.map(|_| trainer.run().views().train.len());
        let limit = if trainer.limits_gaussians() {
            "at its peak"
        } else {
            "with as many Gaussians as now, of which there is no limit"
        };
        let memory = memory.map_or_else(String::new, |bytes| {
            format!(", and about {} MiB of memory {limit}", mib(bytes))
        });
        // A run that was made longer keeps the moments of the one that was started.
        let course = trainer.course(trainer.schedule().iterations)?;
        let (done, length) = (trainer.iteration(), (iterations, frames));
        Ok(Self {
            besides: memory + remark,
            ..Self::of(done, length, course)
        })
    }

    /// Of a run of so many iterations, of so many frames, that begins, or goes on, behind `done`.
    fn of(done: usize, (iterations, frames): (usize, Option<usize>), course: Course) -> Self {
        let mut parts = vec![done];
        let first_trial = course.trials.first().map(|trial| trial + 1);
        for part in course.blur_trained_from.into_iter().chain(first_trial) {
            if parts.last().is_some_and(|last| part > last + WARM + TIMED) {
                parts.push(part);
            } else if parts.len() == 1 && part > done {
                // Too little is left of the part that a run goes on in: what it takes says nothing.
                parts[0] = part;
            }
        }
        parts.reverse();
        Self {
            parts,
            course,
            frames,
            before: None,
            warm: None,
            trial: None,
            among: (0, 0.0),
            iterations,
            besides: String::new(),
        }
    }

    /// Seconds of what is left behind an iteration before a model of blur is trained, by what those before it took; `None` off the CPU.
    fn foretold(&self, pace: f64, iteration: usize) -> Option<f64> {
        let all = Tried::by(&[pace], &self.course, self.frames?);
        Some(all.seconds(self.iterations, &self.course) - pace * iteration as f64)
    }

    /// After an iteration, at some moment: a line where there is something to tell.
    pub(crate) fn after(&mut self, iteration: usize, now: Instant) -> Option<String> {
        let before = self.before.replace(now);
        let trials = &self.course.trials;
        if trials.contains(&(iteration - 1)) {
            self.trial = before.map(|before| (now - before).as_secs_f64());
            self.among = (self.among.0 + 1, self.among.1 + self.trial.unwrap_or(0.0));
        }
        let part = *self.parts.last()?;
        if iteration == part + WARM {
            self.warm = Some(now);
            self.among = (0, 0.0);
        }
        if iteration < part + WARM + TIMED {
            return None;
        }
        self.parts.pop();
        let (trials_among, took) = self.among;
        let pace =
            ((now - self.warm?).as_secs_f64() - took) / TIMED.saturating_sub(trials_among) as f64;
        let ahead = trials.iter().filter(|trial| **trial >= iteration);
        let iterating = pace * self.iterations.saturating_sub(iteration) as f64;
        let supposed = self.frames.map(|frames| supposed_trial(frames, pace));
        let trial = self.trial.or(supposed).unwrap_or(0.0);
        let left = duration(iterating + trial * ahead.count() as f64);
        let threads = rayon::current_num_threads();
        let besides = std::mem::take(&mut self.besides);
        let paced = format!("on {threads} threads, at {pace:.3} s an iteration");
        Some(match self.parts.last() {
            Some(next) if !trials.contains(&(next - 1)) => {
                let from = next + 1;
                match self.foretold(pace, iteration) {
                    Some(all) => format!(
                        "expects about {} {paced} and about {:.1} times that once a model of blur is trained (from iteration {from} on){besides}",
                        duration(all),
                        self.course.blur_pace,
                    ),
                    None => format!(
                        "expects at least {left} {paced}, more once a model of blur is trained (from iteration {from} on){besides}"
                    ),
                }
            }
            Some(next) => format!(
                "expects about {left} more {paced}, until a trial finds what blurs these frames (iteration {next}){besides}"
            ),
            None => format!("expects about {left} more {paced}{besides}"),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn course(n: usize) -> Course {
        let from = 250.min(n / 4);
        Course {
            blur_trained_from: Some(from),
            blur_pace: 3.0,
            trials: vec![from + 80, from + 160],
        }
    }

    /// Of a machine with these seconds an iteration, which warms up at the beginning of each part.
    fn paced(iterations: usize, course: &Course) -> Vec<f64> {
        let second = |it: usize| {
            let from = course.blur_trained_from.unwrap_or(usize::MAX);
            let trial = course.trials.first().copied().unwrap_or(usize::MAX);
            let base = match it {
                i if i < from => 0.02,
                i if i < trial => 0.08,
                i if i == trial => 4.0,
                _ => 0.05,
            };
            let begun = [0, from, trial.saturating_add(1)];
            let warms = begun.iter().any(|b| it >= *b && it - b < WARM);
            base * if warms && it != trial { 10.0 } else { 1.0 }
        };
        (0..iterations).map(second).collect()
    }

    #[test]
    fn paces_come_back_from_what_was_timed() {
        let tried = Tried::by(&paced(400, &course(1000)), &course(1000), 16);
        let found = [tried.sharp, tried.blurred, tried.settled, tried.trial];
        for (found, expected) in found.iter().zip([0.02, 0.08, 0.05, 3.95]) {
            assert!((found - expected).abs() < 1e-9, "{tried:?}");
        }
        // Before a trial is timed, what follows is taken to be as dear as what was seen.
        let tried = Tried::by(&paced(75, &course(200)), &course(200), 16);
        assert!((tried.settled - 0.08).abs() < 1e-9, "{tried:?}");
        assert!(tried.trial > 1.0, "{tried:?}");
        let never = Course {
            blur_trained_from: None,
            blur_pace: 1.0,
            trials: Vec::new(),
        };
        let tried = Tried::by(&paced(25, &never), &never, 16);
        assert!((tried.settled - 0.02).abs() < 1e-9, "{tried:?}");
        assert!((tried.seconds(1000, &never) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn the_longest_run_that_fits_is_found() {
        let tried = Tried::by(&paced(400, &course(1000)), &course(1000), 16);
        for seconds in [0.0, 5.0, 60.0, 600.0, 1e9] {
            let fits = |n: usize| tried.seconds(n, &course(n)) <= seconds;
            let found = largest(200, 40_000, |n| Ok(fits(n))).expect("a number");
            let expected = (200..=40_000).rev().find(|n| fits(*n)).unwrap_or(200);
            assert_eq!(found, expected, "{seconds} s");
        }
    }

    #[test]
    fn a_run_tells_what_it_will_take_once_a_part() {
        let start = Instant::now();
        let mut forecast = Forecast::of(0, (1000, None), course(1000));
        let mut now = start;
        let mut said = Vec::new();
        for it in 1..=1000 {
            now += Duration::from_millis(match it {
                ..=250 => 20,
                251..=330 => 80,
                331 => 4000,
                _ => 50,
            });
            said.extend(forecast.after(it, now).map(|line| (it, line)));
        }
        assert_eq!(said.len(), 3, "{said:?}");
        assert!(
            said[0].0 < 250 && said[0].1.contains("at least 20 s"),
            "{said:?}"
        );
        assert!(said[0].1.contains("iteration 251"), "{said:?}");
        assert!(
            said[1].0 > 250 && said[1].1.contains("about 58 s more"),
            "{said:?}"
        );
        assert!(said[1].1.contains("iteration 331"), "{said:?}");
        // 644 iterations, and another trial.
        assert!(
            said[2].0 > 331 && said[2].1.contains("about 36 s more"),
            "{said:?}"
        );
        // The same where a law says what blur will cost: 225 iterations, 750 with blur and two trials of 16 frames.
        let mut forecast = Forecast::of(0, (1000, Some(16)), course(1000));
        let mut now = start;
        let mut first = (1..=25).filter_map(|it| {
            now += Duration::from_millis(20);
            forecast.after(it, now)
        });
        let first = first.next().expect("a line");
        let law =
            "at 0.020 s an iteration and about 3.0 times that once a model of blur is trained";
        assert!(
            first.contains("expects about 57 s") && first.contains(law),
            "{first}"
        );
        // A trial among the iterations that count is no part of their pace.
        let soon = Course {
            blur_trained_from: Some(100),
            blur_pace: 3.0,
            trials: vec![116],
        };
        let mut forecast = Forecast::of(0, (400, None), soon);
        let mut now = start;
        let last = (1..=400).filter_map(|it| {
            now += Duration::from_millis(match it {
                ..=100 => 20,
                117 => 960,
                _ => 80,
            });
            forecast.after(it, now)
        });
        let last = last.last().expect("a line");
        assert!(last.contains("about 22 s more"), "275 iterations: {last}");
        // What goes on behind all of that has one part.
        let later = Forecast::of(600, (1000, None), course(1000));
        assert_eq!(later.parts, [600]);
        // What goes on shortly before a part says nothing of it, and waits.
        let before = Forecast::of(230, (1000, None), course(1000));
        assert_eq!(before.parts, [331, 250]);
    }
}
