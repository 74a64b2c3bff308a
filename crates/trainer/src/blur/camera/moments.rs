//! When the camera's blur begins, and when trials are.

use crate::schedule::PACED_ITERATIONS;

/// Shares of a run, counted from the start of blur, after which other paths and none are tried on every frame…
const TRIALS: [f64; 4] = [0.055, 0.165, 0.275, 0.42];
/// … and how often at least every frame has been seen between two of them: where a run is too short for that, there are fewer…
const VISITS: usize = 5;
/// … and the last, with which the aperture is freed and single paths that do not pay go, is never later than so much of what blur has
/// of the run.
const LATEST_TRIAL: f64 = 2.0 / 3.0;

/// Of fewer frames than this, Gaussians become sharp under whatever paths they are trained with, so that these seem to pay late.
const FRAMES_ASKED_LATE: usize = 8;

/// Iterations after which something begins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Moments {
    /// Frames are exposed.
    pub(super) from: usize,
    /// Other paths are tried on every frame.
    pub(super) trials: Vec<usize>,
    /// The run is so short that focus has not come far by the first of them.
    refocuses: bool,
    /// There are frames enough to tell late whether paths pay.
    asks_late: bool,
}

/// One of the trials.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Trial {
    pub(super) last: bool,
    /// It says what it finds: the first, and the second where paths are left to it.
    pub(super) says: bool,
    /// The run is so short that focus has not come far by now: every frame tries other distances.
    pub(super) refocuses: bool,
    pub(super) asked: Asked,
}

/// When it is asked whether paths pay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Asked {
    /// At the next trial, behind this iteration: by the first, mild ones have not come far.
    Later(usize),
    /// At the first, where there is no other, or where frames are so few that Gaussians become sharp under any paths.
    Early,
    /// Now that Gaussians have sharpened for long.
    Late,
}

impl Moments {
    /// Of a run of n iterations on so many frames.
    pub(super) fn new(n: usize, num_frames: usize) -> Self {
        let from = 250.min(n / 4);
        let of_rest = |share: f64| (share * (n - from) as f64) as usize;
        let (seen, latest) = (VISITS * num_frames, of_rest(LATEST_TRIAL));
        let count = (latest / seen.max(1)).clamp(1, TRIALS.len());
        let trial = |k: usize| from + of_rest(TRIALS[k]).max((k + 1) * seen).min(latest);
        Self {
            from,
            trials: (0..count).map(trial).collect(),
            refocuses: n < PACED_ITERATIONS,
            asks_late: num_frames >= FRAMES_ASKED_LATE,
        }
    }

    /// The trial once `it` iterations are done.
    pub(super) fn trial(&self, it: usize) -> Trial {
        let [first, second, last] = [self.trials.first(), self.trials.get(1), self.trials.last()]
            .map(Option::<&usize>::copied);
        let asked = match second {
            Some(second) if self.asks_late && Some(it) == first => Asked::Later(second),
            Some(_) if self.asks_late => Asked::Late,
            _ => Asked::Early,
        };
        Trial {
            last: Some(it) == last,
            says: Some(it) == first || self.asks_late && Some(it) == second,
            refocuses: Some(it) == first && self.refocuses,
            asked,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_seen_between_trials_in_short_runs_too() {
        for n in [200, 500, 1000, 3000, 40_000] {
            for frames in [1, 6, 16, 24, 60, 150, 300] {
                let moments = Moments::new(n, frames);
                let mut before = moments.from;
                let (first, all) = (moments.trials[0], moments.trials.len());
                for trial in moments.trials {
                    assert!(
                        all == 1 || trial - before >= VISITS * frames,
                        "{n}: {trial} after {before}"
                    );
                    before = trial;
                }
                assert!(first > moments.from, "{n}, {frames}: blur comes first");
                let left = n - before;
                assert!(3 * left >= n - moments.from, "{n}, {frames}: {before}");
            }
        }
        assert_eq!(Moments::new(3000, 24).trials, [401, 703, 1006, 1405]);
        assert_eq!(Moments::new(3000, 150).trials, [1000, 1750]);
        assert_eq!(Moments::new(500, 24).trials, [245, 365]);
        assert_eq!(Moments::new(1000, 300).trials, [750]);
    }

    #[test]
    fn paths_are_left_to_a_second_trial_where_it_can_tell() {
        use Asked::{Early, Late, Later};
        for (n, frames, asked) in [
            (3000, 24, vec![Later(703), Late, Late, Late]),
            (3000, 8, vec![Later(703), Late, Late, Late]),
            (3000, 7, vec![Early; 4]),
            (500, 24, vec![Later(365), Late]),
            (1000, 300, vec![Early]),
        ] {
            let moments = Moments::new(n, frames);
            let trials = moments.trials.iter().map(|it| moments.trial(*it));
            let trials: Vec<_> = trials.collect();
            let found = trials.iter().map(|trial| trial.asked);
            assert_eq!(found.collect::<Vec<_>>(), asked, "{n}, {frames}");
            for (k, trial) in trials.iter().enumerate() {
                let says = k == 0 || k == 1 && asked[1] == Late;
                assert_eq!(trial.says, says, "{n}, {frames}: {k}");
                assert_eq!(trial.last, k + 1 == asked.len(), "{n}, {frames}: {k}");
            }
        }
    }
}
