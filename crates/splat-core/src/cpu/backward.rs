//! The whole backward pass: from the gradient of the output to the gradient of every input.

use super::constants::BASE_CHANNELS;
use super::gradients::{BackwardOptions, Gradients};
use super::project::Projection;
use super::project_backward::{all_finite, project_backward};
use super::raster::RasterState;
use super::raster_backward::{partial_gradients, tile_gradient};
use super::real::Real;
use super::types::SplatSlices;
use crate::error::SplatError;

/// A render: what it was made from, and what it kept for its backward pass.
#[derive(Clone, Copy, Debug)]
pub struct Forward<'a, T> {
    /// The Gaussians.
    pub splats: &'a SplatSlices<'a, T>,
    /// What [`project`](super::project) made of them.
    pub projection: &'a Projection<T>,
    /// Features, [N, F]; empty for none.
    pub features: &'a [T],
    /// What [`rasterize`](super::rasterize) kept.
    pub state: &'a RasterState<T>,
}

/// See [`super::backward`].
pub(super) fn backward<T: Real>(
    forward: &Forward<'_, T>,
    v_output: &[T],
    options: BackwardOptions,
) -> Result<Gradients<T>, SplatError> {
    let Forward {
        splats,
        projection,
        features,
        state,
    } = *forward;
    splats.check(projection.view.sh_degree)?;
    let n = projection.count;
    let num_features = state.channels - 4;
    for (tensor, found, expected) in [
        ("opacity_logits", splats.len(), vec![n]),
        ("features", features.len(), vec![n, num_features]),
        (
            "gradient of the output",
            v_output.len(),
            vec![
                projection.view.camera.height,
                projection.view.camera.width,
                BASE_CHANNELS + num_features,
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
    let camera = &projection.view.camera;
    let partial = partial_gradients(projection, features, state, |tile, v_tile| {
        tile_gradient(camera, state.channels, v_output, tile, v_tile);
    });
    Ok(project_backward(
        splats,
        projection,
        num_features,
        &partial,
        options,
        all_finite(v_output),
    ))
}
