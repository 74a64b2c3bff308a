//! Tracks without the tracker's noise: what it adds to each position by itself goes, where a quadratic in time through the positions
//! around says better where the point was.

use crate::statistics::median;
use crate::track_sample::{is_sure, position};
use glam::{DMat3, DVec2, DVec3};
use io::{QueryTracks, TrackSample};
use rayon::prelude::*;

/// So many frames to either side may be looked at…
const HALF_WIDTHS: [usize; 5] = [3, 4, 6, 9, 13];
/// … and so many tell how large the noise is: a path is never closer to a quadratic.
const NOISE_HALF_WIDTH: usize = 2;
/// A wider window has to foretell so much better (of the mean square): what it takes from where paths bend most, no median sees.
const WORTH_WIDENING: f64 = 0.25;
/// Five positions, so that a quadratic leaves something over.
const LEAST: usize = 5;
/// Positions farther off than so many times the median count for nothing (bisquare weights, as in LOESS by Cleveland, 1979).
const OUTLIER: f64 = 4.0;
/// How often these weights are computed.
const ROUNDS: usize = 2;
/// A median under this makes no outliers, px.
const EXACT_PX: f64 = 1e-3;
/// Tracks that the window is chosen by, evenly spread.
const MOST_TRACKS: usize = 1000;

/// How many frames to either side of a position the narrowest window has that is about as good as the best; `None` where positions
/// are better as they are.
///
/// By cross-validation: m is the median square of what a quadratic misses a position by that it does not see, and s what of m in the
/// narrowest window is noise of that position itself, by how the quadratic carries noise of the others to it. A window foretells
/// positions with an error of m - s, and they are off by s themselves.
pub(crate) fn best_window(queries: &[QueryTracks], num_frames: usize) -> Option<usize> {
    let rows = || {
        queries
            .iter()
            .flat_map(|q| q.samples.chunks_exact(num_frames.max(1)))
    };
    let step = rows().count().div_ceil(MOST_TRACKS).max(1);
    let tracks: Vec<Vec<Seen>> = rows().step_by(step).map(seen).collect();
    let missed = |half_width: usize| {
        let all = tracks.par_iter().flat_map_iter(|track| {
            (0..track.len()).filter_map(move |i| foretold(track, i, half_width))
        });
        all.collect::<Vec<(f64, f64)>>()
    };
    let noises = missed(NOISE_HALF_WIDTH).into_iter();
    let noises: Vec<f64> = noises
        .map(|(square, carried)| square / (1.0 + carried))
        .collect();
    if noises.is_empty() {
        return None;
    }
    let noise = median(&noises);
    let errors = HALF_WIDTHS.map(|half_width| {
        let squares: Vec<f64> = missed(half_width).into_iter().map(|m| m.0).collect();
        median(&squares)
    });
    let least = errors.into_iter().fold(f64::INFINITY, f64::min);
    // Better than the positions themselves, and hardly worse than the best.
    let is_good = |error: f64| error - noise < noise && error <= (1.0 + WORTH_WIDENING) * least;
    let windows = HALF_WIDTHS.into_iter().zip(errors);
    let mut good = windows.filter(|(_, error)| is_good(*error));
    good.next().map(|(half_width, _)| half_width)
}

/// The track with each position of which the tracker is sure where a quadratic in time through those around it says, within so many
/// frames to either side; where these are too few, it stays.
pub(crate) fn smoothed(samples: &[TrackSample], half_width: usize) -> Vec<TrackSample> {
    let track = seen(samples);
    let mut out = samples.to_vec();
    for i in 0..track.len() {
        let around = window(&track, i, half_width);
        if around.len() < LEAST {
            continue;
        }
        let frame = track[i].frame;
        let through = |counts: &[f64]| Fit::of(around, counts, frame, half_width);
        let Some(mut fit) = through(&vec![1.0; around.len()]) else {
            continue;
        };
        for _ in 0..ROUNDS {
            let Some(next) = through(&fit.counts(around)) else {
                break;
            };
            fit = next;
        }
        let place = fit.at(0.0);
        (out[frame].x, out[frame].y) = (place.x as f32, place.y as f32);
    }
    out
}

/// A position that the tracker is sure of.
#[derive(Clone, Copy)]
struct Seen {
    frame: usize,
    /// px
    at: DVec2,
}

fn seen(samples: &[TrackSample]) -> Vec<Seen> {
    let sure = samples
        .iter()
        .enumerate()
        .filter(|(_, sample)| is_sure(sample));
    sure.map(|(frame, sample)| Seen {
        frame,
        at: position(sample),
    })
    .collect()
}

