//! Clusters that move as one rigid body become one: a scene of two rigid movers gets two bases,
//! however many were asked for.

use crate::basis_init::cluster_motion;
use crate::statistics::median;
use crate::tracks::Tracks3d;
use glam::{DAffine3, DMat3, DVec3};

/// Two motions are one that take tracks apart by at most this many times what the tracks are off.
pub(crate) const MAX_APART: f64 = 1.2;
/// Whatever the tracks say, they are off by this part of the foreground's extent.
const NOISE_FLOOR: f64 = 0.01;
/// What is off by more than this many times the median of its frame is the tracker's mistake.
const MISTAKE: f64 = 3.0;
/// Members of a cluster that are looked at, evenly spread.
const MAX_SAMPLES: usize = 300;

/// Motion from the canonical frame to each frame, where it is known.
type Motion = Vec<Option<DAffine3>>;

/// Tracks that share a motion.
#[derive(Clone, Debug)]
pub(crate) struct Cluster {
    /// Rows of the tracks, ascending.
    pub(crate) members: Vec<usize>,
    /// What moves them.
    pub(crate) motion: Motion,
    /// What moves every other of them from the first on, and what the others: how sure the motion is.
    pub(crate) halves: [Motion; 2],
}

impl Cluster {
    pub(crate) fn new(tracks: &Tracks3d, canonical: usize, members: Vec<usize>) -> Self {
        let half = |first| {
            let half: Vec<usize> = members.iter().copied().skip(first).step_by(2).collect();
            if half.is_empty() {
                return vec![None; tracks.num_frames];
            }
            cluster_motion(tracks, &half, canonical)
        };
        Self {
            motion: cluster_motion(tracks, &members, canonical),
            halves: [half(0), half(1)],
            members,
        }
    }

    /// By how much the motion to frame `t` is likely to misplace a point there: as much as half of what its halves are apart, for each
    /// of them is twice as unsure as the whole. `None` where one of them is unknown.
    fn unsure(&self, t: usize, start: DVec3) -> Option<DVec3> {
        let [a, b] = &self.halves;
        Some(0.5 * (a[t]?.transform_point3(start) - b[t]?.transform_point3(start)))
    }
}

/// The tracks by which clusters of them are told apart.
pub(crate) struct Merging<'a> {
    pub(crate) tracks: &'a Tracks3d,
    pub(crate) canonical: usize,
    /// Of the foreground, scene units.
    pub(crate) extent: f64,
}

