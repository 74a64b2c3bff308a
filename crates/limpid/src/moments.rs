//! Moments of the video that a command is about.

use crate::failure::Failure;
use trainer::Run;

/// More moments than this nobody means.
const MOST: f64 = 100_000.0;

/// An even row of moments.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct Moments {
    /// From this time on, in training frames, may be fractional [default: the first frame].
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    from: Option<f32>,
    /// Up to this time [default: the last frame].
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    to: Option<f32>,
    /// So many training frames apart: 1 is the video's own rate, 0.25 four pictures or files for each of its frames.
    #[arg(
        long,
        value_name = "FRAMES",
        default_value_t = 1.0,
        allow_negative_numbers = true
    )]
    step: f64,
}

impl Moments {
    /// Whether any was asked for.
    pub(crate) fn are_given(&self) -> bool {
        self.flags().iter().any(|(_, is_given)| *is_given)
    }

    /// The flags, and whether each was given.
    pub(crate) fn flags(&self) -> [(&'static str, bool); 3] {
        [
            ("--from", self.from.is_some()),
            ("--to", self.to.is_some()),
            ("--step", self.step != 1.0),
        ]
    }

    /// All of them, of which there is at least one.
    pub(crate) fn of(&self, run: &Run) -> Result<Vec<f32>, Failure> {
        let (first, last) = range(run);
        let (from, to) = (self.from.unwrap_or(first), self.to.unwrap_or(last));
        within(run, "--from", from)?;
        within(run, "--to", to)?;
        if from > to {
            return Err(format!("--from {from} is later than --to {to}").into());
        }
        if !(self.step.is_finite() && self.step > 0.0) {
            let step = self.step;
            return Err(format!(
                "--step {step}: moments are a number over 0 of training frames apart"
            )
            .into());
        }
        let (from, to) = (f64::from(from), f64::from(to));
        // A last one that rounding pushes out counts.
        let steps = ((to - from) / self.step + 1e-6).floor();
        if steps >= MOST {
            return Err(format!(
                "--step {}: that would be {} moments",
                self.step,
                steps + 1.0
            )
            .into());
        }
        let at = |k: usize| (from + k as f64 * self.step).min(to) as f32;
        Ok((0..=steps as usize).map(at).collect())
    }
}

/// The first and the last moment of the video.
pub(crate) fn range(run: &Run) -> (f32, f32) {
    let views = run.views().train.iter();
    views.fold((f32::INFINITY, f32::NEG_INFINITY), |(from, to), view| {
        (from.min(view.time), to.max(view.time))
    })
}

/// An error for a time outside of the video, where nothing is known of the scene.
pub(crate) fn within(run: &Run, flag: &str, time: f32) -> Result<(), Failure> {
    let (from, to) = range(run);
    if time >= from && time <= to {
        return Ok(());
    }
    Err(format!("{flag} {time}: the video goes from {from} to {to}, in training frames").into())
}
