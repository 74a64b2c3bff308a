//! Rendering on tensors.

use std::fmt;

use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::cpu::BASE_CHANNELS;
use crate::error::SplatError;
use crate::ops::{Blended, PreparedView, Projected, SceneTensors, SplatOps};
use crate::splats::{Layout, Splats, Viewpoint, check_dtype, check_shape};
use crate::stages::Stages;

/// What a render may take and give beside the image of the Gaussians.
#[derive(Clone, Debug, Default)]
pub struct Extra {
    /// Features, [N, F], that are blended like colours.
    pub features: Option<Tensor<2>>,
    /// Takes no part in the image, `[N]`: when it is tracked its "gradient" is each Gaussian's norm of the gradient of its mean
    /// in the image, in NDC units (v.x W/2, v.y H/2), the statistic of density control.
    pub screen_grad: Option<Tensor<1>>,
}

/// Gaussians projected into a view, sorted and listed by tile: everything of a render that does
/// not depend on features. Cheap to clone.
#[derive(Clone)]
pub struct Prepared {
    view: PreparedView<Dispatch>,
    layout: Layout,
}

impl Prepared {
    /// Radius of every Gaussian in the image (three standard deviations of its longer axis), px,
    /// `[N]` in f32; 0 for Gaussians that are not drawn.
    #[must_use]
    pub fn radii(&self) -> Tensor<1> {
        Tensor::from_dispatch(self.view.radii())
    }

    /// What projection and the tiles' lists came to, read back from where they are.
    ///
    /// # Errors
    /// A GPU that fails, or is lost.
    pub fn stages(&self) -> Result<Stages, SplatError> {
        self.view.stages()
    }
}

impl fmt::Debug for Prepared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Prepared")
            .field("layout", &self.layout)
            .finish_non_exhaustive()
    }
}

/// A rendered image and its parts, as views of one tensor, and the radii.
#[derive(Clone, Debug)]
pub struct Rendered {
    output: Tensor<3>,
    radii: Tensor<1>,
}

impl Rendered {
    /// The whole output, [H, W, 5 + F]: colour 3, alpha, depth, features. The other methods slice it;
    /// each slice costs a gradient of its full size, so that a loss on several may want this.
    #[must_use]
    pub fn output(&self) -> &Tensor<3> {
        &self.output
    }

    fn channels(&self, from: usize, to: usize) -> Tensor<3> {
        let [h, w, _] = self.output.dims();
        self.output.clone().slice([0..h, 0..w, from..to])
    }

    /// Colour on a black background, not clamped above 1, [H, W, 3].
    #[must_use]
    pub fn color(&self) -> Tensor<3> {
        self.channels(0, 3)
    }

    /// 1 - the light that passes through all Gaussians, [H, W].
    #[must_use]
    pub fn alpha(&self) -> Tensor<2> {
        let [h, w, _] = self.output.dims();
        self.channels(3, 4).reshape([h, w])
    }

    /// Σ z α T in scene units, not divided by alpha, [H, W].
    #[must_use]
    pub fn depth(&self) -> Tensor<2> {
        let [h, w, _] = self.output.dims();
        self.channels(4, 5).reshape([h, w])
    }

    /// Blended features, [H, W, F]; `None` when there were none.
    #[must_use]
    pub fn features(&self) -> Option<Tensor<3>> {
        let [_, _, channels] = self.output.dims();
        (channels > BASE_CHANNELS).then(|| self.channels(BASE_CHANNELS, channels))
    }

    /// As [`Prepared::radii`].
    #[must_use]
    pub fn radii(&self) -> Tensor<1> {
        self.radii.clone()
    }
}

/// A scene for the ops.
pub(crate) fn scene(splats: Splats, cam_from_world: Tensor<2>) -> SceneTensors<Dispatch> {
    let none = || Tensor::zeros([0, 3, 3], (&splats.means.device(), splats.means.dtype()));
    SceneTensors {
        left_rotations: splats.left_rotations.unwrap_or_else(none).into_dispatch(),
        means: splats.means.into_dispatch(),
        quats: splats.quats.into_dispatch(),
        log_scales: splats.log_scales.into_dispatch(),
        opacity_logits: splats.opacity_logits.into_dispatch(),
        sh: splats.sh.into_dispatch(),
        cam_from_world: cam_from_world.into_dispatch(),
    }
}

