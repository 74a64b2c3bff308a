//! From 3D tracks to bases and coefficients (method facts 2.3 and 2.4).

use crate::MotionError;
use crate::basis_init::cluster_motion;
use crate::clustering::cluster;
use crate::statistics::{half_range, median_point};
use crate::tracks::Tracks3d;
use glam::{DAffine3, DVec3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Tracks per basis at least, when the number of bases is limited by that of the tracks: three
/// points determine a rigid motion.
const TRACKS_PER_BASIS: usize = 3;
/// A cluster with less than this share of the tracks is left out (100 of 40,000 in Shape of Motion).
const MIN_SHARE: usize = 400;

/// How many bases, and from which random numbers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InitOptions {
    /// Largest number of bases; fewer are returned where the tracks do not support as many.
    pub num_bases: usize,
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
    /// 6D rotations, [B, N, 6].
    pub rots: Vec<f64>,
    /// Translations in scene units, [B, N, 3].
    pub transls: Vec<f64>,
    /// The tracks that were kept, in their order; positions that are not visible are interpolated.
    pub tracks: Tracks3d,
    /// Their positions as they came in, [P * N]: what a hidden entry says about the pixel stands here.
    pub observed: Vec<DVec3>,
    /// Which rows of the input were kept, [P].
    pub rows: Vec<usize>,
    /// Motion coefficients (logits), [P, B].
    pub coefficients: Vec<f32>,
    /// Size of the foreground in scene units: half of its largest range along an axis in the
    /// canonical frame, without the outer 5 % on either side. Positive.
    pub extent: f64,
}

/// Finds motion bases: fills gaps, drops outliers, clusters the directions of the velocities, aligns
/// each cluster with itself in every frame, and weighs the bases by the distance to the clusters.
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
    let clusters = cluster_tracks(&filled, extent, options);

    let (motions, centers): (Vec<Vec<DAffine3>>, Vec<DVec3>) = clusters
        .par_iter()
        .map(|members| {
            let at = |&row: &usize| filled.positions[filled.index(row, canonical_frame)];
            (
                cluster_motion(&filled, members, canonical_frame),
                median_point(members.iter().map(at)),
            )
        })
        .unzip();
    let coefficients = coefficients(&filled, canonical_frame, &centers, extent);
    Ok(MotionInit {
        canonical_frame,
        num_bases: clusters.len(),
        rots: motions.iter().flatten().flat_map(six_numbers).collect(),
        transls: motions
            .iter()
            .flatten()
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
    let k = options.num_bases.min((count / TRACKS_PER_BASIS).max(1));
    let labels = cluster(&directions, 3 * (n - 1), count, k, &mut rng);
    let mut clusters = vec![Vec::new(); labels.iter().max().map_or(0, |&l| l + 1)];
    for (row, &label) in labels.iter().enumerate() {
        clusters[label].push(row);
    }
    let largest = clusters.iter().map(Vec::len).max().unwrap_or(0);
    let enough = count.div_ceil(MIN_SHARE).min(largest);
    clusters.retain(|members| members.len() >= enough);
    clusters
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
