//! The rigid motion of one cluster of tracks: weighted Procrustes from the canonical frame to each
//! other frame (Shape of Motion, Wang et al. 2024).

use crate::procrustes::procrustes;
use crate::statistics::{median, median_point, quantile};
use crate::tracks::Tracks3d;
use glam::{DAffine3, DVec3};

/// Clusters of fewer tracks are not trimmed: each point counts.
const MIN_TRIMMED: usize = 10;

/// The cluster's rigid motion from `canonical` to each of the N frames: the identity, exactly, at
/// `canonical` itself, and `None` in a frame in which too few of the cluster's tracks are seen.
///
/// `tracks` have their gaps filled.
pub(crate) fn cluster_motion(
    tracks: &Tracks3d,
    members: &[usize],
    canonical: usize,
) -> Vec<Option<DAffine3>> {
    let weights = member_weights(tracks, members);
    (0..tracks.num_frames)
        .map(|t| {
            if t == canonical {
                Some(DAffine3::IDENTITY)
            } else {
                align(tracks, members, &weights, canonical, t)
            }
        })
        .collect()
}

/// The motion in every frame: an unknown one is that of the nearest frame before it, on the side of
/// the canonical frame.
pub(crate) fn without_gaps(motion: &[Option<DAffine3>], canonical: usize) -> Vec<DAffine3> {
    let mut complete = vec![DAffine3::IDENTITY; motion.len()];
    // Both sweeps start from the canonical frame (the reference lets the forward one go on from
    // frame 0, the backward sweep's end).
    for t in (0..canonical).rev() {
        complete[t] = motion[t].unwrap_or(complete[t + 1]);
    }
    for t in canonical + 1..motion.len() {
        complete[t] = motion[t].unwrap_or(complete[t - 1]);
    }
    complete
}

/// Weights [n * N] of the cluster's tracks, frame by frame: high in the middle of the cluster, zero
/// in its outskirts and where a track is not seen. Their mean over a frame's members is one or less.
fn member_weights(tracks: &Tracks3d, members: &[usize]) -> Vec<f64> {
    let n = tracks.num_frames;
    let mut distances = vec![0.0; members.len() * n]; // [n, N]
    for t in 0..n {
        let at = |&row: &usize| tracks.positions[tracks.index(row, t)];
        let center = median_point(members.iter().map(at));
        let from_center: Vec<f64> = members.iter().map(|row| at(row).distance(center)).collect();
        let typical = median(&mut from_center.clone());
        for (i, &distance) in from_center.iter().enumerate() {
            // Zero over zero where points coincide: all of them are in the middle.
            distances[i * n + t] = if distance > 0.0 {
                distance / typical
            } else {
                0.0
            };
        }
    }
    let limit = if members.len() < MIN_TRIMMED {
        f64::INFINITY
    } else {
        quantile(&mut distances.clone(), 0.9)
    };
    let mut weights: Vec<f64> = distances.iter().map(|d| (-d).exp()).collect();
    for t in 0..n {
        let mean =
            (0..members.len()).map(|i| weights[i * n + t]).sum::<f64>() / members.len() as f64;
        for (i, &row) in members.iter().enumerate() {
            let k = i * n + t;
            let counts = tracks.visible[tracks.index(row, t)] && distances[k] <= limit;
            weights[k] = if counts {
                weights[k] / (mean + 1e-6)
            } else {
                0.0
            };
        }
    }
    weights
}

/// The rigid motion from frame `from` to frame `to`, or `None` where fewer than three tracks (5 % of
/// a large cluster, all of a tiny one) are seen in both.
fn align(
    tracks: &Tracks3d,
    members: &[usize],
    weights: &[f64],
    from: usize,
    to: usize,
) -> Option<DAffine3> {
    let n = tracks.num_frames;
    let (mut src, mut dst, mut pair_weights): (Vec<DVec3>, Vec<DVec3>, Vec<f64>) =
        Default::default();
    for (i, &row) in members.iter().enumerate() {
        let (a, b) = (tracks.index(row, from), tracks.index(row, to));
        let confidence = 0.5 * (f64::from(tracks.confidence[a]) + f64::from(tracks.confidence[b]));
        let weight = weights[i * n + from] * weights[i * n + to] * confidence;
        if weight > 0.0 {
            src.push(tracks.positions[a]);
            dst.push(tracks.positions[b]);
            pair_weights.push(weight);
        }
    }
    let needed = (members.len() / 20).max(3).min(members.len());
    if src.len() < needed {
        return None;
    }
    procrustes(&src, &dst, &pair_weights)
}