/// Those within so many frames of the i-th.
fn window(track: &[Seen], i: usize, half_width: usize) -> &[Seen] {
    let frame = track[i].frame;
    let from = track.partition_point(|s| s.frame + half_width < frame);
    let until = track.partition_point(|s| s.frame <= frame + half_width);
    &track[from..until]
}

/// By how much the square of the distance the quadratic through the others misses the i-th position, px², and how many times the
/// variance of each it carries there; `None` where the two before and the two behind are not all seen.
fn foretold(track: &[Seen], i: usize, half_width: usize) -> Option<(f64, f64)> {
    let frame = track[i].frame;
    let nearest = track.get(i.checked_sub(2)?..i + 3)?;
    if nearest[4].frame - nearest[0].frame != 4 {
        return None;
    }
    let around = window(track, i, half_width);
    let counts: Vec<f64> = around
        .iter()
        .map(|s| f64::from(u8::from(s.frame != frame)))
        .collect();
    let fit = Fit::of(around, &counts, frame, half_width)?;
    Some((
        fit.at(0.0).distance_squared(track[i].at),
        fit.carried(around, &counts),
    ))
}

/// A quadratic in time, by least squares with tricube weights.
struct Fit {
    frame: usize,
    half_width: usize,
    inverse: DMat3,
    x: DVec3,
    y: DVec3,
}

impl Fit {
    /// Through positions around a frame, each of which counts so much; `None` where they do not determine one.
    fn of(around: &[Seen], counts: &[f64], frame: usize, half_width: usize) -> Option<Self> {
        let mut fit = Self {
            frame,
            half_width,
            inverse: DMat3::ZERO,
            x: DVec3::ZERO,
            y: DVec3::ZERO,
        };
        let mut normal = DMat3::ZERO;
        for (seen, count) in around.iter().zip(counts) {
            let time = fit.time(seen);
            let (weight, powers) = (count * tricube(time), powers(time));
            normal += DMat3::from_cols(powers, time * powers, time * time * powers) * weight;
            fit.x += powers * (weight * seen.at.x);
            fit.y += powers * (weight * seen.at.y);
        }
        // Of three positions or more at different times it is far from that; what is no number is not.
        let is_determined = normal.determinant() > 1e-9;
        if !is_determined {
            return None;
        }
        fit.inverse = normal.inverse();
        (fit.x, fit.y) = (fit.inverse * fit.x, fit.inverse * fit.y);
        Some(fit)
    }

    /// From -1 to 1, with both ends just outside of the window.
    fn time(&self, seen: &Seen) -> f64 {
        (seen.frame as f64 - self.frame as f64) / (self.half_width + 1) as f64
    }

    fn at(&self, time: f64) -> DVec2 {
        let powers = powers(time);
        DVec2::new(powers.dot(self.x), powers.dot(self.y))
    }

    /// The sum of the squares of what each position counts for at the frame.
    fn carried(&self, around: &[Seen], counts: &[f64]) -> f64 {
        let row = self.inverse.row(0);
        let shares = around.iter().zip(counts).map(|(seen, count)| {
            let time = self.time(seen);
            count * tricube(time) * row.dot(powers(time))
        });
        shares.map(|share| share * share).sum()
    }

    /// How much each counts, by how far it is off.
    fn counts(&self, around: &[Seen]) -> Vec<f64> {
        let off = |seen: &Seen| self.at(self.time(seen)).distance(seen.at);
        let all: Vec<f64> = around.iter().map(off).collect();
        let most = OUTLIER * median(&all).max(EXACT_PX);
        let count = |seen: &Seen| {
            let off = (off(seen) / most).min(1.0);
            (1.0 - off * off).powi(2)
        };
        around.iter().map(count).collect()
    }
}

fn powers(time: f64) -> DVec3 {
    DVec3::new(1.0, time, time * time)
}

