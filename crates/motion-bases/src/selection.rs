//! How many motions tracks need: as few as foretell tracks that they were not fitted to about as well as more would do
//! (cross-validation).

use crate::basis_init::cluster_motion;
use crate::merging::{Cluster, merge_closest};
use crate::tracks::Tracks3d;
use glam::DAffine3;
use rayon::prelude::*;

/// Fewer motions are enough while the error of tracks that were left out is at most this factor times the least …
const ERROR_RATIO: f64 = 1.03;
/// … plus this part of the foreground's extent.
const ERROR_FLOOR: f64 = 0.002;
/// The share of tracks that counts: the worst are the tracker's mistakes, whatever the motions.
const TRIM: f64 = 0.9;
/// Tracks that are looked at, evenly spread.
const MAX_TRACKS: usize = 4000;

/// Merges clusters, the most alike first, as far as tracks that were left out say that fewer are enough.
pub(crate) fn fewest(
    tracks: &Tracks3d,
    canonical: usize,
    extent: f64,
    clusters: Vec<Cluster>,
) -> Vec<Cluster> {
    let mut levels = vec![clusters];
    while let Some(fewer) = merge_closest(tracks, canonical, extent, &levels[levels.len() - 1]) {
        levels.push(fewer);
    }
    let errors: Vec<f64> = levels
        .iter()
        .map(|clusters| left_out_error(tracks, canonical, clusters))
        .collect();
    let least = errors.iter().copied().fold(f64::INFINITY, f64::min);
    if least.is_infinite() {
        // Nothing says that fewer would do.
        return levels.swap_remove(0);
    }
    let enough = ERROR_RATIO * least + ERROR_FLOOR * extent;
    let chosen = errors.iter().rposition(|error| *error <= enough);
    levels.swap_remove(chosen.unwrap_or(0))
}

/// The typical error, scene units, of tracks that motions were not fitted to: each cluster's motion is fitted to every other of its
/// tracks, and the rest are foretold by the motion that suits them best in every other frame in which they are seen, in the frames
/// between; and the other way round. Infinite where nothing can be foretold.
fn left_out_error(tracks: &Tracks3d, canonical: usize, clusters: &[Cluster]) -> f64 {
    let mut errors: Vec<f64> = [0, 1]
        .into_iter()
        .flat_map(|left_out| {
            let motions: Vec<Vec<Option<DAffine3>>> = clusters
                .par_iter()
                .map(|cluster| {
                    let kept = cluster.members.iter().skip(1 - left_out).step_by(2);
                    let kept: Vec<usize> = kept.copied().collect();
                    if kept.is_empty() {
                        return vec![None; tracks.num_frames];
                    }
                    cluster_motion(tracks, &kept, canonical)
                })
                .collect();
            let rows = clusters
                .iter()
                .flat_map(|cluster| cluster.members.iter().skip(left_out).step_by(2));
            let rows: Vec<usize> = rows.copied().collect();
            let step = (2 * rows.len()).div_ceil(MAX_TRACKS).max(1);
            let rows: Vec<usize> = rows.into_iter().step_by(step).collect();
            rows.into_par_iter()
                .filter_map(|row| foretold(tracks, canonical, row, &motions))
                .collect::<Vec<f64>>()
        })
        .collect();
    if errors.is_empty() {
        return f64::INFINITY;
    }
    errors.sort_unstable_by(f64::total_cmp);
    let counted = (TRIM * errors.len() as f64).ceil() as usize;
    errors.truncate(counted);
    errors.iter().sum::<f64>() / errors.len() as f64
}

/// The root mean square of a track's errors in every other frame in which it is seen, by the motion that suits it best in the
/// frames between; `None` where it is seen too rarely, or no motion is known there.
fn foretold(
    tracks: &Tracks3d,
    canonical: usize,
    row: usize,
    motions: &[Vec<Option<DAffine3>>],
) -> Option<f64> {
    let at = |t: usize| tracks.positions[tracks.index(row, t)];
    let seen: Vec<usize> = (0..tracks.num_frames)
        .filter(|t| tracks.visible[tracks.index(row, *t)])
        .collect();
    // From where it is seen next to the canonical frame, where all motions are known to be the identity.
    let from = *seen.iter().min_by_key(|t| t.abs_diff(canonical))?;
    let rest = || seen.iter().copied().filter(|t| *t != from);
    let error = |motion: &[Option<DAffine3>], parity: usize| {
        let to_canonical = motion[from]?.inverse();
        let start = to_canonical.transform_point3(at(from));
        let squares = rest().skip(parity).step_by(2).map(|t| {
            let there = motion[t]?.transform_point3(start);
            Some(there.distance_squared(at(t)))
        });
        let squares: Vec<f64> = squares.flatten().collect();
        (!squares.is_empty()).then(|| squares.iter().sum::<f64>() / squares.len() as f64)
    };
    let suited = motions
        .iter()
        .filter_map(|motion| Some((error(motion, 0)?, motion)));
    let (_, best) = suited.min_by(|a, b| a.0.total_cmp(&b.0))?;
    error(best, 1).map(f64::sqrt)
}

