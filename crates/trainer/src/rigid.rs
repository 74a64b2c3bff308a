//! Movers as parts that move as one, for formats that know rigid motion alone.
//!
//! Every dynamic Gaussian has a rigid motion of its own, blended of all bases by its own coefficients. Gaussians move as one
//! exactly where they have the same coefficients, and nearly so where these are alike. So they are sorted into parts, each with the
//! motion that fits its Gaussians best (Procrustes at each time), as k-means does: where a Gaussian is too far off, there are
//! twice as many parts, the new ones beginning with the motions of those that are farthest off.

use crate::run::Run;
use crate::world::World;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use motion_bases::procrustes;

/// Parts of a scene's movers, each of which moves as one.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidParts {
    /// Times of the poses: the training frames'.
    pub times: Vec<f32>,
    /// The parts; none where nothing moves.
    pub parts: Vec<RigidPart>,
    /// How far off each mover is at most, in pixels of the frame of that time: its mean, and the tip of its ellipsoid. In
    /// ascending order.
    pub off_px: Vec<f64>,
}

/// Gaussians that move as one.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidPart {
    /// Rows of the Gaussians, which are in the canonical frame.
    pub rows: Vec<usize>,
    /// World from canonical frame at each time: quaternions (w, x, y, z), `[T]`.
    pub rotations: Vec<[f32; 4]>,
    /// Scene units, `[T]`.
    pub translations: Vec<[f32; 3]>,
}

/// The movers at one time.
struct Posed {
    /// Each one's own motion from the canonical frame, [F].
    motions: Vec<DAffine3>,
    /// Pixels of a scene unit at each one's place, [F].
    scales_px: Vec<f64>,
}

impl Run {
    /// The movers in as few parts as leave none farther off than `tolerance_px`, and in at most `most` of them, whatever that
    /// leaves.
    #[must_use]
    pub fn rigid_parts(&self, tolerance_px: f64, most: usize) -> RigidParts {
        let world = self.model().world.detached();
        let views = &self.views().train;
        let times: Vec<f32> = views.iter().map(|view| view.time).collect();
        let nearest = 0.1 * self.survey().scene_size;
        let movers = movers(&world);
        let posed: Vec<Posed> = views
            .iter()
            .filter_map(|view| {
                let motions = motions(&world, &movers.means, view.time)?;
                let places = motions.iter().zip(&movers.means);
                let scale = |(motion, mean): (&DAffine3, &DVec3)| {
                    let place = motion.transform_point3(*mean);
                    let depth = view.cam_from_world.transform_point3(place).z;
                    view.camera.fx / depth.max(nearest)
                };
                let scales_px = places.map(scale).collect();
                Some(Posed { motions, scales_px })
            })
            .collect();
        let mut groups = group(&movers, &posed, tolerance_px, most);
        let parts = groups.motions.iter().enumerate().map(|(part, motions)| {
            let rotation = |motion: &DAffine3| {
                let q = DQuat::from_mat3(&motion.matrix3).normalize();
                [q.w, q.x, q.y, q.z].map(|v| v as f32)
            };
            let translation = |motion: &DAffine3| motion.translation.as_vec3().to_array();
            RigidPart {
                rows: groups.rows_of(part),
                rotations: motions.iter().map(rotation).collect(),
                translations: motions.iter().map(translation).collect(),
            }
        });
        let parts = parts.filter(|part| !part.rows.is_empty()).collect();
        groups.off_px.sort_unstable_by(f64::total_cmp);
        RigidParts {
            parts,
            times,
            off_px: groups.off_px,
        }
    }
}

/// The movers in the canonical frame.
struct Movers {
    /// [F].
    means: Vec<DVec3>,
    /// Longest axis of each, one standard deviation, scene units, [F].
    lengths: Vec<f64>,
    /// [F].
    opacities: Vec<f64>,
}

/// Each mover's motion from the canonical frame, whose means are given, at a time; `None` where nothing moves.
fn motions(world: &World, canonical: &[DVec3], time: f32) -> Option<Vec<DAffine3>> {
    let (means, rotations) = world.motions(time)?;
    let motions = means.iter().zip(&rotations).zip(canonical);
    let motion = |((moved, rotation), mean): ((&[f32; 3], &[f64; 9]), &DVec3)| {
        let rotation = DMat3::from_cols_array(rotation).transpose();
        let moved = DVec3::from_array(moved.map(f64::from));
        DAffine3::from_mat3_translation(rotation, moved - rotation * *mean)
    };
    Some(motions.map(motion).collect())
}

