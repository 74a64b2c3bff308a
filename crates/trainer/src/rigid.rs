//! Movers as parts that move as one, for formats that know rigid motion alone.
//!
//! Every dynamic Gaussian has a rigid motion of its own, blended of all bases by its own coefficients. Gaussians move as one
//! exactly where they have the same coefficients, and nearly so where these are alike. So they are sorted into parts (see
//! [`Groups`]), and what that costs is told by pictures: those of the parts against the run's own.

use crate::TrainError;
use crate::grouping::{Groups, Movers, Posed};
use crate::guarded::guarded;
use crate::metrics::psnr_of;
use crate::run::Run;
use crate::tensors::{rows_from, tensor};
use crate::views::CameraView;
use crate::world::World;
use burn::tensor::Tensor;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use splat_core::{Extra, Splats, Viewpoint, render};

/// Parts of a scene's movers, each of which moves as one.
#[derive(Clone, Debug, PartialEq)]
pub struct RigidParts {
    /// Times of the poses: the training frames'.
    pub times: Vec<f32>,
    /// The parts; none where nothing moves.
    pub parts: Vec<RigidPart>,
    /// How near pictures of them come to the run's own, dB: the lowest of some training views. `None` where nothing moves.
    pub psnr: Option<f64>,
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

/// Training views that are looked at, evenly over the video.
const LOOKED_AT: usize = 8;

impl Run {
    /// The movers in parts: one, and twice as many until [`RigidParts::psnr`] is `enough` or there are `most`, whatever that leaves.
    ///
    /// # Errors
    /// The renderer refuses its input; the device fails.
    pub fn rigid_parts(&self, enough: f64, most: usize) -> Result<RigidParts, TrainError> {
        guarded(&self.device, || self.cut_into_parts(enough, most))
    }

    fn cut_into_parts(&self, enough: f64, most: usize) -> Result<RigidParts, TrainError> {
        let world = self.model().world.detached();
        let movers = movers(&world);
        let views = &self.views().train;
        let posed = views.iter().map(|view| self.posed(&world, &movers, view));
        let mut rigid = RigidParts {
            times: views.iter().map(|view| view.time).collect(),
            parts: Vec::new(),
            psnr: None,
        };
        let Some(posed) = posed.collect::<Option<Vec<Posed>>>() else {
            return Ok(rigid);
        };
        let mut groups = Groups::new(&movers);
        let mut wanted = 1;
        loop {
            groups.grow(wanted, &movers, &posed);
            let psnr = self.psnr_of_parts(&world, &movers, &groups)?;
            rigid.psnr = Some(psnr);
            // No more parts than Gaussians.
            if psnr >= enough || wanted >= most.min(movers.means.len()) {
                break;
            }
            wanted = wanted.saturating_mul(2).min(most);
        }
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
        rigid.parts = parts.filter(|part| !part.rows.is_empty()).collect();
        Ok(rigid)
    }

    /// The movers as a view has them; `None` where nothing moves.
    fn posed(&self, world: &World, movers: &Movers, view: &CameraView) -> Option<Posed> {
        let nearest = 0.1 * self.survey().scene_size;
        let motions = motions(world, &movers.means, view.time)?;
        let places = motions.iter().zip(&movers.means);
        let scale = |(motion, mean): (&DAffine3, &DVec3)| {
            let place = motion.transform_point3(*mean);
            let depth = view.cam_from_world.transform_point3(place).z;
            view.camera.fx / depth.max(nearest)
        };
        let scales_px = places.map(scale).collect();
        Some(Posed { motions, scales_px })
    }

    /// See [`RigidParts::psnr`].
    fn psnr_of_parts(
        &self,
        world: &World,
        movers: &Movers,
        groups: &Groups,
    ) -> Result<f64, TrainError> {
        let views = &self.views().train;
        let degree = self.schedule().sh_degree_at(self.iteration());
        let mut lowest = f64::INFINITY;
        for t in (0..views.len()).step_by(views.len().div_ceil(LOOKED_AT)) {
            let view = &views[t];
            let own = world.pose(view.time).splats;
            let parts = splats_of_parts(world, own.clone(), |i| {
                let motion = groups.motions[groups.parts[i]][t];
                (motion.transform_point3(movers.means[i]), motion.matrix3)
            });
            let viewpoint = Viewpoint::new(&view.camera, &view.cam_from_world, degree, &own);
            let [own, parts] = [own, parts].map(|splats| {
                Ok::<_, TrainError>(render(splats, &viewpoint, Extra::default())?.color())
            });
            lowest = lowest.min(psnr_of(&parts?, &own?, None));
        }
        Ok(lowest)
    }
}

/// Splats with other means and rotations of the movers.
fn splats_of_parts(world: &World, splats: Splats, at: impl Fn(usize) -> (DVec3, DMat3)) -> Splats {
    let n = world.num_dynamic;
    let (means, rotations): (Vec<DVec3>, Vec<DMat3>) = (0..n).map(at).unzip();
    let device = splats.means.device();
    let means = means.iter().flat_map(|mean| mean.as_vec3().to_array());
    let mut all: Vec<Tensor<2>> = vec![tensor(means.collect(), [n, 3], &device)];
    all.extend(rows_from(&splats.means, n));
    let rotations = rotations.iter().flat_map(|r| r.transpose().to_cols_array());
    let rotations = rotations.map(|v| v as f32).collect();
    Splats {
        means: Tensor::cat(all, 0),
        left_rotations: Some(tensor(rotations, [n, 3, 3], &device)),
        ..splats
    }
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
