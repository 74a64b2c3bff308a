//! The splatting kernels on slices: no tensors, no backend, in `f32` or `f64`.
//!
//! Three calls make a render and its gradient:
//! [`project`] (projection, culling, depth sort, tile lists), [`rasterize`] and [`backward`].
//! [`expose`] and [`expose_backward`] do the same for the mean light of several renders.
//! EWA splatting (Zwicker et al. 2001) as in 3D Gaussian splatting (Kerbl et al. 2023), with the
//! constants of gsplat. Results have the same bits with any number of threads: all work is cut in
//! fixed pieces and every sum has a fixed order.

mod backward;
mod blocks;
mod body;
mod color_backward;
mod constants;
mod expose;
mod expose_backward;
mod exposure;
mod float;
mod geometry;
mod gradients;
mod matrices;
mod packs;
mod pieces;
mod project;
mod project_backward;
mod raster;
mod raster_backward;
mod real;
mod sh;
mod splat;
mod stills;
#[cfg(test)]
mod tests;
mod tiles;
mod transfer;
mod types;
mod world_backward;

pub use backward::Forward;
pub use constants::{BASE_CHANNELS, LOW_PASS, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};
pub use exposure::{Exposed, ExposedState, Exposure, ExposureGradients};
pub use float::{Float, backward, expose, expose_backward, project, rasterize, take_picture};
pub use gradients::{BackwardOptions, Gradients};
pub use project::Projection;
pub use raster::{Raster, RasterState};
pub use transfer::Transfer;
pub use types::{SplatSlices, View};

/// What the kernels on a GPU share with these.
#[cfg(feature = "cube")]
pub(crate) use {
    body::NORM_FLOOR,
    geometry::tangents,
    raster_backward::GEOMETRIC,
    sh::{C0, C1, C2, C3},
    transfer::{KNEE, LARGEST, TOE},
};