fn movers(world: &World) -> Movers {
    let gaussians = world.gaussians(None);
    let rows = || 0..world.num_dynamic;
    let length = |i: usize| {
        let [a, b, c] = gaussians.log_scales[i].map(|s| f64::from(s).exp());
        a.max(b).max(c)
    };
    let mean = |i: usize| DVec3::from_array(gaussians.means[i].map(f64::from));
    let opacity = |i: usize| 1.0 / (1.0 + (-f64::from(gaussians.opacity_logits[i])).exp());
    Movers {
        means: rows().map(mean).collect(),
        lengths: rows().map(length).collect(),
        opacities: rows().map(opacity).collect(),
    }
}

/// Which part each Gaussian is of.
struct Groups {
    /// Of each part, at each time.
    motions: Vec<Vec<DAffine3>>,
    /// [F].
    parts: Vec<usize>,
    /// How far off each is at most, px, [F].
    off_px: Vec<f64>,
}

impl Groups {
    fn rows_of(&self, part: usize) -> Vec<usize> {
        (0..self.parts.len())
            .filter(|i| self.parts[*i] == part)
            .collect()
    }

    fn farthest(&self) -> Option<usize> {
        (0..self.off_px.len()).max_by(|a, b| self.off_px[*a].total_cmp(&self.off_px[*b]))
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

/// Rounds in which parts take their best motions and Gaussians their best parts.
const ROUNDS: usize = 4;

fn group(movers: &Movers, posed: &[Posed], tolerance_px: f64, most: usize) -> Groups {
    let n = movers.means.len();
    let mut groups = Groups {
        motions: Vec::new(),
        parts: vec![0; n],
        off_px: vec![f64::INFINITY; n],
    };
    let is_off = |groups: &Groups| {
        let farthest = groups.farthest();
        farthest.filter(|i| groups.off_px[*i] > tolerance_px)
    };
    let mut wanted = 1;
    while is_off(&groups).is_some() {
        while groups.motions.len() < wanted
            && let Some(seed) = is_off(&groups)
        {
            let motions = posed.iter().map(|at| at.motions[seed]);
            groups.motions.push(motions.collect());
            groups.offer(groups.motions.len() - 1, movers, posed);
        }
        for _ in 0..ROUNDS {
            for part in 0..groups.motions.len() {
                let rows = groups.rows_of(part);
                if let Some(fitted) = fitted(&rows, movers, posed) {
                    groups.motions[part] = fitted;
                }
            }
            groups.off_px.fill(f64::INFINITY);
            for part in 0..groups.motions.len() {
                groups.offer(part, movers, posed);
            }
        }
        if wanted >= most {
            break;
        }
        wanted = (2 * wanted).min(most);
    }
    groups
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

    #[test]
    fn what_moves_alike_is_one_part_and_nothing_is_off() {
        let [a, b] = [1.0, -1.0].map(|way| [0.0, 0.5, 1.0].map(|t| turn(0.3 * t * way, t * way)));
        let (movers, posed) = scene(&[a, b, a, a, b]);
        let groups = group(&movers, &posed, 0.1, 16);
        assert_eq!(groups.motions.len(), 2);
        let [first, other] = [groups.parts[0], groups.parts[1]];
        assert_eq!(groups.parts, [first, other, first, first, other]);
        assert_ne!(first, other);
        assert!(groups.off_px.iter().all(|off| *off < 1e-9));
        for (t, at) in posed.iter().enumerate() {
            let fitted = groups.motions[first][t];
            assert!(fitted.abs_diff_eq(at.motions[0], 1e-9), "{fitted:?}");
        }
    }

    #[test]
    fn what_bends_is_cut_until_none_is_farther_off_than_told() {
        let bend = |i: usize| [0.0, 1.0, 2.0].map(|t| turn(0.01 * t * i as f64, 0.1 * t));
        let (movers, posed) = scene(&(0..24).map(bend).collect::<Vec<_>>());
        let off = |tolerance: f64, most: usize| {
            let groups = group(&movers, &posed, tolerance, most);
            let off = groups.off_px.iter().copied().fold(0.0, f64::max);
            (groups.motions.len(), off)
        };
        let (one, of_one) = off(1e-6, 1);
        let (some, of_some) = off(10.0, 24);
        let (all, of_all) = off(1e-6, 24);
        assert!(one == 1 && of_one > 10.0, "{one}: {of_one}");
        assert!(
            (2..24).contains(&some) && of_some <= 10.0,
            "{some}: {of_some}"
        );
        assert!(all <= 24 && of_all < 1e-6, "{all}: {of_all}");
    }

    #[test]
    fn without_movers_there_are_no_parts() {
        let (movers, _) = scene(&[]);
        let groups = group(&movers, &[], 0.5, 4);
        assert!(groups.motions.is_empty() && groups.parts.is_empty());
    }
}
