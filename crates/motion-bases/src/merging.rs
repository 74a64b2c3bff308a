//! Clusters that move as one rigid body become one: a scene of two rigid movers gets two bases,
//! however many were asked for.

use crate::basis_init::cluster_motion;
use crate::statistics::median;
use crate::tracks::Tracks3d;
use glam::DAffine3;

/// A motion explains another cluster where its typical error is at most this factor times that of
/// the cluster's own motion (which was fitted to the same noise), plus …
const ERROR_RATIO: f64 = 1.5;
/// … this part of the foreground's extent.
const ERROR_FLOOR: f64 = 0.01;
/// Members of a cluster that are looked at, evenly spread.
const MAX_SAMPLES: usize = 300;

/// Tracks that share a motion.
#[derive(Clone, Debug)]
pub(crate) struct Cluster {
    /// Rows of the tracks, ascending.
    pub(crate) members: Vec<usize>,
    /// Motion from the canonical frame to each frame, where it is known.
    pub(crate) motion: Vec<Option<DAffine3>>,
}

/// Lets clusters absorb smaller ones whose tracks their own motion explains, the best explained
/// first, until none is left to absorb.
///
/// One way is enough: a few tracks leave their rotation open, so their motion explains nobody else.
pub(crate) fn merge(
    tracks: &Tracks3d,
    canonical: usize,
    extent: f64,
    mut clusters: Vec<Cluster>,
) -> Vec<Cluster> {
    let pair_cost = |a: &Cluster, b: &Cluster| pair_cost(tracks, canonical, extent, a, b);
    // costs[a][b], b < a; under 1 for a pair to merge.
    let mut costs: Vec<Vec<f64>> = (0..clusters.len())
        .map(|a| {
            (0..a)
                .map(|b| pair_cost(&clusters[a], &clusters[b]))
                .collect()
        })
        .collect();
    loop {
        let mut best = (f64::INFINITY, 0, 0);
        for (a, row) in costs.iter().enumerate() {
            for (b, &cost) in row.iter().enumerate() {
                if cost < best.0 {
                    best = (cost, a, b);
                }
            }
        }
        let (cost, a, b) = best;
        if cost >= 1.0 {
            return clusters;
        }
        absorb(tracks, canonical, &mut clusters, a, b);
        costs.remove(a);
        for row in &mut costs[a..] {
            row.remove(a);
        }
        for other in (0..clusters.len()).filter(|&other| other != b) {
            costs[other.max(b)][other.min(b)] = pair_cost(&clusters[other], &clusters[b]);
        }
    }
}

/// One cluster fewer: the two whose motions are most alike are one. `None` where no two can be compared.
pub(crate) fn merge_closest(
    tracks: &Tracks3d,
    canonical: usize,
    extent: f64,
    clusters: &[Cluster],
) -> Option<Vec<Cluster>> {
    let pairs = (0..clusters.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
    let costs = pairs.map(|(a, b)| {
        let cost = pair_cost(tracks, canonical, extent, &clusters[a], &clusters[b]);
        (cost, a, b)
    });
    let comparable = costs.filter(|(cost, ..)| cost.is_finite());
    let (_, a, b) = comparable.min_by(|x, y| x.0.total_cmp(&y.0))?;
    let mut fewer = clusters.to_vec();
    absorb(tracks, canonical, &mut fewer, a, b);
    Some(fewer)
}

/// Lets cluster `into` have the tracks of cluster `from`, which is behind it and goes.
fn absorb(
    tracks: &Tracks3d,
    canonical: usize,
    clusters: &mut Vec<Cluster>,
    from: usize,
    into: usize,
) {
    let from = clusters.remove(from);
    let into = &mut clusters[into];
    into.members.extend(from.members);
    into.members.sort_unstable();
    into.motion = cluster_motion(tracks, &into.members, canonical);
}

/// How badly the motion of the larger of two clusters explains the tracks of the smaller; see [`excess`].
fn pair_cost(tracks: &Tracks3d, canonical: usize, extent: f64, a: &Cluster, b: &Cluster) -> f64 {
    let typical = |motion: &Cluster, of: &Cluster| {
        frame_errors(tracks, canonical, &motion.motion, &of.members)
    };
    let (large, small) = if a.members.len() > b.members.len() {
        (a, b)
    } else {
        (b, a)
    };
    excess(
        &typical(large, small),
        &typical(small, small),
        small.members.len(),
        extent,
    )
}

/// The root mean square of the errors over that which is allowed, given those of the cluster's own
/// motion; over the frames that have both. Infinite where these are too few: only the canonical
/// frame, or less than half of those with an own error.
fn excess(errors: &[Option<f64>], own: &[Option<f64>], num_members: usize, extent: f64) -> f64 {
    let (mut square, mut own_square, mut compared, mut known) = (0.0, 0.0, 0, 0);
    for (error, own) in errors.iter().zip(own) {
        let Some(own) = own else { continue };
        known += 1;
        if let Some(error) = error {
            square += error * error;
            own_square += own * own;
            compared += 1;
        }
    }
    if compared < 2 || 2 * compared < known {
        return f64::INFINITY;
    }
    // Six parameters were fitted to three numbers per member: so much smaller is the own error.
    let members = num_members.max(3) as f64;
    let noise = (own_square / f64::from(compared) * members / (members - 2.0)).sqrt();
    (square / f64::from(compared)).sqrt() / (ERROR_RATIO * noise + ERROR_FLOOR * extent)
}

/// Per frame the median distance between where a motion takes the tracks and where they are seen;
/// `None` where the motion is unknown, or fewer than three tracks (half of a tiny cluster) are seen
/// there and in the canonical frame.
fn frame_errors(
    tracks: &Tracks3d,
    canonical: usize,
    motion: &[Option<DAffine3>],
    members: &[usize],
) -> Vec<Option<f64>> {
    let step = members.len().div_ceil(MAX_SAMPLES).max(1);
    let starts: Vec<usize> = members
        .iter()
        .copied()
        .step_by(step)
        .filter(|&row| tracks.visible[tracks.index(row, canonical)])
        .collect();
    let needed = members.len().div_ceil(2).min(3);
    (0..tracks.num_frames)
        .map(|t| {
            let motion = motion[t]?;
            let mut distances: Vec<f64> = starts
                .iter()
                .filter(|&&row| tracks.visible[tracks.index(row, t)])
                .map(|&row| {
                    let start = tracks.positions[tracks.index(row, canonical)];
                    let there = tracks.positions[tracks.index(row, t)];
                    motion.transform_point3(start).distance(there)
                })
                .collect();
            (distances.len() >= needed).then(|| median(&mut distances))
        })
        .collect()
}
