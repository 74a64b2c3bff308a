//! Trials: a path that points in a wrong direction, or has shrunk to nothing, does not leave it by itself. A few times in a
//! run every frame tries others, with the Gaussians as they are, and keeps what explains it best.

use super::CameraBlur;
use super::parts::Decision;
use crate::TrainError;
use crate::look::Look;
use crate::settings::When;
use crate::statistics::median;
use crate::tensors::{constant, host, leaf, set_row};
use crate::world::World;
use capture::RIGID;
use std::f64::consts::TAU;
use tracing::trace_span;

/// A path that starts afresh takes the place of a learned one where the frame's error is smaller by more than this share: what is
/// only a little better before the scene is sharp can lead to where no trial gets it out again. (RESULTS.md, "What a trial sees",
/// has what was seen.)
const FRESH_PATH_PAYS: f64 = 0.1;
/// A frame whose error is so many times that of the frame in the middle, 2.5 dB, may have a path that it does not leave by itself.
const NOT_EXPLAINED: f64 = 1.8;
/// A frame whose error is so many times that of the frame in the middle, 6 dB, moves no other: its path does not tell what is the
/// scene's. Less is no reason: where the scene lies wrong, and not the path, none of the frames that show it would hold it. (RESULTS.md,
/// "Frames that were left out drifted off", has what was seen.)
const MOVES_NO_OTHER: f64 = 4.0;
/// A frame's path pays if without it the frame's error is larger by more than this share.
const PATH_PAYS: f64 = 0.01;
/// A frame is tried with up to so many renders or more, however few it is trained with: what a lens explains is not seen through
/// few of its points. (RESULTS.md, "What a trial sees".)
const TRIED_SAMPLES: usize = 16;

/// What a trial came to.
pub(in crate::blur) struct Revised {
    /// Frames whose path changed, and whose focus.
    pub(in crate::blur) paths: Vec<usize>,
    pub(in crate::blur) focuses: Vec<usize>,
    /// Which parts stay and what they were worth, where that is to be said.
    pub(in crate::blur) decision: Option<Decision>,
}

impl CameraBlur {
    /// Tries to do without the lens and without the paths, tries other paths on every frame, and in the end
    /// other apertures: what explains the frames best stays, and what does not pay goes for good. `looks` are those at all
    /// training frames.
    pub(in crate::blur) fn revise(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
    ) -> Result<Revised, TrainError> {
        let _span = trace_span!("trials").entered();
        let world = world.detached();
        let it = looks.first().map_or(0, |look| look.iteration);
        let trial = self.moments.trial(it);
        let mut tried = self.clone();
        for (_, tensor) in tried.parameters_mut() {
            *tensor = constant(tensor);
        }
        tried.settings.samples = tried.settings.samples.max(TRIED_SAMPLES);
        let focus = host(tried.capture.focus.clone());
        let before = tried.parts();
        let (mut now, worth) = tried.try_parts(&world, looks, &trial)?;
        let focused = host(tried.capture.focus.clone());
        let focuses = (0..focus.len()).filter(|&i| focus[i] != focused[i]);
        if trial.last {
            now = tried.try_apertures(&world, looks, now)?;
        }
        let paths = tried.try_paths(&world, looks, &now, trial.last)?;
        let decision = tried.decision(before, worth, &trial);
        for ((_, own), (_, found)) in self
            .parameters_mut()
            .into_iter()
            .zip(tried.parameters_mut())
        {
            *own = leaf(found.clone().inner(), true);
        }
        self.gauge = tried.gauge;
        self.gauge.renew();
        Ok(Revised {
            paths,
            focuses: focuses.collect(),
            decision,
        })
    }