#[cfg(test)]
mod tests {
    use crate::{InitOptions, MotionInit, Tracks3d, initialize};
    use glam::{DQuat, DVec3};
    use rand::{Rng as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    const FRAMES: usize = 16;

    /// From -1 to 1.
    fn uniform(rng: &mut ChaCha8Rng) -> f64 {
        (rng.next_u64() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    /// Tracks of points in a box of half a unit around each body's place, all bodies as many, moved by `at` (body, point, frame),
    /// off by at most `noise`, and each seen in some stretch of frames.
    fn tracks(
        bodies: &[DVec3],
        noise: f64,
        seed: u64,
        at: impl Fn(usize, DVec3, f64) -> DVec3,
    ) -> Tracks3d {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut tracks = Tracks3d {
            num_frames: FRAMES,
            ..Tracks3d::default()
        };
        let mut vector = |size: f64| {
            let mut number = || size * uniform(&mut rng);
            DVec3::new(number(), number(), number())
        };
        for row in 0..bodies.len() * 200 {
            let body = row % bodies.len();
            let point = bodies[body] + vector(0.5);
            let (first, seen) = (row % 7, 8 + row % 5);
            for t in 0..FRAMES {
                let is_seen = (first..first + seen).contains(&t);
                let position = at(body, point, t as f64) + vector(noise);
                tracks.positions.push(position);
                tracks.visible.push(is_seen);
                tracks.confidence.push(f32::from(u8::from(is_seen)));
            }
            tracks.colors.push([0.5; 3]);
        }
        tracks
    }

    fn found(tracks: &Tracks3d, fewest: bool) -> MotionInit {
        let options = InitOptions {
            num_bases: 20,
            fewest,
            seed: 1,
        };
        initialize(tracks, &options).expect("bases")
    }

    /// Each body goes and turns its own way.
    fn rigid(body: usize, point: DVec3, t: f64) -> DVec3 {
        let axis = [DVec3::X, DVec3::Y, DVec3::Z][body];
        let turn = DQuat::from_axis_angle(axis, 0.08 * t);
        let center = BODIES[body];
        let way = [DVec3::X, -DVec3::X, DVec3::Y][body];
        turn * (point - center) + center + way * (0.15 * t)
    }

    const BODIES: [DVec3; 3] = [
        DVec3::new(0.0, 0.0, 5.0),
        DVec3::new(3.0, 0.0, 6.0),
        DVec3::new(-3.0, 1.0, 7.0),
    ];

    #[test]
    fn as_many_bases_as_there_are_rigid_movers() {
        for noise in [0.0, 0.01, 0.03] {
            for count in 1..=3 {
                for seed in 0..3 {
                    let tracks = tracks(&BODIES[..count], noise, seed, rigid);
                    let bases = found(&tracks, true).num_bases;
                    assert_eq!(bases, count, "noise {noise}, seed {seed}");
                }
            }
        }
    }

    #[test]
    fn depth_that_is_off_smoothly_is_no_motion() {
        // As given depth is: off by some hundredths, alike where points are near each other, and otherwise in every frame.
        let off = |point: DVec3, t: f64| {
            let wave = (1.9 * point.x + 2.3 * t).sin() + (1.3 * point.y - 4.1 * t).cos();
            point * (1.0 + 0.01 * wave)
        };
        for count in 1..=3 {
            for seed in 0..3 {
                let seen = |body, point, t| off(rigid(body, point, t), t);
                let tracks = tracks(&BODIES[..count], 0.01, seed, seen);
                let (all, few) = (found(&tracks, false), found(&tracks, true));
                assert!(
                    (count..=2 * count).contains(&few.num_bases),
                    "{count} movers, seed {seed}: {} of {}",
                    few.num_bases,
                    all.num_bases
                );
            }
        }
    }

    #[test]
    fn what_bends_keeps_the_bases_that_it_needs() {
        // A rod that bends to and fro: turned about its middle by an angle that grows along it.
        let bend = |_: usize, point: DVec3, t: f64| {
            let angle = 1.2 * point.x * (0.5 * t).sin();
            DQuat::from_axis_angle(DVec3::Z, angle) * point + DVec3::new(0.0, 0.0, 5.0)
        };
        let rod: Vec<DVec3> = (-2..=2)
            .map(|k| DVec3::new(0.5 * f64::from(k), 0.0, 0.0))
            .collect();
        let tracks = tracks(&rod, 0.01, 1, bend);
        let (all, few) = (found(&tracks, false), found(&tracks, true));
        assert!(
            (3..=all.num_bases).contains(&few.num_bases),
            "{} of {}",
            few.num_bases,
            all.num_bases
        );
    }

    #[test]
    fn what_stands_still_needs_one_basis() {
        let still = |_: usize, point: DVec3, _: f64| point;
        let tracks = tracks(&BODIES[..1], 0.0, 1, still);
        assert_eq!(found(&tracks, true).num_bases, 1);
    }

    #[test]
    fn where_nothing_can_be_foretold_no_motion_goes() {
        // A track that is seen in two frames has no third one to foretell.
        let mut thin = tracks(&BODIES[..2], 0.0, 1, rigid);
        for (at, visible) in thin.visible.iter_mut().enumerate() {
            *visible &= (6..8).contains(&(at % FRAMES));
        }
        let all = found(&thin, false).num_bases;
        assert!(all > 1, "two bodies go opposite ways");
        assert_eq!(found(&thin, true).num_bases, all);
    }
}
