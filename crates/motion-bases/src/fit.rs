//! The first fit: bases, coefficients and means against the 3D tracks.
//!
//! Shape of Motion runs 1,000 steps of Adam on this loss before it renders anything. The optimiser
//! is the caller's. All lengths are divided by the foreground's extent, so that the weights (and
//! learning rates relative to the extent) hold at any scale of the scene.
//!
//! The loss is one op, which makes its gradient with it. It is computed in main memory wherever the tensors
//! are: what is fitted are some ten thousand numbers, and a GPU would take hundreds of launches for them.

use crate::fit_data::{FitData, FitStep};
use crate::motion::MotionBases;
use crate::ops::MotionOps;
use burn::backend::Dispatch;
use burn::tensor::Tensor;

/// Share of the reprojection errors that counts; the largest ones do not.
pub(crate) const TRIM: f64 = 0.95;

pub(crate) const HIDDEN_WEIGHT: f64 = 0.5;
pub(crate) const SPARSITY_WEIGHT: f64 = 0.01;
const SMOOTHNESS_WEIGHT: (f64, f64) = (0.01, 0.1);
/// Part of the steps after which the smoothness weight starts to grow.
const SMOOTHNESS_START: f64 = 0.4;
pub(crate) const ACCELERATION_WEIGHT: f64 = 0.5;
pub(crate) const ALONG_RAY_WEIGHT: f64 = 0.1;

/// What the first fit moves. Its rows belong to the tracks of [`crate::MotionInit`], in their order.
#[derive(Clone, Copy, Debug)]
pub struct Fit<'a> {
    /// The bases.
    pub bases: &'a MotionBases,
    /// Weights of the bases before their softmax, [P, B].
    pub coefficients: &'a Tensor<2>,
    /// Positions in the canonical frame, [P, 3].
    pub means: &'a Tensor<2>,
}

/// The loss of step `step` of `num_steps` of the first fit, `[1]`.
///
/// With P tracks over N frames, P N > 36,000, each step takes the next of ⌈P N / 36,000⌉ groups.
/// Terms: L1 to the visible positions (weight 1), L1 to the pixels of hidden ones, trimmed (0.5),
/// sparse coefficients (0.01), smooth bases (0.01, growing to 0.1 from 40 % of the steps on), small
/// accelerations of positions (half of that) and little motion along the viewing rays (0.1).
///
/// # Panics
/// Panics when the shapes do not fit those of the data.
#[must_use]
pub fn fit_loss(fit: &Fit<'_>, data: &FitData, step: usize, num_steps: usize) -> Tensor<1> {
    let &Fit {
        bases,
        coefficients,
        means,
    } = fit;
    let problem = &data.problem;
    let [rows, num_bases] = coefficients.dims();
    let frames = bases.num_frames;
    assert!(
        rows == problem.num_tracks
            && means.dims() == [rows, 3]
            && bases.rots.dims() == [num_bases, frames * 6]
            && bases.transls.dims() == [num_bases, frames * 3]
            && frames == problem.num_frames,
        "first fit of {} tracks over {} frames: got coefficients {:?}, means {:?}, bases over {frames} frames {:?} and {:?}",
        problem.num_tracks,
        problem.num_frames,
        coefficients.dims(),
        means.dims(),
        bases.rots.dims(),
        bases.transls.dims(),
    );
    let progress = step as f64 / num_steps.max(1) as f64;
    let growth = ((progress - SMOOTHNESS_START) / (1.0 - SMOOTHNESS_START)).clamp(0.0, 1.0);
    let step = FitStep {
        problem: problem.clone(),
        group: step % problem.groups.len(),
        smooth: SMOOTHNESS_WEIGHT.0 + (SMOOTHNESS_WEIGHT.1 - SMOOTHNESS_WEIGHT.0) * growth,
    };
    let [rots, transls, coefficients, means] =
        [&bases.rots, &bases.transls, coefficients, means].map(|t| t.clone().into_dispatch());
    let loss = <Dispatch as MotionOps>::fit(rots, transls, coefficients, means, step);
    Tensor::from_dispatch(loss)
}