impl Merging<'_> {
    /// Lets clusters absorb smaller ones whose motion is no more than `max_apart` from theirs, the closest first, until none is
    /// left to absorb.
    ///
    /// One way is enough: a few tracks leave their rotation open, so their motion explains nobody else.
    pub(crate) fn merge(&self, mut clusters: Vec<Cluster>, max_apart: f64) -> Vec<Cluster> {
        // apart[a][b], b < a.
        let mut apart: Vec<Vec<f64>> = (0..clusters.len())
            .map(|a| {
                (0..a)
                    .map(|b| self.apart(&clusters[a], &clusters[b]))
                    .collect()
            })
            .collect();
        loop {
            let mut closest = (f64::INFINITY, 0, 0);
            for (a, row) in apart.iter().enumerate() {
                for (b, &distance) in row.iter().enumerate() {
                    if distance < closest.0 {
                        closest = (distance, a, b);
                    }
                }
            }
            let (distance, a, b) = closest;
            if distance > max_apart {
                return clusters;
            }
            self.absorb(&mut clusters, a, b);
            apart.remove(a);
            for row in &mut apart[a..] {
                row.remove(a);
            }
            for other in (0..clusters.len()).filter(|&other| other != b) {
                apart[other.max(b)][other.min(b)] = self.apart(&clusters[other], &clusters[b]);
            }
        }
    }

    /// One cluster fewer: the two whose motions are most alike are one. `None` where no two can be compared.
    pub(crate) fn merge_closest(&self, clusters: &[Cluster]) -> Option<Vec<Cluster>> {
        let pairs = (0..clusters.len()).flat_map(|a| (0..a).map(move |b| (a, b)));
        let pairs = pairs.map(|(a, b)| (self.apart(&clusters[a], &clusters[b]), a, b));
        let comparable = pairs.filter(|(apart, ..)| apart.is_finite());
        let (_, a, b) = comparable.min_by(|x, y| x.0.total_cmp(&y.0))?;
        let mut fewer = clusters.to_vec();
        self.absorb(&mut fewer, a, b);
        Some(fewer)
    }

    /// Lets cluster `into` have the tracks of cluster `from`, which is behind it and goes.
    fn absorb(&self, clusters: &mut Vec<Cluster>, from: usize, into: usize) {
        let mut members = clusters.remove(from).members;
        members.append(&mut clusters[into].members);
        members.sort_unstable();
        clusters[into] = Cluster::new(self.tracks, self.canonical, members);
    }

    /// How far apart the motion of the larger of two clusters and that of the smaller take the tracks of the smaller: the root
    /// mean square over tracks, frames and directions, in each direction as a multiple of what the tracks are off there
    /// (Mahalanobis 1936), by what the smaller cluster's own motion leaves of them. What both motions are unsure of is no difference:
    /// a motion that was fitted to one side of a body misplaces the other.
    ///
    /// Along the rays tracks are as far off as given depth is, and alike where they are near each other, so that every part of a
    /// rigid body does a little better by a motion of its own. Across the rays they are off by less, and tell what bends.
    ///
    /// Infinite where no frame besides the canonical one can be compared, or less than half of those in which the smaller is known.
    fn apart(&self, a: &Cluster, b: &Cluster) -> f64 {
        let (large, small) = if a.members.len() > b.members.len() {
            (a, b)
        } else {
            (b, a)
        };
        let (mut noise, mut apart) = (Spread::NONE, Spread::NONE);
        let mut unsure = [Spread::NONE, Spread::NONE];
        let (mut compared, mut known) = (0, 0);
        for t in (0..self.tracks.num_frames).filter(|t| *t != self.canonical) {
            let Some((own, seen)) = small.motion[t].zip(self.seen(&small.members, t)) else {
                continue;
            };
            known += 1;
            let Some(other) = large.motion[t] else {
                continue;
            };
            compared += 1;
            let off = |(start, there): &(DVec3, DVec3)| own.transform_point3(*start) - *there;
            let typical = median(&mut Vec::from_iter(
                seen.iter().map(|pair| off(pair).length()),
            ));
            let trusted = |off: &DVec3| off.length() <= MISTAKE * typical;
            noise.add(seen.iter().map(off).filter(trusted));
            let difference = |(start, _): &(DVec3, DVec3)| {
                other.transform_point3(*start) - own.transform_point3(*start)
            };
            apart.add(seen.iter().map(difference));
            for (spread, cluster) in unsure.iter_mut().zip([large, small]) {
                spread.add(
                    seen.iter()
                        .filter_map(|(start, _)| cluster.unsure(t, *start)),
                );
            }
        }
        if compared == 0 || 2 * compared < known {
            return f64::INFINITY;
        }
        // Six parameters were fitted to three numbers per member: so much smaller is what they leave.
        let members = small.members.len().max(3) as f64;
        let floor = DMat3::from_diagonal(DVec3::splat((NOISE_FLOOR * self.extent).powi(2)));
        let noise = noise.mean() * (members / (members - 2.0)) + floor;
        let apart = apart.mean() - unsure[0].mean() - unsure[1].mean();
        let squares = noise.inverse() * apart;
        let trace = squares.x_axis.x + squares.y_axis.y + squares.z_axis.z;
        (trace.max(0.0) / 3.0).sqrt()
    }

    /// Where a cluster's tracks are in the canonical frame and in frame `t`; `None` where fewer than three of them (half of a tiny
    /// cluster) are seen in both.
    fn seen(&self, members: &[usize], t: usize) -> Option<Vec<(DVec3, DVec3)>> {
        let step = members.len().div_ceil(MAX_SAMPLES).max(1);
        let at = |row: usize, t: usize| {
            let i = self.tracks.index(row, t);
            self.tracks.visible[i].then(|| self.tracks.positions[i])
        };
        let pairs: Vec<(DVec3, DVec3)> = members
            .iter()
            .step_by(step)
            .filter_map(|&row| Some((at(row, self.canonical)?, at(row, t)?)))
            .collect();
        (pairs.len() >= members.len().div_ceil(2).min(3)).then_some(pairs)
    }
}

