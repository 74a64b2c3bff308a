//! Training for as long as it gains: runs of growing length, until one explains pixels that no run is shown hardly better than the
//! one before, which had half as many iterations.

use crate::failure::Failure;
use trainer::{Kept, Start, Trainer};

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
    /// The run before.
    before: Option<Ended>,
}

/// A run that has ended.
struct Ended {
    run: Kept,
    iterations: usize,
    /// Of pixels that are held back, dB.
    psnr: f64,
    /// Its log.
    log: Vec<u8>,
}

/// What comes of a run that has ended.
pub(crate) enum Next {
    /// It stays.
    Done,
    /// One of twice the length has begun.
    Longer,
    /// The trainer has gone back to the one before, whose log this is.
    Before(Vec<u8>),
}

impl Lengths {
    /// Makes a run that is to begin the first of several.
    pub(crate) fn begin(trainer: &mut Trainer) -> Result<Self, Failure> {
        let (start, most) = (trainer.start(), trainer.settings().iterations);
        trainer.begin_again(&start, FIRST.min(most))?;
        Ok(Self {
            start,
            most,
            before: None,
        })
    }

    /// Begins the next run where the one that has ended gained enough and no end `is_asked`, and goes back to the one before where it
    /// lost; with what there is to say. `log` is the log of the one that has ended.
    pub(crate) fn next(
        &mut self,
        trainer: &mut Trainer,
        log: Vec<u8>,
        is_asked: impl FnOnce() -> bool,
    ) -> Result<(String, Next), Failure> {
        let (iterations, seconds) = (trainer.iteration(), trainer.run().seconds());
        let psnr = trainer
            .held_back_psnr()?
            .ok_or("no pixels are held back: frames.held_back is 0")?;
        let mut said =
            format!("{iterations} iterations: {psnr:.2} dB of pixels that are held back");
        let before = self.before.take();
        let gained = before.as_ref().map(|before| psnr - before.psnr);
        if let Some((before, gained)) = before.as_ref().zip(gained) {
            let times = iterations as f64 / before.iterations as f64;
            said += &format!(", {gained:+.2} dB by {times:.2} times the length");
        }
        // An end that is asked for ends the run as it is.
        let most = if is_asked() { iterations } else { self.most };
        match (decision(iterations, most, gained), before) {
            (Decision::Back, Some(before)) => {
                trainer.go_back(before.run);
                trainer.count_seconds(seconds - trainer.run().seconds());
                said += &format!(": back to {}", trainer.iteration());
                Ok((said, Next::Before(before.log)))
            }
            (Decision::Longer(next), _) => {
                let run = trainer.keep();
                self.before = Some(Ended {
                    run,
                    iterations,
                    psnr,
                    log,
                });
                trainer.begin_again(&self.start, next)?;
                // What was trained before took its time too.
                trainer.count_seconds(seconds);
                said += &format!(": {next} iterations, from the beginning");
                Ok((said, Next::Longer))
            }
            _ => Ok((said + ": done", Next::Done)),
        }
    }
}

/// What follows on a run that has ended.
#[derive(Debug, PartialEq)]
enum Decision {
    /// It stays.
    Done,
    /// The one before was better.
    Back,
    /// One of so many iterations.
    Longer(usize),
}

/// What follows on a run of so many iterations, of `most`, by what it gained on the one before, if there is one, dB.
fn decision(iterations: usize, most: usize, gained: Option<f64>) -> Decision {
    let next = (2 * iterations).min(most);
    match gained {
        Some(gained) if gained < 0.0 => Decision::Back,
        Some(gained) if gained < GAIN => Decision::Done,
        _ if next > iterations => Decision::Longer(next),
        _ => Decision::Done,
    }
}

#[cfg(test)]
mod tests {
    use super::{Decision, GAIN, decision};

    #[test]
    fn a_run_becomes_longer_until_it_gains_hardly_anything_and_none_that_loses_stays() {
        assert_eq!(decision(750, 3000, None), Decision::Longer(1500));
        assert_eq!(decision(750, 1000, None), Decision::Longer(1000));
        assert_eq!(decision(1500, 3000, Some(GAIN)), Decision::Longer(3000));
        assert_eq!(decision(1500, 3000, Some(0.9 * GAIN)), Decision::Done);
        assert_eq!(decision(1500, 3000, Some(0.0)), Decision::Done);
        assert_eq!(decision(1500, 3000, Some(-0.01)), Decision::Back);
        // At the limit as well: what is longest is not what is best.
        for (gained, expected) in [
            (None, Decision::Done),
            (Some(1.0), Decision::Done),
            (Some(-1.0), Decision::Back),
        ] {
            assert_eq!(decision(3000, 3000, gained), expected);
        }
    }
}
