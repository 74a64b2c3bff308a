//! Gaussians sorted into parts of like motion, each with the rigid motion that fits it best, as k-means does.

use glam::{DAffine3, DVec3};
use motion_bases::procrustes;

/// The movers in the canonical frame.
pub(crate) struct Movers {
    /// [F].
    pub(crate) means: Vec<DVec3>,
    /// Longest axis of each, one standard deviation, scene units, [F].
    pub(crate) lengths: Vec<f64>,
    /// [F].
    pub(crate) opacities: Vec<f64>,
}

/// The movers at one time.
pub(crate) struct Posed {
    /// Each one's own motion from the canonical frame, [F].
    pub(crate) motions: Vec<DAffine3>,
    /// Pixels of a scene unit at each one's place, [F].
    pub(crate) scales_px: Vec<f64>,
}

/// Of a part's Gaussians, by how far off they are, where a new part begins: an outlier's motion is nobody else's.
const NO_OUTLIER: f64 = 0.9;
/// Rounds in which parts take their best motions and Gaussians their best parts.
const ROUNDS: usize = 4;

/// Which part each Gaussian is of.
pub(crate) struct Groups {
    /// Of each part, at each time.
    pub(crate) motions: Vec<Vec<DAffine3>>,
    /// [F].
    pub(crate) parts: Vec<usize>,
    /// How far off each is at most, px, [F].
    off_px: Vec<f64>,
}

impl Groups {
    /// Its Gaussians, in order.
    pub(crate) fn rows_of(&self, part: usize) -> Vec<usize> {
        (0..self.parts.len())
            .filter(|i| self.parts[*i] == part)
            .collect()
    }

    /// All movers of one part yet, which has no motion.
    pub(crate) fn new(movers: &Movers) -> Self {
        let n = movers.means.len();
        Self {
            motions: Vec::new(),
            parts: vec![0; n],
            off_px: vec![f64::INFINITY; n],
        }
    }

    /// As many parts as wanted, fewer where nothing is off any more: new ones within those that fit worst, and then in turn the
    /// best motion for every part and the best part for every Gaussian.
    pub(crate) fn grow(&mut self, wanted: usize, movers: &Movers, posed: &[Posed]) {
        while self.motions.len() < wanted
            && let Some(seed) = self.seed(movers)
        {
            let motions = posed.iter().map(|at| at.motions[seed]);
            self.motions.push(motions.collect());
            self.offer(self.motions.len() - 1, movers, posed);
        }
        for _ in 0..ROUNDS {
            for part in 0..self.motions.len() {
                let rows = self.rows_of(part);
                if let Some(fitted) = fitted(&rows, movers, posed) {
                    self.motions[part] = fitted;
                }
            }
            self.off_px.fill(f64::INFINITY);
            for part in 0..self.motions.len() {
                self.offer(part, movers, posed);
            }
        }
    }

    /// A Gaussian that is far off, but no outlier, in the part that fits worst; `None` where none is off.
    fn seed(&self, movers: &Movers) -> Option<usize> {
        let mut sums = vec![0.0; self.motions.len().max(1)];
        for (i, part) in self.parts.iter().enumerate() {
            sums[*part] += self.off_px[i].min(1e6) * movers.opacities[i];
        }
        let worst = (0..sums.len()).max_by(|a, b| sums[*a].total_cmp(&sums[*b]))?;
        let mut rows = self.rows_of(worst);
        rows.sort_by(|a, b| self.off_px[*a].total_cmp(&self.off_px[*b]));
        let seed = *rows.get((NO_OUTLIER * rows.len().saturating_sub(1) as f64) as usize)?;
        (self.off_px[seed] > 0.0).then_some(seed)
    }

    /// Gives Gaussians to a part that suits them better than theirs.
    fn offer(&mut self, part: usize, movers: &Movers, posed: &[Posed]) {
        for i in 0..self.parts.len() {
            let bound = self.off_px[i];
            let off = off_px(i, &self.motions[part], movers, posed, bound);
            if off < bound {
                (self.parts[i], self.off_px[i]) = (part, off);
            }
        }
    }
}

