//! From 3D tracks to bases and coefficients: tracks whose velocities have like directions move as one, and each such cluster,
//! aligned with itself in every frame, is a basis (Shape of Motion, Wang et al. 2024, section 3.3).

use crate::MotionError;
use crate::basis_init::{cluster_motion, without_gaps};
use crate::clustering::cluster;
use crate::merging::{Cluster, merge};
use crate::selection::fewest;
use crate::statistics::{half_range, median_point};
use crate::tracks::Tracks3d;
use glam::{DAffine3, DVec3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// A cluster with fewer tracks is left out: three points determine a rigid motion. There are no more
/// clusters than the tracks suffice for on average.
const MIN_TRACKS: usize = 3;
/// A cluster with less than one track in so many is left out (100 of 40,000 in Shape of Motion).
const MIN_SHARE: usize = 400;

/// How many bases, and from which random numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InitOptions {
    /// Largest number of bases; fewer are returned where the tracks do not support as many.
    pub num_bases: usize,
    /// Whether there are to be only as many as it takes to foretell tracks that they were not fitted to.
    pub fewest: bool,
    /// Seed of the clustering.
    pub seed: u64,
}

/// Bases and coefficients to start from. B bases, N frames, P tracks that were kept.
#[derive(Clone, Debug)]
pub struct MotionInit {
    /// The frame in which all bases are the identity.
    pub canonical_frame: usize,
    /// Number of bases B.
    pub num_bases: usize,
    /// Number of motions that were told apart, of which [`InitOptions::fewest`] leaves B.
    pub num_motions: usize,
    /// 6D rotations, [B, N, 6].
    pub rots: Vec<f64>,
    /// Translations in scene units, [B, N, 3].
    pub transls: Vec<f64>,
    /// The tracks that were kept, in their order; positions that are not visible are interpolated.
    pub tracks: Tracks3d,
    /// Their positions as they came in, [P * N]: what a hidden entry says about the pixel stands here.
    pub observed: Vec<DVec3>,
    /// Which rows of the input were kept, `[P]`.
    pub rows: Vec<usize>,
    /// Motion coefficients (logits), [P, B].
    pub coefficients: Vec<f32>,
    /// Size of the foreground in scene units: half of its largest range along an axis in the
    /// canonical frame, without the outer 5 % on either side. Positive.
    pub extent: f64,
}

impl MotionInit {
    /// Where the tracks are in the canonical frame, scene units, [P, 3].
    #[must_use]
    pub fn canonical_means(&self) -> Vec<f64> {
        let at = |p| self.tracks.positions[self.tracks.index(p, self.canonical_frame)];
        let tracks = 0..self.tracks.len();
        tracks.flat_map(|p| at(p).to_array()).collect()
    }
}

/// Finds motion bases: fills gaps, drops outliers, clusters the directions of the velocities, aligns
/// each cluster with itself in every frame, merges clusters that move alike, and weighs the bases by
/// the distance to the clusters.
///
/// Deterministic for a seed, whatever the number of threads.
///
/// # Errors
/// [`MotionError`] when there are no tracks, none is visible, an array has the wrong length, or a
/// number is not finite.
pub fn initialize(tracks: &Tracks3d, options: &InitOptions) -> Result<MotionInit, MotionError> {
    tracks.check()?;
    if options.num_bases == 0 {
        return Err(MotionError::NoBases);
    }
    let canonical_frame = tracks.canonical_frame();
    let mut filled = tracks.clone();
    filled.fill_gaps();
    let rows = filled.rows_without_outliers(canonical_frame);
    if rows.is_empty() {
        return Err(MotionError::NoVisibleTrack {
            num_tracks: tracks.len(),
        });
    }
    let filled = filled.subset(&rows);
    let extent = foreground_extent(&filled, canonical_frame);
    let clusters: Vec<Cluster> = cluster_tracks(&filled, extent, options)
        .into_par_iter()
        .map(|members| Cluster {
            motion: cluster_motion(&filled, &members, canonical_frame),
            members,
        })
        .collect();
    let mut clusters = merge(&filled, canonical_frame, extent, with_motion(clusters));
    let num_motions = clusters.len();
    if options.fewest {
        clusters = fewest(&filled, canonical_frame, extent, clusters);
    }
    let at = |&row: &usize| filled.positions[filled.index(row, canonical_frame)];
    let centers: Vec<DVec3> = clusters
        .iter()
        .map(|c| median_point(c.members.iter().map(at)))
        .collect();
    let motions: Vec<DAffine3> = clusters
        .iter()
        .flat_map(|c| without_gaps(&c.motion, canonical_frame))
        .collect();
    let coefficients = coefficients(&filled, canonical_frame, &centers, extent);
    Ok(MotionInit {
        canonical_frame,
        num_bases: clusters.len(),
        num_motions,
        rots: motions.iter().flat_map(six_numbers).collect(),
        transls: motions
            .iter()
            .flat_map(|m| m.translation.to_array())
            .collect(),
        observed: tracks.subset(&rows).positions,
        tracks: filled,
        rows,
        coefficients,
        extent,
    })
}

