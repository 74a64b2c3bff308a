//! Motion bases as tensors, and the motion of Gaussians at a time: μ(t) = R(t) μ + τ(t), the paper's equation 2, with the
//! weighted sum of its equation 1 taken over 6D vectors and translations, before a rotation is made of the former.

use crate::init::MotionInit;
use crate::ops::MotionOps;
use crate::rotation::{MAX_ENTRY, gram_schmidt};
use burn::backend::Dispatch;
use burn::tensor::activation::softmax;
use burn::tensor::{DType, Device, Tensor, TensorData};
use host::product;

/// Rotations and translations of all bases in all training frames: the trainable tensors.
#[derive(Clone, Debug)]
pub struct MotionBases {
    /// 6D rotations, [B, N * 6]: frame t's six numbers at columns 6t to 6t + 6.
    pub rots: Tensor<2>,
    /// Translations in scene units, [B, N * 3]: frame t's three numbers at columns 3t to 3t + 3.
    pub transls: Tensor<2>,
    /// Number of training frames N.
    pub num_frames: usize,
}

/// A moment between two frames.
struct Moment {
    floor: usize,
    /// How far it lies on the way to the next frame; `None` where it is the frame's own.
    part: Option<Part>,
}

enum Part {
    Number(f64),
    /// [1, 1].
    Tensor(Box<Tensor<2>>),
}

/// A rigid motion per Gaussian, from the canonical frame to some time.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Rotations, [F, 3, 3].
    pub rotations: Tensor<3>,
    /// Translations in scene units, [F, 3].
    pub translations: Tensor<2>,
}

impl MotionBases {
    /// The bases that [`crate::initialize`] found.
    #[must_use]
    pub fn from_init(init: &MotionInit, device: &Device, dtype: DType) -> Self {
        let (bases, frames) = (init.num_bases, init.tracks.num_frames);
        let tensor = |values: &[f64], width: usize| {
            let data = TensorData::new(values.to_vec(), [bases, frames * width]);
            Tensor::<2>::from_data(data, (device, dtype))
        };
        Self {
            rots: tensor(&init.rots, 6),
            transls: tensor(&init.transls, 3),
            num_frames: frames,
        }
    }

    /// Number of bases B.
    #[must_use]
    pub fn num_bases(&self) -> usize {
        self.rots.dims()[0]
    }

    /// The motion from the canonical frame to `time` of Gaussians with the given coefficients, in Burn's own operations: what
    /// [`Self::moved_at`] is held against, and where a motion is wanted without anything that moves.
    ///
    /// `coefficients` are logits, [F, B]. `time` is in units of frames and is clamped to [0, N - 1];
    /// between two frames the blended 6D vectors and translations are interpolated linearly, before
    /// Gram–Schmidt.
    ///
    /// # Panics
    /// Panics when `time` is NaN, or when the shapes do not fit together.
    #[must_use]
    pub fn motion_at(&self, coefficients: &Tensor<2>, time: f32) -> Motion {
        let [rows, _] = coefficients.dims();
        if rows == 0 {
            let options = (&coefficients.device(), coefficients.dtype());
            return Motion {
                rotations: Tensor::zeros([0, 3, 3], options),
                translations: Tensor::zeros([0, 3], options),
            };
        }
        self.check(coefficients);
        let weights = softmax(coefficients.clone(), 1); // [F, B]
        let [rots, transls] = self.at(&[self.moment(time)]);
        Motion {
            rotations: gram_schmidt(product(weights.clone(), rots)),
            translations: product(weights, transls),
        }
    }

    /// Means [T, F, 3] of the canonical frame and rotations [T, F, 3, 3] at several times, as [`Self::motion_at`] has them, in
    /// one op.
    ///
    /// # Panics
    /// As [`Self::motion_at`].
    #[must_use]
    pub fn moved_at(
        &self,
        coefficients: &Tensor<2>,
        means: &Tensor<2>,
        times: &[f32],
    ) -> (Tensor<3>, Tensor<4>) {
        let moments: Vec<_> = times.iter().map(|time| self.moment(*time)).collect();
        self.moved(coefficients, means, &moments)
    }

    /// The same at times within an exposure, `[T]`, with the times' gradient: the motion of the first and the last frame goes
    /// on for up to half a frame beyond the ends.
    ///
    /// `known` are the same times in main memory: they choose the frames that each lies between, so that the device need not
    /// be waited for. Rounding may tell them apart, since motion is continuous in time.
    ///
    /// # Panics
    /// As [`Self::motion_at`], or if there are not as many of both.
    #[must_use]
    pub fn exposed_at(
        &self,
        coefficients: &Tensor<2>,
        means: &Tensor<2>,
        times: &Tensor<1>,
        known: &[f64],
    ) -> (Tensor<3>, Tensor<4>) {
        assert_eq!(times.dims(), [known.len()], "the times are known");
        let last = self.num_frames.saturating_sub(1);
        let times = times.clone().clamp(-0.5, last as f64 + 0.5);
        let moments = known.iter().enumerate().map(|(i, time)| {
            assert!(!time.is_nan(), "motion was asked for at a time that is NaN");
            let floor = (time.max(0.0).floor() as usize).min(last.saturating_sub(1));
            let part = times.clone().slice_dim(0, i..i + 1) - floor as f64;
            Moment {
                floor,
                part: (last > 0).then(|| Part::Tensor(Box::new(part.reshape([1, 1])))),
            }
        });
        self.moved(coefficients, means, &moments.collect::<Vec<_>>())
    }