/// The rigid motion at each time that brings Gaussians nearest to where they are: their means, and the tips of their ellipsoids,
/// for which a ball of each one's size stands.
fn fitted(rows: &[usize], movers: &Movers, posed: &[Posed]) -> Option<Vec<DAffine3>> {
    let points = rows.iter().flat_map(|&i| {
        let axes = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z];
        axes.map(|axis| (i, movers.means[i] + axis * movers.lengths[i]))
    });
    let points: Vec<(usize, DVec3)> = points.collect();
    let source: Vec<DVec3> = points.iter().map(|(_, point)| *point).collect();
    let weights: Vec<f64> = points.iter().map(|(i, _)| movers.opacities[*i]).collect();
    let fitted = posed.iter().map(|at| {
        let moved = |(i, point): &(usize, DVec3)| at.motions[*i].transform_point3(*point);
        let moved: Vec<DVec3> = points.iter().map(moved).collect();
        procrustes(&source, &moved, &weights)
    });
    fitted.collect()
}

/// How far off Gaussian `i` is at most with a part's motion; anything from `bound` on where it is not under that.
fn off_px(i: usize, motions: &[DAffine3], movers: &Movers, posed: &[Posed], bound: f64) -> f64 {
    let (mean, length) = (movers.means[i], movers.lengths[i]);
    let mut most = 0.0_f64;
    for (other, at) in motions.iter().zip(posed) {
        let own = &at.motions[i];
        let away = own.transform_point3(mean) - other.transform_point3(mean);
        let turned = (own.matrix3 - other.matrix3).to_cols_array();
        // The chord that a tip goes at most.
        let turned = (0.5 * turned.iter().map(|v| v * v).sum::<f64>()).sqrt() * length;
        most = most.max((away.length() + turned) * at.scales_px[i]);
        if most >= bound {
            break;
        }
    }
    most
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    /// Movers in a row, and their motions at three times.
    fn scene(motions: &[[DAffine3; 3]]) -> (Movers, Vec<Posed>) {
        let n = motions.len();
        let movers = Movers {
            means: (0..n).map(|i| DVec3::new(i as f64, 0.5, 0.0)).collect(),
            lengths: vec![0.01; n],
            opacities: vec![0.5; n],
        };
        let posed = (0..3).map(|t| Posed {
            motions: motions.iter().map(|m| m[t]).collect(),
            scales_px: vec![100.0; n],
        });
        (movers, posed.collect())
    }

    fn turn(angle: f64, x: f64) -> DAffine3 {
        DAffine3::from_rotation_translation(DQuat::from_rotation_z(angle), DVec3::X * x)
    }

    fn grown(wanted: usize, movers: &Movers, posed: &[Posed]) -> (Groups, f64) {
        let mut groups = Groups::new(movers);
        groups.grow(wanted, movers, posed);
        let off = groups.off_px.iter().copied().fold(0.0, f64::max);
        (groups, off)
    }

    #[test]
    fn what_moves_alike_is_one_part_and_nothing_is_off() {
        let [a, b] = [1.0, -1.0].map(|way| [0.0, 0.5, 1.0].map(|t| turn(0.3 * t * way, t * way)));
        let (movers, posed) = scene(&[a, b, a, a, b]);
        let (groups, off) = grown(2, &movers, &posed);
        let [first, other] = [groups.parts[0], groups.parts[1]];
        assert_eq!(groups.parts, [first, other, first, first, other]);
        assert!(first != other && off < 1e-9, "{off}");
        for (t, at) in posed.iter().enumerate() {
            let fitted = groups.motions[first][t];
            assert!(fitted.abs_diff_eq(at.motions[0], 1e-9), "{fitted:?}");
        }
    }

    #[test]
    fn what_bends_is_nearer_the_more_parts_there_are() {
        let bend = |i: usize| [0.0, 1.0, 2.0].map(|t| turn(0.01 * t * i as f64, 0.1 * t));
        let (movers, posed) = scene(&(0..24).map(bend).collect::<Vec<_>>());
        let off = [1, 6, 24].map(|wanted| grown(wanted, &movers, &posed).1);
        let nearer = off[1] < 0.1 * off[0] && off[2] < off[1];
        assert!(off[0] > 10.0 && nearer, "{off:?}");
    }

    #[test]
    fn without_movers_there_are_no_parts() {
        let (movers, _) = scene(&[]);
        let (groups, _) = grown(4, &movers, &[]);
        assert!(groups.motions.is_empty() && groups.parts.is_empty());
    }
}