fn tricube(time: f64) -> f64 {
    (1.0 - time.abs().powi(3)).powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, generator};
    use rand::Rng as _;

    const FRAMES: usize = 24;

    /// The tracker is sure of all it says here.
    fn sample(at: DVec2) -> TrackSample {
        TrackSample {
            x: at.x as f32,
            y: at.y as f32,
            occlusion: -4.0,
            expected_distance: -4.0,
        }
    }

    /// A bent path, other for each track, px.
    fn bent(track: usize, frame: usize) -> DVec2 {
        let (k, t) = (track as f64, frame as f64 / FRAMES as f64);
        let way = DVec2::from_angle(k);
        40.0 * way * t + 25.0 * way.perp() * t * t + DVec2::splat(100.0)
    }

    /// A path that turns round every five frames, px.
    fn turning(track: usize, frame: usize) -> DVec2 {
        let angle = 0.2 * std::f64::consts::TAU * frame as f64 + track as f64;
        20.0 * DVec2::from_angle(angle) + DVec2::splat(100.0)
    }

    /// 100 tracks that are off by up to `noise` px along x and y.
    fn tracks(path: fn(usize, usize) -> DVec2, noise: f64) -> QueryTracks {
        let mut rng = generator(1, Purpose::Tracks, 0);
        let mut either_way = || noise * ((rng.next_u32() as f64) / f64::from(u32::MAX) * 2.0 - 1.0);
        let samples = (0..100 * FRAMES).map(|i| {
            let off = DVec2::new(either_way(), either_way());
            sample(path(i / FRAMES, i % FRAMES) + off)
        });
        QueryTracks {
            frame: 0,
            samples: samples.collect(),
        }
    }

    /// Root mean square of the distances to the path, px.
    fn error(path: fn(usize, usize) -> DVec2, samples: &[TrackSample]) -> f64 {
        let squares = samples.iter().enumerate().map(|(i, s)| {
            let (track, frame) = (i / FRAMES, i % FRAMES);
            position(s).distance_squared(path(track, frame))
        });
        (squares.sum::<f64>() / samples.len() as f64).sqrt()
    }

    fn all_smoothed(tracks: &QueryTracks, half_width: usize) -> Vec<TrackSample> {
        let rows = tracks.samples.chunks_exact(FRAMES);
        rows.flat_map(|row| smoothed(row, half_width)).collect()
    }

    #[test]
    fn noise_goes_where_paths_bend_little() {
        for noise in [0.3, 3.0] {
            let tracks = tracks(bent, noise);
            let window = best_window(std::slice::from_ref(&tracks), FRAMES).expect("noise");
            let before = error(bent, &tracks.samples);
            let after = error(bent, &all_smoothed(&tracks, window));
            assert!(after < 0.8 * before, "{noise}: {before} {after}");
            let wider = error(bent, &all_smoothed(&tracks, 2 * window));
            assert!(wider < after, "{noise}: a wider window takes more of it");
        }
    }

    #[test]
    fn positions_that_are_better_than_their_neighbours_tell_stay() {
        let exact = tracks(turning, 0.0);
        assert_eq!(best_window(std::slice::from_ref(&exact), FRAMES), None);
        assert_eq!(best_window(&[], FRAMES), None);
        let short = QueryTracks {
            frame: 0,
            samples: exact.samples[..4].to_vec(),
        };
        assert_eq!(best_window(&[short], 4), None);
        // Noise on a path that bends so much is better borne.
        for noise in [0.1, 3.0] {
            let window = best_window(&[tracks(turning, noise)], FRAMES);
            assert_eq!(window, None, "{noise}");
        }
    }

    #[test]
    fn what_is_far_off_counts_for_nothing_and_what_nobody_is_sure_of_stays() {
        let mut tracks = tracks(bent, 0.2);
        for (i, sample) in tracks.samples.iter_mut().enumerate() {
            match i % 19 {
                7 => sample.x += 30.0,
                11 => {
                    sample.x = 3.0;
                    sample.occlusion = 4.0;
                }
                _ => {}
            }
        }
        let after = all_smoothed(&tracks, 6);
        let (mut worst, mut count) = (0.0_f64, 0);
        for (i, (sample, old)) in after.iter().zip(&tracks.samples).enumerate() {
            if is_sure(old) {
                // At its ends a track has nobody on the other side that speaks against it.
                let (track, frame) = (i / FRAMES, i % FRAMES);
                if (3..FRAMES - 3).contains(&frame) {
                    worst = worst.max(position(sample).distance(bent(track, frame)));
                    count += 1;
                }
            } else {
                assert_eq!(sample, old);
            }
        }
        assert!(count > 1000 && worst < 1.5, "{worst} px");
    }

    #[test]
    fn a_quadratic_is_left_where_it_is() {
        let tracks = tracks(bent, 0.0);
        for half_width in [NOISE_HALF_WIDTH].into_iter().chain(HALF_WIDTHS) {
            let after = all_smoothed(&tracks, half_width);
            assert!(error(bent, &after) < 1e-4, "{half_width}");
        }
    }
}