/// Projects the Gaussians into the view of a camera, culls, sorts by depth and lists them by tile.
///
/// Nothing of this is tracked: gradients come from [`rasterize`].
///
/// # Errors
/// Wrong shapes or types, an unusable camera, a value that is not finite (named with its row).
///
/// # Panics
/// On a backend that has no splatting kernels, with Burn's message, and on a GPU where tensors are not f32.
pub fn prepare(splats: &Splats, view: &Viewpoint) -> Result<Prepared, SplatError> {
    prepare_for(splats, view, None)
}

/// [`prepare`], with a look at the features that will be blended, where they are known: a device is waited for but once.
fn prepare_for(
    splats: &Splats,
    view: &Viewpoint,
    features: Option<&Tensor<2>>,
) -> Result<Prepared, SplatError> {
    let layout = splats.layout(&view.cam_from_world)?;
    layout.check_degree(view.sh_degree)?;
    let features = match features {
        Some(features) => {
            check_features(features, &layout)?;
            features.clone()
        }
        None => no_features(splats, &layout),
    };
    let scene = scene(splats.clone(), view.cam_from_world.clone());
    let (features, camera) = (features.into_dispatch(), view.camera.clone());
    match <Dispatch as SplatOps>::project(scene, features, camera, view.sh_degree) {
        Projected::Done(view) => Ok(Prepared { view, layout }),
        Projected::Refused(error) => Err(error),
    }
}

/// Blends prepared Gaussians into an image, and records the gradient of every float input.
///
/// `splats` and `cam_from_world` must hold the values that `prepared` was made from; they may be
/// tracked where those were not. The gradient of the pose treats its twelve entries as free
/// numbers, with the camera's centre as -Rᵀ t, and is skipped when the pose is not tracked.
///
/// # Errors
/// Wrong shapes or types, features that are not finite.
///
/// # Panics
/// As [`prepare`], and where `prepared` and `splats` are on different devices.
pub fn rasterize(
    prepared: &Prepared,
    splats: Splats,
    cam_from_world: Tensor<2>,
    extra: Extra,
) -> Result<Rendered, SplatError> {
    let Layout {
        rows,
        left,
        sh,
        dtype,
    } = prepared.layout;
    let found = splats.layout(&cam_from_world)?;
    check_shape("means", [found.rows, 3], [rows, 3])?;
    check_shape("left_rotations", [found.left, 3, 3], [left, 3, 3])?;
    check_shape("sh", [found.rows, found.sh], [rows, sh])?;
    check_dtype("means", found.dtype, dtype)?;
    let options = (&splats.means.device(), dtype);
    let features = match extra.features {
        Some(features) => {
            check_features(&features, &prepared.layout)?;
            features
        }
        None => no_features(&splats, &prepared.layout),
    };
    let screen_grad = match extra.screen_grad {
        Some(screen) => {
            check_shape("screen_grad", screen.dims(), [rows])?;
            check_dtype("screen_grad", screen.dtype(), dtype)?;
            screen
        }
        None => Tensor::zeros([0], options),
    };
    let blended = <Dispatch as SplatOps>::rasterize(
        prepared.view.clone(),
        scene(splats, cam_from_world),
        features.into_dispatch(),
        screen_grad.into_dispatch(),
    );
    match blended {
        Blended::Done(output) => Ok(Rendered {
            output: Tensor::from_dispatch(output),
            radii: prepared.radii(),
        }),
        Blended::Refused(error) => Err(error),
    }
}

fn check_features(features: &Tensor<2>, layout: &Layout) -> Result<(), SplatError> {
    let [_, width] = features.dims();
    check_shape("features", features.dims(), [layout.rows, width])?;
    check_dtype("features", features.dtype(), layout.dtype)
}

fn no_features(splats: &Splats, layout: &Layout) -> Tensor<2> {
    Tensor::zeros([layout.rows, 0], (&splats.means.device(), layout.dtype))
}

/// [`prepare`] and [`rasterize`] in a row.
///
/// # Errors
/// As those.
///
/// # Panics
/// As those.
pub fn render(splats: Splats, view: &Viewpoint, extra: Extra) -> Result<Rendered, SplatError> {
    let prepared = prepare_for(&splats, view, extra.features.as_ref())?;
    rasterize(&prepared, splats, view.cam_from_world.clone(), extra)
}