    /// Leaves on every frame the path that explains it best; `now` are the frames' errors as it is. Says on which frames it is
    /// another one now.
    fn try_paths(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        now: &[f64],
        last: bool,
    ) -> Result<Vec<usize>, TrainError> {
        let lengths: Vec<f64> = (0..looks.len())
            .map(|frame| self.capture.taken(frame).path_px(self.focal[frame]))
            .collect();
        let (usual, usual_px) = (median(now), median(&lengths));
        if lengths.iter().all(|length| *length == 0.0) {
            return Ok(Vec::new());
        }
        let (mut changed, mut errors) = (Vec::new(), Vec::new());
        for (frame, look) in looks.iter().enumerate() {
            let own = self.path(frame);
            let length = usual_px / self.focal[frame];
            let mut best = (now[frame], own.clone());
            // A path that comes back on itself looks the same both ways, so that no gradient opens it.
            if f64::from(speed(&own)) < 0.3 * length {
                let open = Ways::new(&own, 0, &[0.7, 0.35], length);
                self.search(world, look, &open, &mut best)?;
            }
            // Far worse than the others, or hardly moved: it does not leave a wrong direction by itself.
            if now[frame] > NOT_EXPLAINED * usual || lengths[frame] < 0.4 * usual_px {
                let fresh = self.afresh(world, look, length)?;
                if fresh.0 < (1.0 - FRESH_PATH_PAYS) * best.0 {
                    best = fresh;
                }
            }
            self.try_path(world, look, reversed(&best.1), &mut best)?;
            if last && self.settings.path != When::Always && lengths[frame] < 1.0 {
                // What does not pay is left out for good.
                let still = vec![0.0; own.len()];
                self.set_path(frame, &still);
                if self.error(world, look)? <= (1.0 + PATH_PAYS) * best.0 {
                    best.1 = still;
                }
            }
            self.set_path(frame, &best.1);
            errors.push(best.0);
            if best.1 != own {
                changed.push(frame);
            }
        }
        let usual = median(&errors);
        let explained = errors.iter().map(|error| *error <= MOVES_NO_OTHER * usual);
        self.gauge.explained = explained.collect();
        Ok(changed)
    }

    /// The best path that begins from nothing, with its error; `length` is the usual one, rad. First it leads somewhere and then it
    /// bends, or, as where a hand turns back while the shutter is open, first it bends.
    fn afresh(
        &mut self,
        world: &World,
        look: &Look<'_>,
        length: f64,
    ) -> Result<(f64, Vec<f32>), TrainError> {
        let terms = self.settings.path_degree;
        let still = (f64::INFINITY, vec![0.0; terms * RIGID]);
        let mut search = |term: usize, times: &[f64], best: &mut (f64, Vec<f32>)| {
            self.search(world, look, &Ways::new(&best.1, term, times, length), best)
        };
        let mut best = still.clone();
        search(0, &[1.0, 0.5, 2.0], &mut best)?;
        for term in 1..terms {
            search(term, &[2.0, 4.0], &mut best)?;
        }
        if terms > 1 {
            let mut folded = still;
            search(1, &[4.0, 2.0, 8.0], &mut folded)?;
            search(0, &[0.5, 1.0], &mut folded)?;
            if folded.0 < best.0 {
                best = folded;
            }
        }
        let back = reversed(&best.1);
        self.try_path(world, look, back, &mut best)?;
        Ok(best)
    }

    /// Puts the best of some paths in the place of `best`, with its error, if it is better: in the direction that explains the frame
    /// best at the first length, the best length.
    fn search(
        &mut self,
        world: &World,
        look: &Look<'_>,
        ways: &Ways,
        best: &mut (f64, Vec<f32>),
    ) -> Result<(), TrainError> {
        let Some((first, others)) = ways.lengths.split_first() else {
            return Ok(());
        };
        let (mut least, mut direction) = (f64::INFINITY, 0.0);
        for angle in ways.angles() {
            let error = self.try_path(world, look, ways.path(angle, *first), best)?;
            if error < least {
                (least, direction) = (error, angle);
            }
        }
        for length in others {
            self.try_path(world, look, ways.path(direction, *length), best)?;
        }
        Ok(())
    }