    fn moved(
        &self,
        coefficients: &Tensor<2>,
        means: &Tensor<2>,
        moments: &[Moment],
    ) -> (Tensor<3>, Tensor<4>) {
        let ([rows, _], count) = (means.dims(), moments.len());
        if rows == 0 || count == 0 {
            let options = (&means.device(), means.dtype());
            return (
                Tensor::zeros([count, rows, 3], options),
                Tensor::zeros([count, rows, 3, 3], options),
            );
        }
        self.check(coefficients);
        assert!(
            means.dims() == [coefficients.dims()[0], 3],
            "there are coefficients for {} Gaussians, but means {:?}",
            coefficients.dims()[0],
            means.dims()
        );
        let bases = self.num_bases();
        let [rots, transls] = self.at(moments);
        let each = |values: Tensor<2>, width: usize| values.reshape([bases, count, width]);
        let bases = Tensor::cat(vec![each(rots, 6), each(transls, 3)], 2);
        let moved = Tensor::<1>::from_dispatch(<Dispatch as MotionOps>::moved(
            coefficients.clone().into_dispatch(),
            bases.into_dispatch(),
            means.clone().into_dispatch(),
        ));
        let (of_means, all) = (count * rows * 3, count * rows * 12);
        let means = moved.clone().slice_dim(0, 0..of_means);
        let rotations = moved.slice_dim(0, of_means..all);
        (
            means.reshape([count, rows, 3]),
            rotations.reshape([count, rows, 3, 3]),
        )
    }

    /// Where a time lies, clamped to the frames.
    fn moment(&self, time: f32) -> Moment {
        assert!(!time.is_nan(), "motion was asked for at a time that is NaN");
        let last = self.num_frames.saturating_sub(1);
        let time = f64::from(time).clamp(0.0, last as f64);
        let part = time - time.floor();
        Moment {
            floor: time.floor() as usize,
            part: (part > 0.0).then_some(Part::Number(part)),
        }
    }

    fn check(&self, coefficients: &Tensor<2>) {
        let [rows, bases] = coefficients.dims();
        assert!(
            bases == self.num_bases(),
            "coefficients are [{rows}, {bases}], but there are {} motion bases",
            self.num_bases()
        );
    }

    /// 6D vectors [B, T * 6] and translations [B, T * 3] of all bases at T moments.
    fn at(&self, moments: &[Moment]) -> [Tensor<2>; 2] {
        let at = |frames: &Tensor<2>, width: usize| {
            let frame = |t: usize| frames.clone().slice_dim(1, width * t..width * (t + 1));
            // Blending over bases and interpolation over time are linear: their order does not matter.
            let moments = moments.iter().map(|moment| {
                let floor = moment.floor;
                match &moment.part {
                    None => frame(floor),
                    Some(Part::Number(part)) => {
                        frame(floor) * (1.0 - part) + frame(floor + 1) * *part
                    }
                    Some(Part::Tensor(part)) => {
                        let step = frame(floor + 1) - frame(floor);
                        frame(floor) + step * *part.clone()
                    }
                }
            });
            Tensor::cat(moments.collect(), 1)
        };
        // Clamped here already, so that a product cannot overflow.
        let rots = at(&self.rots, 6).clamp(-MAX_ENTRY, MAX_ENTRY);
        [rots, at(&self.transls, 3)]
    }
}

impl Motion {
    /// Means [F, 3] moved from the canonical frame: R mean + t.
    #[must_use]
    pub fn transform_means(&self, means: &Tensor<2>) -> Tensor<2> {
        let [rows, _] = means.dims();
        if rows == 0 {
            return means.clone();
        }
        let rotated = (self.rotations.clone() * means.clone().reshape([rows, 1, 3])).sum_dim(2);
        rotated.reshape([rows, 3]) + self.translations.clone()
    }
}

/// Positions of all Gaussians in all training frames, [P, N, 3], in scene units.
///
/// `coefficients` are logits [P, B], `means` are canonical positions [P, 3]. Differentiable.
///
/// # Panics
/// As [`MotionBases::motion_at`].
#[must_use]
pub fn positions_all_frames(
    bases: &MotionBases,
    coefficients: &Tensor<2>,
    means: &Tensor<2>,
) -> Tensor<3> {
    let times: Vec<f32> = (0..bases.num_frames).map(|frame| frame as f32).collect();
    let (moved, _) = bases.moved_at(coefficients, means, &times);
    moved.swap_dims(0, 1)
}
