//! The splatting kernels on slices: no tensors, no backend, generic over `f32` and `f64`.
//!
//! Three calls make a render and its gradient:
//! [`project`] (projection, culling, depth sort, tile lists), [`rasterize`] and [`backward`].
//! EWA splatting (Zwicker et al. 2001) as in 3D Gaussian splatting (Kerbl et al. 2023), with the
//! constants of gsplat. Results have the same bits with any number of threads: all work is cut in
//! fixed pieces and every sum has a fixed order.

mod backward;
mod blocks;
mod geometry;
mod packs;
mod project;
mod project_backward;
mod raster;
mod raster_backward;
mod real;
mod sh;
#[cfg(test)]
mod tests;
mod tiles;
mod types;

pub use backward::{BackwardOptions, Gradients, backward};
pub use project::{Projection, project};
pub use raster::{Raster, RasterState, rasterize};
pub use real::Real;
pub use types::{SplatSlices, View};

/// Side of a square tile in pixels, and the number of lanes of the inner loops.
pub const TILE: usize = 16;
/// Alpha is clamped here; a clamped alpha passes no gradient.
pub const MAX_ALPHA: f64 = 0.999;
/// A Gaussian is skipped at pixels where its alpha is smaller.
pub const MIN_ALPHA: f64 = 1.0 / 255.0;
/// A pixel is done before the Gaussian that would bring its transmittance to this or below.
pub const MIN_TRANSMITTANCE: f64 = 1e-4;
/// Low-pass filter: added to the diagonal of the 2D covariance, in square pixels.
pub const LOW_PASS: f64 = 0.3;

/// Channels of the output before the features: colour 3, alpha 1, depth 1.
pub const BASE_CHANNELS: usize = 5;
