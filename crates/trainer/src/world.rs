//! The sharp world: Gaussians and their motion. Every parameter is a rank-2 tensor.

use crate::parameter::{Group, Parameter};
use crate::placement::Seeds;
use crate::tensors::{constant, host, rows_from};
use burn::tensor::{DType, Device, Tensor, TensorData};
use motion_bases::{MotionBases, quats_of_posed};
use splat_core::{Gaussians, Movers, Splats};

/// RGB to the SH coefficient of degree 0 and back.
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// Motion of the dynamic Gaussians.
#[derive(Clone, Debug)]
pub struct MotionModel {
    /// Bases shared by all dynamic Gaussians.
    pub bases: MotionBases,
    /// Logits of the motion coefficients, [F, B].
    pub coefficients: Tensor<2>,
}

/// Gaussians, and how some of them move.
#[derive(Clone, Debug)]
pub struct World {
    /// Means: canonical frame for rows [0, F), world for the others; scene units, [N, 3].
    pub means: Tensor<2>,
    /// Quaternions (w, x, y, z), not normalised, [N, 4].
    pub quats: Tensor<2>,
    /// Logarithms of the scales, [N, 3].
    pub log_scales: Tensor<2>,
    /// Opacity logits, [N, 1].
    pub opacity_logits: Tensor<2>,
    /// Spherical harmonics, [N, B · 3], coefficient-major.
    pub sh: Tensor<2>,
    /// Number F of dynamic Gaussians, which are rows [0, F).
    pub num_dynamic: usize,
    /// Their motion; `None` for a static scene.
    pub motion: Option<MotionModel>,
}

/// A motion as plain arrays, for a file.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionArrays {
    /// Number of training frames T.
    pub num_frames: usize,
    /// Number of bases B.
    pub num_bases: usize,
    /// 6D rotations of the bases, [B, T, 6] row-major.
    pub rots: Vec<f32>,
    /// Translations of the bases in scene units, [B, T, 3] row-major.
    pub transls: Vec<f32>,
    /// Logits of the motion coefficients of the dynamic Gaussians, [F, B] row-major.
    pub coefficients: Vec<f32>,
}

/// Gaussians posed at one time.
#[derive(Debug)]
pub struct Posed {
    /// What the splatting op takes.
    pub splats: Splats,
    /// The dynamic flag as a feature channel, [N, 1]; `None` for a static scene.
    pub dynamic: Option<Tensor<2>>,
}

/// Initial values of Gaussians as tensors.
#[derive(Debug)]
pub(crate) struct GaussianTensors {
    pub(crate) means: Tensor<2>,
    pub(crate) quats: Tensor<2>,
    pub(crate) log_scales: Tensor<2>,
    pub(crate) opacity_logits: Tensor<2>,
    pub(crate) sh: Tensor<2>,
}

impl GaussianTensors {
    /// Isotropic Gaussians without rotation; SH of `degree` with the colour in degree 0.
    pub(crate) fn new(
        seeds: &Seeds,
        opacity: f64,
        degree: usize,
        options: (&Device, DType),
    ) -> Self {
        let n = seeds.means.len();
        let columns = 3 * (degree + 1) * (degree + 1);
        let tensor = |values: Vec<f64>, width: usize| {
            Tensor::<2>::from_data(TensorData::new(values, [n, width]), options)
        };
        let mut sh = vec![0.0; n * columns];
        for (row, color) in sh.chunks_mut(columns).zip(&seeds.colors) {
            for (value, &c) in row.iter_mut().zip(color) {
                *value = (f64::from(c) - 0.5) / SH_C0;
            }
        }
        Self {
            means: tensor(seeds.means.iter().flat_map(|m| m.to_array()).collect(), 3),
            quats: tensor([1.0, 0.0, 0.0, 0.0].repeat(n), 4),
            // A floor keeps coincident points (distance 0) finite.
            log_scales: tensor(
                seeds
                    .scales
                    .iter()
                    .flat_map(|s| [s.max(1e-9).ln(); 3])
                    .collect(),
                3,
            ),
            opacity_logits: tensor(vec![(opacity / (1.0 - opacity)).ln(); n], 1),
            sh: tensor(sh, columns),
        }
    }
}

/// Means and rows of rotations, a row for each Gaussian.
type MeansAndRotations = (Vec<[f32; 3]>, Vec<[f64; 9]>);

impl World {
    /// Number N of Gaussians.
    #[must_use]
    pub fn num_gaussians(&self) -> usize {
        self.means.dims()[0]
    }

    /// Degree of the stored spherical harmonics.
    #[must_use]
    pub fn sh_degree(&self) -> usize {
        (self.sh.dims()[1] / 3).isqrt() - 1
    }

    /// Means [F, 3] and rotations [F, 3, 3] of the dynamic Gaussians at a time (training frames, may be fractional); `None`
    /// where nothing moves.
    fn moved_at(&self, time: f32) -> Option<(Tensor<2>, Tensor<3>)> {
        let motion = self.motion.as_ref()?;
        let means = self.dynamic_means();
        let [rows, _] = means.dims();
        let (moved, rotations) = motion.bases.moved_at(&motion.coefficients, &means, &[time]);
        Some((moved.reshape([rows, 3]), rotations.reshape([rows, 3, 3])))
    }