/// The first two columns of the rotation.
fn six_numbers(motion: &DAffine3) -> [f64; 6] {
    let (x, y) = (motion.matrix3.x_axis, motion.matrix3.y_axis);
    [x.x, x.y, x.z, y.x, y.y, y.z]
}

/// [`MotionInit::extent`]. A foreground without size in the canonical frame takes that of its whole
/// path, and one that is a single point at rest has size 1.
fn foreground_extent(tracks: &Tracks3d, canonical: usize) -> f64 {
    let n = tracks.num_frames;
    let there = half_range(tracks.positions.iter().skip(canonical).step_by(n).copied());
    if there > 0.0 {
        return there;
    }
    let anywhere = half_range(tracks.positions.iter().copied());
    if anywhere > 0.0 { anywhere } else { 1.0 }
}

/// Rows of the tracks of each cluster, by k-means on the directions of their velocities.
fn cluster_tracks(tracks: &Tracks3d, extent: f64, options: &InitOptions) -> Vec<Vec<usize>> {
    let (n, count) = (tracks.num_frames, tracks.len());
    let directions: Vec<f64> = tracks
        .positions
        .chunks_exact(n)
        .flat_map(|path| path.windows(2))
        .flat_map(|pair| {
            let velocity = pair[1] - pair[0];
            (velocity / (velocity.length() + 1e-5 * extent)).to_array()
        })
        .collect();
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let k = options.num_bases.min((count / MIN_TRACKS).max(1));
    let labels = cluster(&directions, 3 * (n - 1), count, k, &mut rng);
    let mut clusters = vec![Vec::new(); labels.iter().max().map_or(0, |&l| l + 1)];
    for (row, &label) in labels.iter().enumerate() {
        clusters[label].push(row);
    }
    let largest = clusters.iter().map(Vec::len).max().unwrap_or(0);
    let enough = count.div_ceil(MIN_SHARE).max(MIN_TRACKS).min(largest);
    clusters.retain(|members| members.len() >= enough);
    clusters
}

/// The clusters whose motion is known in some frame besides the canonical one, which always has one;
/// the largest cluster if there is none. (Tracks that are all hidden in the canonical frame say
/// nothing about the motion from there.)
fn with_motion(clusters: Vec<Cluster>) -> Vec<Cluster> {
    let is_known = |c: &Cluster| c.motion.iter().flatten().count() > 1;
    if clusters.iter().any(is_known) {
        return clusters.into_iter().filter(is_known).collect();
    }
    let largest = clusters.into_iter().reduce(|a, b| {
        if b.members.len() > a.members.len() {
            b
        } else {
            a
        }
    });
    largest.into_iter().collect()
}