    /// The error of a frame with another path, which takes the place of `best` if it is better.
    fn try_path(
        &mut self,
        world: &World,
        look: &Look<'_>,
        path: Vec<f32>,
        best: &mut (f64, Vec<f32>),
    ) -> Result<f64, TrainError> {
        let Some(frame) = look.frame else {
            return Ok(f64::INFINITY);
        };
        self.set_path(frame, &path);
        let error = self.error(world, look)?;
        if error < best.0 {
            *best = (error, path);
        }
        Ok(error)
    }

    fn path(&self, frame: usize) -> Vec<f32> {
        host(self.capture.paths.clone().narrow(0, frame, 1))
    }

    fn set_path(&mut self, frame: usize, path: &[f32]) {
        set_row(&mut self.capture.paths, frame, path);
    }
}

/// Paths that are as `path` but for the coefficients of s^(term + 1), which lead by one of `lengths` (rad) in some direction
/// across the picture.
struct Ways {
    path: Vec<f32>,
    term: usize,
    lengths: Vec<f64>,
}

impl Ways {
    /// Lengths are so many `times` one.
    fn new(path: &[f32], term: usize, times: &[f64], length: f64) -> Self {
        Self {
            path: path.to_vec(),
            term,
            lengths: times.iter().map(|times| times * length).collect(),
        }
    }

    fn path(&self, angle: f64, length: f64) -> Vec<f32> {
        let mut path = self.path.clone();
        let numbers = &mut path[self.term * RIGID..(self.term + 1) * RIGID];
        numbers.fill(0.0);
        numbers[0] = (length * angle.cos()) as f32;
        numbers[1] = (length * angle.sin()) as f32;
        path
    }

    /// Eight directions, or half of them where the opposite ones are the same paths the other way round: only movers tell the two
    /// apart, and once the rest is found.
    fn angles(&self) -> impl Iterator<Item = f64> + use<> {
        let rest = self.path(0.0, 0.0);
        let turns_round = self.term.is_multiple_of(2) && reversed(&rest) == rest;
        let number = if turns_round { 4 } else { 8 };
        (0..number).map(|i| TAU * f64::from(i) / 8.0)
    }
}

/// How far a path would lead at the speed of the middle of the exposure, focal lengths.
fn speed(path: &[f32]) -> f32 {
    (path[1] + path[3]).hypot(path[4] - path[0])
}

/// The same path the other way round.
fn reversed(path: &[f32]) -> Vec<f32> {
    let odd = |k: usize| (k / RIGID).is_multiple_of(2);
    let values = path.iter().enumerate();
    values.map(|(k, v)| if odd(k) { -v } else { *v }).collect()
}

#[cfg(test)]
mod tests {
    use super::{RIGID, TAU, Ways, reversed};

    #[test]
    fn every_direction_is_tried_one_way_or_the_other() {
        let mut bent = vec![0.0; 3 * RIGID];
        bent[RIGID] = 0.3;
        let mut twisted = bent.clone();
        twisted[2 * RIGID + 1] = 0.1;
        for (path, term, tries) in [
            (&bent, 0, 4),
            (&bent, 1, 8),
            (&bent, 2, 4),
            (&twisted, 0, 8),
        ] {
            let ways = Ways::new(path, term, &[1.0], 0.2);
            let tried: Vec<_> = ways.angles().map(|angle| ways.path(angle, 0.2)).collect();
            assert_eq!(tried.len(), tries, "{term}");
            let is_near = |one: &[f32], other: &[f32]| {
                one.iter().zip(other).all(|(a, b)| (a - b).abs() < 1e-6)
            };
            for i in 0..8 {
                let path = ways.path(TAU * f64::from(i) / 8.0, 0.2);
                let is_tried =
                    |tried: &Vec<f32>| is_near(tried, &path) || is_near(&reversed(tried), &path);
                assert!(tried.iter().any(is_tried), "{term}: {i}");
            }
        }
    }
}
