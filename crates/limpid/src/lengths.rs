//! Training for as long as it gains: runs of growing length, until one explains pixels that no run is shown hardly better than the
//! one before, which had half as many iterations.

use crate::failure::Failure;
use trainer::{Start, Trainer};

/// Iterations of the first run.
const FIRST: usize = 750;
/// What twice the length must gain, dB.
const GAIN: f64 = 0.1;
/// Share of the pixels that is held back, where the settings do not say.
pub(crate) const HELD_BACK: f64 = 0.03;

/// The lengths that a run is trained in.
pub(crate) struct Lengths {
    start: Start,
    most: usize,
    /// What the run before came to, dB.
    last: Option<f64>,
}

impl Lengths {
    /// Makes a run that is to begin the first of several.
    pub(crate) fn begin(trainer: &mut Trainer) -> Result<Self, Failure> {
        let (start, most) = (trainer.start(), trainer.settings().iterations);
        trainer.begin_again(&start, FIRST.min(most))?;
        Ok(Self {
            start,
            most,
            last: None,
        })
    }

    /// Begins the next run where the one that has ended gained enough, and says what it came to, and whether there is a next.
    pub(crate) fn next(&mut self, trainer: &mut Trainer) -> Result<(String, bool), Failure> {
        let (iterations, seconds) = (trainer.iteration(), trainer.run().seconds());
        let psnr = trainer.held_back_psnr()?.unwrap_or(f64::NAN);
        let gained = self.last.map(|last| psnr - last);
        self.last = Some(psnr);
        let next = (2 * iterations).min(self.most);
        let came = format!("{iterations} iterations: {psnr:.2} dB of pixels that are held back");
        let came = match gained {
            Some(gained) => format!("{came}, {gained:+.2} dB by twice the length"),
            None => came,
        };
        if gained.is_some_and(|gained| gained < GAIN) || next <= iterations {
            return Ok((format!("{came}: done"), false));
        }
        trainer.begin_again(&self.start, next)?;
        // What was trained before took its time too.
        trainer.count_seconds(seconds);
        Ok((
            format!("{came}: {next} iterations, from the beginning"),
            true,
        ))
    }
}
