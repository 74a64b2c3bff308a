//! The whole backward pass: from the gradient of the output to the gradient of every input.

use super::project_backward::{all_finite, project_backward};
use super::raster_backward::partial_gradients;
use super::{BASE_CHANNELS, Projection, RasterState, Real, SplatSlices};
use crate::SplatError;

/// Which optional parts of the gradient are computed.
#[derive(Clone, Copy, Debug)]
pub struct BackwardOptions {
    /// The gradient of the pose; without it `cam_from_world` stays 0.
    pub pose: bool,
    /// The paths through the direction in which SH are evaluated. Off, the direction counts as a
    /// constant, as in references whose generator leaves these paths out.
    pub view_direction: bool,
}

impl Default for BackwardOptions {
    fn default() -> Self {
        Self {
            pose: true,
            view_direction: true,
        }
    }
}

/// Gradients of all inputs, in the inputs' shapes.
#[derive(Clone, Debug)]
pub struct Gradients<T> {
    /// [N, 3].
    pub means: Vec<T>,
    /// [N, 4].
    pub quats: Vec<T>,
    /// [F, 3, 3].
    pub left_rotations: Vec<T>,
    /// [N, 3].
    pub log_scales: Vec<T>,
    /// `[N]`.
    pub opacity_logits: Vec<T>,
    /// [N, B, 3].
    pub sh: Vec<T>,
    /// [N, F].
    pub features: Vec<T>,
    /// [3, 4], the pose's entries as twelve free numbers.
    pub cam_from_world: [T; 12],
    /// Norm of the gradient of the mean in the image, in NDC units (half the image is 1), `[N]`:
    /// the statistic of density control.
    pub screen: Vec<T>,
}

/// Gradients of a render.
///
/// `splats` and `features` are those that `projection` and `state` were made from, `v_output` is
/// the gradient of the output, [H, W, 5 + F].
///
/// A Gaussian whose gradient overflows `T` gets none, and neither does the pose. Where `v_output` itself is not finite, the
/// gradients are not finite either, so that whoever asked for them can see it.
///
/// # Errors
/// Wrong lengths.
pub fn backward<T: Real>(
    splats: &SplatSlices<'_, T>,
    projection: &Projection<T>,
    features: &[T],
    state: &RasterState<T>,
    v_output: &[T],
    options: BackwardOptions,
) -> Result<Gradients<T>, SplatError> {
    splats.check(projection.view.sh_degree)?;
    let n = projection.count;
    for (tensor, found, expected) in [
        ("opacity_logits", splats.len(), vec![n]),
        ("features", features.len(), vec![n, state.num_features]),
        (
            "gradient of the output",
            v_output.len(),
            vec![
                projection.view.camera.height,
                projection.view.camera.width,
                BASE_CHANNELS + state.num_features,
            ],
        ),
    ] {
        if found != expected.iter().product::<usize>() {
            return Err(SplatError::Shape {
                tensor,
                found: vec![found],
                expected: format!("{expected:?}"),
            });
        }
    }
    let partial = partial_gradients(projection, features, state, v_output);
    Ok(project_backward(
        splats,
        projection,
        state.num_features,
        &partial,
        options,
        all_finite(v_output),
    ))
}
