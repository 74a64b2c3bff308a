//! The public functions. Each is compiled in this crate, once for f32 and once for f64, so that the settings with which a
//! caller is compiled do not decide how fast it runs.

use std::fmt::Debug;

use super::backward::{self, Forward};
use super::exposure::{Exposed, ExposedState, Exposure, ExposureGradients};
use super::gradients::{BackwardOptions, Gradients};
use super::project::{self, Projection};
use super::raster::{self, Raster};
use super::types::{SplatSlices, View};
use crate::error::SplatError;

/// `f32` or `f64`: f32 is what runs, f64 its reference.
pub trait Float:
    Kernels + Copy + Debug + Default + Into<f64> + PartialOrd + Send + Sync + 'static
{
    /// The nearest value to an `f64`.
    fn from_f64(value: f64) -> Self;
}

mod sealed {
    use super::*;

    /// The kernels in one float type.
    #[expect(unnameable_types, reason = "nobody else can bring another float type")]
    pub trait Kernels: Sized {
        fn project(
            splats: &SplatSlices<'_, Self>,
            view: &View,
        ) -> Result<Projection<Self>, SplatError>;
        fn rasterize(
            projection: &Projection<Self>,
            features: &[Self],
            num_features: usize,
        ) -> Result<Raster<Self>, SplatError>;
        fn backward(
            forward: &Forward<'_, Self>,
            v_output: &[Self],
            options: BackwardOptions,
        ) -> Result<Gradients<Self>, SplatError>;
        fn expose(
            exposure: &Exposure<'_, Self>,
            goes_back: bool,
        ) -> Result<Exposed<Self>, SplatError>;
        fn expose_backward(
            exposure: &Exposure<'_, Self>,
            state: &ExposedState<Self>,
            v_color: &[Self],
            wants_poses: bool,
        ) -> Result<ExposureGradients<Self>, SplatError>;
    }
}
use sealed::Kernels;

macro_rules! float {
    ($float:ident) => {
        impl Float for $float {
            fn from_f64(value: f64) -> Self {
                value as $float
            }
        }

        // What is inlined into another crate, that crate compiles.
        impl Kernels for $float {
            #[inline(never)]
            fn project(
                splats: &SplatSlices<'_, Self>,
                view: &View,
            ) -> Result<Projection<Self>, SplatError> {
                project::project(splats, view)
            }

            #[inline(never)]
            fn rasterize(
                projection: &Projection<Self>,
                features: &[Self],
                num_features: usize,
            ) -> Result<Raster<Self>, SplatError> {
                raster::rasterize(projection, features, num_features)
            }

            #[inline(never)]
            fn backward(
                forward: &Forward<'_, Self>,
                v_output: &[Self],
                options: BackwardOptions,
            ) -> Result<Gradients<Self>, SplatError> {
                backward::backward(forward, v_output, options)
            }

            #[inline(never)]
            fn expose(
                exposure: &Exposure<'_, Self>,
                goes_back: bool,
            ) -> Result<Exposed<Self>, SplatError> {
                super::expose::expose(exposure, goes_back)
            }

            #[inline(never)]
            fn expose_backward(
                exposure: &Exposure<'_, Self>,
                state: &ExposedState<Self>,
                v_color: &[Self],
                wants_poses: bool,
            ) -> Result<ExposureGradients<Self>, SplatError> {
                super::expose_backward::expose_backward(exposure, state, v_color, wants_poses)
            }
        }
    };
}
float!(f32);
float!(f64);

/// Projects Gaussians into a view, drops what cannot be seen, sorts by depth and lists every tile's
/// Gaussians.
///
/// # Errors
/// Wrong lengths, an unusable camera, or an input that is not finite, which is named with its row.
pub fn project<T: Float>(
    splats: &SplatSlices<'_, T>,
    view: &View,
) -> Result<Projection<T>, SplatError> {
    T::project(splats, view)
}

/// Blends projected Gaussians into colour, alpha, depth and `num_features` feature channels
/// (`features` is [N, F] row-major; empty for none), front to back on a black background.
///
/// # Errors
/// Features of the wrong length or not finite.
pub fn rasterize<T: Float>(
    projection: &Projection<T>,
    features: &[T],
    num_features: usize,
) -> Result<Raster<T>, SplatError> {
    T::rasterize(projection, features, num_features)
}

/// Gradients of a render from the gradient of its output, `v_output` [H, W, 5 + F].
///
/// A Gaussian whose gradient overflows `T` gets none, and neither does the pose. Where `v_output` itself is not finite, the
/// gradients are not finite either, so that whoever asked for them can see it.
///
/// # Errors
/// Wrong lengths.
pub fn backward<T: Float>(
    forward: &Forward<'_, T>,
    v_output: &[T],
    options: BackwardOptions,
) -> Result<Gradients<T>, SplatError> {
    T::backward(forward, v_output, options)
}

/// The picture that a camera takes while its shutter is open: the mean of all samples' renders in light.
///
/// Colours of Gaussians are those seen from the middle of the exposure; everything else is as if each sample were
/// rendered by itself.
///
/// # Errors
/// Wrong lengths, no sample, an unusable camera, or an input that is not finite, which is named with its row.
pub fn expose<T: Float>(exposure: &Exposure<'_, T>) -> Result<Exposed<T>, SplatError> {
    T::expose(exposure, true)
}

/// Colour and radii of [`expose`], bit for bit, in memory that does not grow with the number of samples.
///
/// # Errors
/// As [`expose`].
pub fn take_picture<T: Float>(
    exposure: &Exposure<'_, T>,
) -> Result<(Vec<T>, Vec<f32>), SplatError> {
    let Exposed { color, radii, .. } = T::expose(exposure, false)?;
    Ok((color, radii))
}

/// Gradients of an exposure from the gradient of its picture, `v_color` [H, W, 3]. Those of the samples' poses are left out
/// where they are not wanted.
///
/// A sample in which a Gaussian's gradient overflows `T` gives it none. Where `v_color` itself is not finite, the gradients
/// are not finite either.
///
/// # Errors
/// Wrong lengths.
pub fn expose_backward<T: Float>(
    exposure: &Exposure<'_, T>,
    state: &ExposedState<T>,
    v_color: &[T],
    wants_poses: bool,
) -> Result<ExposureGradients<T>, SplatError> {
    T::expose_backward(exposure, state, v_color, wants_poses)
}