/// Logits 10 exp(-distance / extent), [P, B], of the distance in the canonical frame to each
/// cluster's centre. (The reference leaves the distance in scene units, which makes all logits
/// alike in a scene of small numbers.)
fn coefficients(tracks: &Tracks3d, canonical: usize, centers: &[DVec3], extent: f64) -> Vec<f32> {
    let points = tracks
        .positions
        .iter()
        .skip(canonical)
        .step_by(tracks.num_frames);
    points
        .flat_map(|point| {
            centers
                .iter()
                .map(|center| (10.0 * (-point.distance(*center) / extent).exp()) as f32)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Tracks of points under a motion per point and frame; all visible.
    fn tracks(
        points: &[DVec3],
        frames: usize,
        at: impl Fn(usize, DVec3, f64) -> DVec3,
    ) -> Tracks3d {
        let count = points.len() * frames;
        Tracks3d {
            num_frames: frames,
            positions: (0..count)
                .map(|i| at(i / frames, points[i / frames], (i % frames) as f64))
                .collect(),
            visible: vec![true; count],
            confidence: vec![1.0; count],
            colors: vec![[0.5; 3]; points.len()],
        }
    }

    fn grid(side: usize) -> Vec<DVec3> {
        (0..side * side * 2)
            .map(|i| {
                DVec3::new(
                    (i % side) as f64,
                    (i / side % side) as f64,
                    (i / side / side) as f64,
                )
            })
            .collect()
    }

    fn options(num_bases: usize) -> InitOptions {
        InitOptions {
            num_bases,
            fewest: false,
            seed: 3,
        }
    }

    fn motion(init: &MotionInit, basis: usize, frame: usize) -> DAffine3 {
        let i = basis * init.tracks.num_frames + frame;
        let six = &init.rots[6 * i..6 * i + 6];
        let (x, y) = (DVec3::from_slice(&six[..3]), DVec3::from_slice(&six[3..]));
        DAffine3 {
            matrix3: glam::DMat3::from_cols(x, y, x.cross(y)),
            translation: DVec3::from_slice(&init.transls[3 * i..3 * i + 3]),
        }
    }

    #[test]
    fn one_rigid_mover_is_recovered_and_starts_as_the_identity() {
        let pivot = DVec3::new(2.0, 2.0, 40.0);
        let turn = |t: f64| DQuat::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 0.1 * (t - 3.0));
        let mut tracks = tracks(&grid(6), 8, |_, p, t| {
            turn(t) * p + pivot + DVec3::X * (t - 3.0)
        });
        // Frame 3 is the one with most visible tracks.
        for row in 0..tracks.len() {
            let hidden = tracks.index(row, [0, 1, 2, 4, 5, 6, 7][row % 7]);
            tracks.visible[hidden] = false;
            tracks.confidence[hidden] = 0.0;
            tracks.positions[hidden] = DVec3::splat(1e4);
        }
        let init = initialize(&tracks, &options(1)).expect("bases");
        assert_eq!((init.canonical_frame, init.num_bases), (3, 1));
        assert_eq!(motion(&init, 0, 3), DAffine3::IDENTITY);
        for t in 0..8 {
            let found = motion(&init, 0, t);
            for p in grid(6) {
                let at = |t: usize| turn(t as f64) * p + pivot + DVec3::X * (t as f64 - 3.0);
                let error = found.transform_point3(at(3)).distance(at(t));
                assert!(error < 1e-6, "frame {t}: {error}");
            }
        }
    }

    #[test]
    fn frames_without_tracks_copy_their_neighbour_on_the_canonical_side() {
        let mut tracks = tracks(&grid(4), 7, |_, p, t| p + DVec3::X * t);
        for row in 0..tracks.len() {
            for t in [0, 4] {
                let i = tracks.index(row, t);
                tracks.visible[i] = false;
            }
            // Frame 2 is canonical, and frame 3 has two tracks left: too few.
            let i = tracks.index(row, 3);
            tracks.visible[i] = row < 2;
            let i = tracks.index(row, 1);
            tracks.visible[i] = row > 0;
            for t in [5, 6] {
                let i = tracks.index(row, t);
                tracks.visible[i] = row > 0;
            }
        }
        let init = initialize(&tracks, &options(1)).expect("bases");
        assert_eq!(init.canonical_frame, 2);
        let shift: Vec<f64> = (0..7).map(|t| motion(&init, 0, t).translation.x).collect();
        let expected = [-1.0, -1.0, 0.0, 0.0, 0.0, 3.0, 4.0];
        for (t, (a, b)) in shift.iter().zip(expected).enumerate() {
            assert!((a - b).abs() < 1e-9, "frame {t}: {shift:?}");
        }
    }

    #[test]
    fn coefficients_are_the_same_at_any_scale() {
        let make = |scale: f64| {
            let tracks = tracks(&grid(5), 6, |row, p, t| {
                scale
                    * (p + if row < 25 {
                        DVec3::X * t
                    } else {
                        DVec3::Z * (8.0 + t)
                    })
            });
            initialize(&tracks, &options(4)).expect("bases")
        };
        let (small, large) = (make(1e-4), make(1e4));
        assert_eq!(small.num_bases, large.num_bases);
        assert!(small.num_bases >= 2, "two directions of motion");
        let difference = |(a, b): (&f32, &f32)| (a - b).abs();
        let worst = small
            .coefficients
            .iter()
            .zip(&large.coefficients)
            .map(difference)
            .fold(0.0, f32::max);
        assert!(worst < 1e-3, "logits differ by {worst}");
        let row = &large.coefficients[..large.num_bases];
        let span = row.iter().fold(0.0_f32, |m, v| m.max(*v))
            - row.iter().fold(10.0_f32, |m, v| m.min(*v));
        assert!(span > 1.0, "logits must tell the bases apart: {row:?}");
    }

    #[test]
    fn thin_data_gives_fewer_bases() {
        let still = |_: usize, p: DVec3, _: f64| p;
        let moving = |_: usize, p: DVec3, t: f64| p * (1.0 + t) + DVec3::X * t;
        let spread = grid(4);
        let cases: Vec<(&str, Tracks3d)> = vec![
            ("one track", tracks(&spread[3..4], 5, moving)),
            ("two tracks", tracks(&spread[3..5], 5, moving)),
            (
                "a track seen many times",
                tracks(&[DVec3::new(1.0, 2.0, 3.0); 30], 5, moving),
            ),
            (
                "one point at rest",
                tracks(&[DVec3::new(1.0, 2.0, 3.0); 30], 5, still),
            ),
            ("all at the origin", tracks(&[DVec3::ZERO; 9], 4, still)),
            ("one frame", tracks(&spread, 1, moving)),
            ("two frames", tracks(&spread, 2, moving)),
            ("all at rest", tracks(&spread, 6, still)),
            ("a line", tracks(&spread[..4], 6, moving)),
        ];
        for (name, tracks) in cases {
            let init = initialize(&tracks, &options(20)).expect(name);
            let (b, n, p) = (init.num_bases, tracks.num_frames, init.tracks.len());
            assert!(
                (1..=20).contains(&b) && b <= p,
                "{name}: {b} bases of {p} tracks"
            );
            assert_eq!(
                (init.rots.len(), init.transls.len()),
                (6 * b * n, 3 * b * n),
                "{name}"
            );
            assert_eq!(
                (init.coefficients.len(), init.rows.len()),
                (p * b, p),
                "{name}"
            );
            assert!(
                init.extent > 0.0 && init.extent.is_finite(),
                "{name}: extent {}",
                init.extent
            );
            assert!(
                init.rots.iter().chain(&init.transls).all(|v| v.is_finite())
                    && init.coefficients.iter().all(|v| v.is_finite()),
                "{name}: not finite"
            );
            for basis in 0..b {
                assert_eq!(
                    motion(&init, basis, init.canonical_frame),
                    DAffine3::IDENTITY,
                    "{name}"
                );
            }
        }
    }

    #[test]
    fn clusters_of_one_body_become_one_and_a_bending_body_keeps_several() {
        let noise = |row: usize, t: f64| {
            0.02 * DVec3::new(
                (row as f64 * 7.1 + t * 3.3).sin(),
                (row as f64 * 3.7 + t * 5.9).sin(),
                0.0,
            )
        };
        let bases = |bend: f64| {
            // A rod along x that turns as a whole, or the more the farther out.
            let rod: Vec<DVec3> = (0..300)
                .map(|i| {
                    DVec3::new(
                        0.02 * f64::from(i),
                        (f64::from(i) * 2.3).sin(),
                        (f64::from(i) * 4.7).sin(),
                    )
                })
                .collect();
            let tracks = tracks(&rod, 10, |row, p, t| {
                let angle = 0.06 * (1.0 - bend + bend * p.x / 3.0) * t;
                DQuat::from_rotation_z(angle) * p + DVec3::X * 0.1 * t + noise(row, t)
            });
            initialize(&tracks, &options(12)).expect("bases").num_bases
        };
        assert_eq!(bases(0.0), 1, "a rigid rod");
        assert!(bases(1.0) >= 4, "a bending rod has {} bases", bases(1.0));
    }

    #[test]
    fn unusable_input_is_refused() {
        let mut unseen = tracks(&grid(3), 4, |_, p, _| p);
        assert_eq!(
            initialize(&unseen, &options(0)).err(),
            Some(MotionError::NoBases)
        );
        unseen.visible.fill(false);
        assert_eq!(
            initialize(&unseen, &options(2)).err(),
            Some(MotionError::NoVisibleTrack { num_tracks: 18 })
        );
        let mut broken = tracks(&grid(3), 4, |_, p, _| p);
        broken.positions[4 * 5 + 2].z = f64::NAN;
        let expected = MotionError::NotFinite {
            what: "position",
            track: 5,
            frame: 2,
        };
        assert_eq!(initialize(&broken, &options(2)).err(), Some(expected));
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_with_any_number_of_threads() {
        let wobble = |row: usize, p: DVec3, t: f64| {
            p + DVec3::new((row as f64 + t).sin(), t, (t * p.x).cos())
        };
        let tracks = tracks(&grid(20), 9, wobble);
        let run = |threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("a thread pool")
                .install(|| initialize(&tracks, &options(6)).expect("bases"))
        };
        let (one, two) = (run(1), run(2));
        assert!(
            one.rots == two.rots
                && one.transls == two.transls
                && one.coefficients == two.coefficients
        );
    }
}