    /// Where the dynamic Gaussians are at times within an exposure, `[T]`, which are `known` in main memory too; `None` where
    /// nothing moves.
    #[must_use]
    pub fn exposed_at(&self, times: &Tensor<1>, known: &[f64]) -> Option<Movers> {
        let MotionModel {
            bases,
            coefficients,
        } = self.used_motion()?;
        let means = self.dynamic_means();
        let (means, left_rotations) = bases.exposed_at(coefficients, &means, times, known);
        Some(Movers {
            means,
            left_rotations,
        })
    }

    /// Means of the dynamic Gaussians in the canonical frame, [F, 3].
    #[must_use]
    pub fn dynamic_means(&self) -> Tensor<2> {
        self.means.clone().narrow(0, 0, self.num_dynamic)
    }

    /// All Gaussians at a time (training frames, may be fractional).
    #[must_use]
    pub fn pose(&self, time: f32) -> Posed {
        let n = self.num_gaussians();
        let (mut means, mut left_rotations, mut dynamic) = (self.means.clone(), None, None);
        if let Some((moved, rotations)) = self.moved_at(time) {
            let mut parts = vec![moved];
            parts.extend(rows_from(&self.means, self.num_dynamic));
            means = Tensor::cat(parts, 0);
            left_rotations = Some(rotations);
            let (device, dtype) = (self.means.device(), self.means.dtype());
            let mut flags = vec![0.0_f32; n];
            flags[..self.num_dynamic].fill(1.0);
            dynamic = Some(Tensor::from_data(
                TensorData::new(flags, [n, 1]),
                (&device, dtype),
            ));
        }
        let splats = Splats {
            means,
            quats: self.quats.clone(),
            left_rotations,
            log_scales: self.log_scales.clone(),
            opacity_logits: self.opacity_logits.clone(),
            sh: self.sh.clone(),
        };
        Posed { splats, dynamic }
    }

    /// All parameters, to be replaced.
    pub(crate) fn parameters_mut(&mut self) -> Vec<(Parameter, &mut Tensor<2>)> {
        let Self {
            means,
            quats,
            log_scales,
            opacity_logits,
            sh,
            num_dynamic: _,
            motion,
        } = self;
        let mut all = vec![
            (Parameter::new("gaussians.means", Group::Means), means),
            (Parameter::new("gaussians.quats", Group::Quats), quats),
            (
                Parameter::new("gaussians.log_scales", Group::LogScales),
                log_scales,
            ),
            (
                Parameter::new("gaussians.opacity_logits", Group::OpacityLogits),
                opacity_logits,
            ),
            (Parameter::new("gaussians.sh", Group::Sh), sh),
        ];
        if let Some(motion) = motion {
            let MotionModel {
                bases,
                coefficients,
            } = motion;
            all.push((
                Parameter::new("motion.rots", Group::BasisRotations),
                &mut bases.rots,
            ));
            all.push((
                Parameter::new("motion.transls", Group::BasisTranslations),
                &mut bases.transls,
            ));
            all.push((
                Parameter::new("motion.coefficients", Group::MotionCoefficients),
                coefficients,
            ));
        }
        all
    }

    /// The same values without a graph behind them.
    #[must_use]
    pub fn detached(&self) -> Self {
        let mut copy = self.clone();
        for (_, tensor) in copy.parameters_mut() {
            *tensor = constant(tensor);
        }
        copy
    }

    /// The motion; `None` where nothing moves by it.
    fn used_motion(&self) -> Option<&MotionModel> {
        self.motion.as_ref().filter(|_| self.num_dynamic > 0)
    }

    /// Number of motion bases; 0 where nothing moves.
    pub(crate) fn num_bases(&self) -> usize {
        let motion = self.used_motion();
        motion.map_or(0, |motion| motion.bases.num_bases())
    }

    /// The motion as plain arrays; `None` where nothing moves.
    pub(crate) fn motion_arrays(&self) -> Option<MotionArrays> {
        let motion = self.used_motion()?;
        Some(MotionArrays {
            num_frames: motion.bases.num_frames,
            num_bases: motion.bases.num_bases(),
            rots: host(motion.bases.rots.clone()),
            transls: host(motion.bases.transls.clone()),
            coefficients: host(motion.coefficients.clone()),
        })
    }

    /// Means, and rows of the rotations from the canonical frame, of the dynamic Gaussians at a time (training frames, may be
    /// fractional), `[F]` each; `None` where nothing moves.
    pub(crate) fn motions(&self, time: f32) -> Option<MeansAndRotations> {
        let (moved, rotations) = self.detached().moved_at(time)?;
        let rotations = rows::<9>(&rotations.reshape([self.num_dynamic, 9]));
        let rotations = rotations.iter().map(|r| r.map(f64::from)).collect();
        Some((rows::<3>(&moved), rotations))
    }

    /// See [`crate::Run::gaussians`].
    pub(crate) fn gaussians(&self, time: Option<f32>) -> Gaussians {
        let mut means = rows::<3>(&self.means);
        let mut quats = rows::<4>(&self.quats);
        if let Some((moved, rotations)) = time.and_then(|t| self.motions(t)) {
            means[..moved.len()].copy_from_slice(&moved);
            quats = quats_of_posed(&rotations, &quats);
        }
        Gaussians {
            means,
            quats,
            log_scales: rows(&self.log_scales),
            opacity_logits: host(self.opacity_logits.clone()),
            sh: host(self.sh.clone()),
            sh_degree: self.sh_degree(),
        }
    }
}

/// The rows of a matrix with C columns.
fn rows<const C: usize>(tensor: &Tensor<2>) -> Vec<[f32; C]> {
    host(tensor.clone()).as_chunks().0.to_vec()
}