/// The mean of v v^T over vectors v.
struct Spread {
    sum: DMat3,
    count: usize,
}

impl Spread {
    const NONE: Self = Self {
        sum: DMat3::ZERO,
        count: 0,
    };

    fn add(&mut self, vectors: impl Iterator<Item = DVec3>) {
        for v in vectors {
            self.sum += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
            self.count += 1;
        }
    }

    fn mean(&self) -> DMat3 {
        self.sum / self.count.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    const FRAMES: usize = 100;
    const TRACKS: usize = 400;

    /// Two clusters of tracks whose points `at` has (whether of the second, a vector of numbers from -1 to 1) in the canonical frame,
    /// elsewhere by `moved` in the others, and off by up to `noise` along each axis there. Gives how far apart they are, and the root
    /// mean square of what lies between where their motions take the points of the second, scene units.
    fn apart(
        at: impl Fn(bool, DVec3) -> DVec3,
        moved: impl Fn(bool, usize) -> DVec3,
        noise: DVec3,
    ) -> (f64, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut number = || (rng.next_u64() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0;
        let mut vector = || DVec3::new(number(), number(), number());
        let count = 2 * TRACKS * FRAMES;
        let mut tracks = Tracks3d {
            num_frames: FRAMES,
            positions: Vec::new(),
            visible: vec![true; count],
            confidence: vec![1.0; count],
            colors: vec![[0.5; 3]; 2 * TRACKS],
        };
        for row in 0..2 * TRACKS {
            let is_second = row >= TRACKS;
            let point = at(is_second, vector());
            tracks.positions.push(point);
            let there = (1..FRAMES).map(|t| point + moved(is_second, t) + noise * vector());
            tracks.positions.extend(there);
        }
        let [first, second] =
            [0, TRACKS].map(|first| Cluster::new(&tracks, 0, (first..first + TRACKS).collect()));
        let merging = Merging {
            tracks: &tracks,
            canonical: 0,
            extent: 0.01, // so that the floor is far below the noise
        };
        let between = second.members.iter().flat_map(|row| {
            let start = tracks.positions[tracks.index(*row, 0)];
            let place = move |cluster: &Cluster, t: usize| {
                let motion = cluster.motion[t].expect("a motion");
                motion.transform_point3(start)
            };
            let (first, second) = (&first, &second);
            (1..FRAMES).map(move |t| place(first, t).distance_squared(place(second, t)))
        });
        let between = between.sum::<f64>() / (TRACKS * (FRAMES - 1)) as f64;
        (merging.apart(&first, &second), between.sqrt())
    }

    #[test]
    fn motions_are_as_far_apart_as_they_differ_by_the_noise_of_each_direction() {
        // What is drawn evenly from -a to a has a root mean square of a / sqrt(3).
        let noise = DVec3::new(0.02, 0.02, 0.1);
        for (axis, noise_there) in [(DVec3::X, noise.x), (DVec3::Z, noise.z)] {
            for times in [1.0, 2.0, 5.0] {
                let differs = axis * (times * noise_there / 3.0_f64.sqrt());
                let to_and_fro = |is_second: bool, t: usize| match (is_second, t % 2) {
                    (false, _) => DVec3::ZERO,
                    (true, 0) => differs,
                    (true, _) => -differs,
                };
                let (found, _) = apart(|_, place| place, to_and_fro, noise);
                let expected = times / 3.0_f64.sqrt(); // in one direction of three
                assert!(
                    (found / expected - 1.0).abs() < 0.1,
                    "{axis}, {times} times the noise: {found}, not {expected}"
                );
            }
        }
    }

    #[test]
    fn what_one_side_of_a_body_says_of_the_other_is_no_difference() {
        // Two small patches of a body that stands still: the turn of each is known badly, and the other is far away.
        let noise = 0.05;
        let patch = |is_second: bool, place: DVec3| {
            let side = if is_second { DVec3::X } else { -DVec3::X };
            side + 0.05 * place
        };
        let (found, between) = apart(patch, |_, _| DVec3::ZERO, DVec3::splat(noise));
        assert!(between > 2.0 * noise, "{between} is easily told apart");
        assert!(found < 0.5, "{found} times the noise");
    }
}
