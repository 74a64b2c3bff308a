//! When checkpoints are written, and where they are found again.

use crate::config::Config;
use crate::failure::{Failure, with_causes};
use crate::say::{detail, say};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use trainer::{CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE, Run, Settings, Trainer};

/// The folder of a run's checkpoints, in that of its results.
pub(crate) const FOLDER: &str = "checkpoint";

/// Whether anything was saved of the run in a folder.
pub(crate) fn are_in(out: &Path) -> bool {
    [CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE]
        .iter()
        .any(|name| out.join(FOLDER).join(name).exists())
}

/// The last checkpoint of the run in a folder.
pub(crate) fn file(out: &Path) -> PathBuf {
    out.join(FOLDER).join(CHECKPOINT_FILE)
}

/// The run in a folder, from its last checkpoint or, where that is damaged, from the one before it.
pub(crate) fn open(out: &Path, config: &Config) -> Result<Run, Failure> {
    let run = Run::open(&out.join(FOLDER), &config.run.backend.device()?)?;
    if let Some(setback) = run.setback() {
        say!(
            "warning: {}; taken is the one before it, {PREVIOUS_CHECKPOINT_FILE}, after iteration {}",
            with_causes(setback),
            run.iteration()
        );
    }
    Ok(run)
}

/// The checkpoints of a run that is being trained.
#[derive(Debug)]
pub(crate) struct Checkpoints {
    folder: PathBuf,
    every: usize,
    /// So long without one is too long.
    longest: Option<Duration>,
    /// When one was written or tried.
    tried: Instant,
    /// Iterations of the last one that was written.
    last: Option<usize>,
}

impl Checkpoints {
    /// Of a run with these results; `last` are the iterations of the checkpoint that it goes on from.
    pub(crate) fn new(out: &Path, settings: &Settings, last: Option<usize>) -> Self {
        let seconds = 60.0 * settings.checkpoint_minutes;
        let longest = Duration::try_from_secs_f64(seconds).ok();
        Self {
            folder: out.join(FOLDER),
            every: settings.checkpoint_every,
            longest: longest.filter(|longest| !longest.is_zero()),
            tried: Instant::now(),
            last,
        }
    }

    /// Whether one is to be written after so many iterations.
    pub(crate) fn is_due(&self, iteration: usize) -> bool {
        let by_time = self.longest.is_some_and(|l| self.tried.elapsed() >= l);
        by_time || self.every > 0 && iteration.is_multiple_of(self.every)
    }

    /// Writes one.
    pub(crate) fn save(&mut self, trainer: &Trainer) -> Result<(), Failure> {
        self.tried = Instant::now();
        trainer.save(&self.folder)?;
        self.last = Some(trainer.iteration());
        detail!(
            "checkpoint after iteration {} in {:.1} s",
            trainer.iteration(),
            self.tried.elapsed().as_secs_f64()
        );
        Ok(())
    }

    /// Writes one on the way, where the folder is `ready` for it: where that fails training goes on.
    pub(crate) fn save_on_the_way(
        &mut self,
        trainer: &Trainer,
        ready: impl FnOnce() -> Result<(), Failure>,
    ) {
        self.tried = Instant::now();
        if let Err(problem) = ready().and_then(|()| self.save(trainer)) {
            let problem = with_causes(&*problem);
            say!(
                "warning: no checkpoint after iteration {}: {problem}; training goes on, and tries again",
                trainer.iteration()
            );
        }
    }

    /// What is left of the run when it ends with an error.
    pub(crate) fn account(&self) -> String {
        match self.last {
            Some(iteration) => format!(
                "the last checkpoint is {}, after iteration {iteration}: --resume goes on from it",
                self.folder.join(CHECKPOINT_FILE).display()
            ),
            None => "no checkpoint was saved yet".to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checkpoints_are_due_by_number_and_by_time() {
        let due = |every, minutes, iteration| {
            let settings = Settings {
                checkpoint_every: every,
                checkpoint_minutes: minutes,
                ..Settings::default()
            };
            Checkpoints::new(Path::new("out"), &settings, None).is_due(iteration)
        };
        assert!(due(20, 0.0, 40) && !due(20, 0.0, 41), "by number");
        assert!(!due(0, 0.0, 40), "never");
        assert!(!due(0, 1000.0, 40), "not yet");
        assert!(due(0, 2e-11, 41), "by time");
        assert!(!due(0, f64::MAX, 41), "longer than time goes");
    }
}
