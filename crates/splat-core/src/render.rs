//! Rendering on tensors.

use std::fmt;
use std::sync::Arc;

use burn::backend::Dispatch;
use burn::tensor::{DType, Tensor};

use crate::cpu::{self, BASE_CHANNELS, Projection, SplatSlices, View};
use crate::host::{HostArray, HostFloat};
use crate::ops::{Parents, RasterJob, SplatOps};
use crate::{Camera, SplatError};

/// Gaussians as tensors of one float type (f32 or f64) on one device.
#[derive(Clone, Debug)]
pub struct Splats {
    /// Means in the world, scene units, [N, 3].
    pub means: Tensor<2>,
    /// Quaternions (w, x, y, z), not normalised, [N, 4].
    pub quats: Tensor<2>,
    /// Matrices multiplied from the left of the rotation of rows [0, F), [F, 3, 3]: the motion.
    pub left_rotations: Option<Tensor<3>>,
    /// Natural logarithms of the scales, [N, 3].
    pub log_scales: Tensor<2>,
    /// Logits of the opacities, [N, 1].
    pub opacity_logits: Tensor<2>,
    /// Spherical harmonics, [N, B * 3] with B = (stored degree + 1)²: coefficient-major, channel last.
    pub sh: Tensor<2>,
}

/// What a render does beside what its inputs say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RenderOptions {
    /// SH bands up to this degree are used; at most the stored degree.
    pub sh_degree: usize,
}

/// Gaussians projected into a view, sorted and listed by tile: everything of a render that does
/// not depend on features. Cheap to clone.
#[derive(Clone)]
pub struct Prepared(pub(crate) Arc<Precision>);

#[derive(Debug)]
pub(crate) enum Precision {
    F32(Scene<f32>),
    F64(Scene<f64>),
}

/// Inputs on the host and their projection.
#[derive(Debug)]
pub(crate) struct Scene<T> {
    inputs: Inputs,
    sh_width: usize,
    pub(crate) projection: Projection<T>,
}

#[derive(Debug)]
struct Inputs {
    means: HostArray,
    quats: HostArray,
    left_rotations: Option<HostArray>,
    log_scales: HostArray,
    opacity_logits: HostArray,
    sh: HostArray,
}

impl Inputs {
    fn slices<T: HostFloat>(&self) -> SplatSlices<'_, T> {
        SplatSlices {
            means: self.means.as_slice(),
            quats: self.quats.as_slice(),
            left_rotations: self
                .left_rotations
                .as_ref()
                .map_or(&[], HostArray::as_slice),
            log_scales: self.log_scales.as_slice(),
            opacity_logits: self.opacity_logits.as_slice(),
            sh: self.sh.as_slice(),
        }
    }
}

impl<T: HostFloat> Scene<T> {
    fn new(
        inputs: Inputs,
        sh_width: usize,
        pose: &HostArray,
        camera: &Camera,
        options: &RenderOptions,
    ) -> Result<Self, SplatError> {
        let mut cam_from_world = [T::ZERO; 12];
        cam_from_world.copy_from_slice(pose.as_slice());
        let view = View {
            camera: camera.clone(),
            cam_from_world,
            sh_degree: options.sh_degree,
        };
        let projection = cpu::project(&inputs.slices::<T>(), &view)?;
        Ok(Self {
            inputs,
            sh_width,
            projection,
        })
    }

    pub(crate) fn slices(&self) -> SplatSlices<'_, T> {
        self.inputs.slices()
    }

    /// Columns of the SH tensor.
    pub(crate) fn sh_width(&self) -> usize {
        self.sh_width
    }
}

impl Prepared {
    /// Radius of every Gaussian in the image (three standard deviations of its longer axis), px,
    /// `[N]`; 0 for Gaussians that are not drawn.
    #[must_use]
    pub fn radii(&self) -> &[f32] {
        match &*self.0 {
            Precision::F32(scene) => scene.projection.radii(),
            Precision::F64(scene) => scene.projection.radii(),
        }
    }

    /// Number of Gaussians that are drawn.
    #[must_use]
    pub fn num_visible(&self) -> usize {
        self.radii().iter().filter(|r| **r > 0.0).count()
    }

    /// The camera it was made for.
    #[must_use]
    pub fn camera(&self) -> &Camera {
        match &*self.0 {
            Precision::F32(scene) => &scene.projection.view().camera,
            Precision::F64(scene) => &scene.projection.view().camera,
        }
    }

    fn dtype(&self) -> DType {
        match &*self.0 {
            Precision::F32(_) => DType::F32,
            Precision::F64(_) => DType::F64,
        }
    }

    /// N, F of the left rotations, and the columns of SH.
    fn sizes(&self) -> (usize, Option<usize>, usize) {
        fn of<T: HostFloat>(scene: &Scene<T>) -> (usize, Option<usize>, usize) {
            let slices = scene.slices();
            let left = scene.inputs.left_rotations.as_ref();
            (
                slices.len(),
                left.map(|_| slices.num_left()),
                scene.sh_width,
            )
        }
        match &*self.0 {
            Precision::F32(scene) => of(scene),
            Precision::F64(scene) => of(scene),
        }
    }
}

impl fmt::Debug for Prepared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Prepared")
            .field("gaussians", &self.radii().len())
            .field("visible", &self.num_visible())
            .field("camera", self.camera())
            .field("dtype", &self.dtype())
            .finish()
    }
}

/// A rendered image with everything that comes with it, as views of one tensor.
#[derive(Clone, Debug)]
pub struct Rendered {
    output: Tensor<3>,
    prepared: Prepared,
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

    /// Radius of every Gaussian in the image (three standard deviations of its longer axis), px,
    /// `[N]`; 0 for Gaussians that are not drawn.
    #[must_use]
    pub fn radii(&self) -> &[f32] {
        self.prepared.radii()
    }

    /// Number of Gaussians that are drawn.
    #[must_use]
    pub fn num_visible(&self) -> usize {
        self.prepared.num_visible()
    }
}

fn shape<const D: usize>(
    tensor: &'static str,
    found: [usize; D],
    expected: [usize; D],
) -> Result<(), SplatError> {
    if found == expected {
        return Ok(());
    }
    Err(SplatError::Shape {
        tensor,
        found: found.to_vec(),
        expected: format!("{expected:?}"),
    })
}

fn check_shapes(splats: &Splats, pose: &Tensor<2>) -> Result<(), SplatError> {
    let n = splats.means.dims()[0];
    shape("means", splats.means.dims(), [n, 3])?;
    shape("quats", splats.quats.dims(), [n, 4])?;
    shape("log_scales", splats.log_scales.dims(), [n, 3])?;
    shape("opacity_logits", splats.opacity_logits.dims(), [n, 1])?;
    shape("cam_from_world", pose.dims(), [3, 4])?;
    if let Some(left) = &splats.left_rotations {
        let f = left.dims()[0];
        shape("left_rotations", left.dims(), [f.min(n), 3, 3])?;
    }
    let [rows, columns] = splats.sh.dims();
    if rows != n || ![3, 12, 27, 48].contains(&columns) {
        return Err(SplatError::Shape {
            tensor: "sh",
            found: vec![rows, columns],
            expected: format!("[{n}, B * 3] with B of 1, 4, 9 or 16"),
        });
    }
    Ok(())
}

fn check_dtype(tensor: &'static str, found: DType, expected: DType) -> Result<(), SplatError> {
    if found == expected && matches!(found, DType::F32 | DType::F64) {
        return Ok(());
    }
    Err(SplatError::Dtype {
        tensor,
        found: format!("{found:?}"),
        expected: format!("{expected:?}"),
    })
}

/// Projects the Gaussians into the view of a camera, culls, sorts by depth and lists them by tile.
///
/// `cam_from_world` holds the rows [R | t] of a rigid transform, [3, 4]. Nothing of this is tracked:
/// gradients come from [`rasterize`].
///
/// # Errors
/// Wrong shapes or types, an unusable camera, a value that is not finite (named with its row).
pub fn prepare(
    splats: &Splats,
    cam_from_world: &Tensor<2>,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Prepared, SplatError> {
    check_shapes(splats, cam_from_world)?;
    let inputs = Inputs {
        means: HostArray::read("means", &splats.means)?,
        quats: HostArray::read("quats", &splats.quats)?,
        left_rotations: splats
            .left_rotations
            .as_ref()
            .map(|left| HostArray::read("left_rotations", left))
            .transpose()?,
        log_scales: HostArray::read("log_scales", &splats.log_scales)?,
        opacity_logits: HostArray::read("opacity_logits", &splats.opacity_logits)?,
        sh: HostArray::read("sh", &splats.sh)?,
    };
    let pose = HostArray::read("cam_from_world", cam_from_world)?;
    let dtype = inputs.means.dtype();
    for (name, array) in [
        ("means", &inputs.means),
        ("quats", &inputs.quats),
        ("log_scales", &inputs.log_scales),
        ("opacity_logits", &inputs.opacity_logits),
        ("sh", &inputs.sh),
        ("cam_from_world", &pose),
    ] {
        check_dtype(name, array.dtype(), dtype)?;
    }
    if let Some(left) = &inputs.left_rotations {
        check_dtype("left_rotations", left.dtype(), dtype)?;
    }
    // With no Gaussian the slices cannot tell how many coefficients were stored.
    let sh_width = splats.sh.dims()[1];
    let stored = (sh_width / 3).isqrt() - 1;
    if options.sh_degree > stored {
        return Err(SplatError::ShDegree {
            active: options.sh_degree,
            stored,
        });
    }
    let precision = if dtype == DType::F64 {
        Precision::F64(Scene::new(inputs, sh_width, &pose, camera, options)?)
    } else {
        Precision::F32(Scene::new(inputs, sh_width, &pose, camera, options)?)
    };
    Ok(Prepared(Arc::new(precision)))
}

/// Blends prepared Gaussians into an image, and records the gradient of every float input.
///
/// `splats` and `cam_from_world` must hold the values that `prepared` was made from (they may be
/// tracked where those were not): the op reads the prepared values and gives gradients to these.
/// The gradient of the pose treats its twelve entries as free numbers, with the camera's centre as
/// -Rᵀ t, and is skipped when the pose is not tracked.
///
/// `features` [N, F] are blended like colours. `screen_grad` `[N]` takes no part in the image: when it
/// is tracked its "gradient" is each Gaussian's norm of the gradient of its mean in the image, in
/// NDC units (v.x W/2, v.y H/2), the statistic of density control.
///
/// # Errors
/// Wrong shapes or types, features that are not finite.
///
/// # Panics
/// On a backend that has no splatting kernels, with Burn's message.
pub fn rasterize(
    prepared: &Prepared,
    splats: Splats,
    cam_from_world: Tensor<2>,
    features: Option<Tensor<2>>,
    screen_grad: Option<Tensor<1>>,
) -> Result<Rendered, SplatError> {
    check_shapes(&splats, &cam_from_world)?;
    let (n, left, sh_width) = prepared.sizes();
    shape("means", splats.means.dims(), [n, 3])?;
    shape("sh", splats.sh.dims(), [n, sh_width])?;
    let found = splats.left_rotations.as_ref().map(|l| l.dims()[0]);
    if found != left {
        return Err(SplatError::Shape {
            tensor: "left_rotations",
            found: found.map_or_else(Vec::new, |f| vec![f, 3, 3]),
            expected: format!("what was prepared ({left:?} rows)"),
        });
    }
    check_dtype("means", splats.means.dtype(), prepared.dtype())?;
    check_dtype("cam_from_world", cam_from_world.dtype(), prepared.dtype())?;
    let mut num_features = 0;
    let mut feature_values = None;
    if let Some(features) = &features {
        num_features = features.dims()[1];
        shape("features", features.dims(), [n, num_features])?;
        check_dtype("features", features.dtype(), prepared.dtype())?;
        feature_values = Some(HostArray::read("features", features)?);
    }
    if let Some(screen) = &screen_grad {
        shape("screen_grad", screen.dims(), [n])?;
        check_dtype("screen_grad", screen.dtype(), prepared.dtype())?;
    }
    let job = RasterJob::new(prepared.clone(), feature_values, num_features)?;
    // Not `detach`, which keeps a leaf's wish for a gradient.
    let absent = Tensor::from_inner(splats.means.clone().inner()).into_dispatch();
    let parents = Parents::<Dispatch> {
        means: splats.means.into_dispatch(),
        quats: splats.quats.into_dispatch(),
        left_rotations: splats
            .left_rotations
            .map_or_else(|| absent.clone(), Tensor::into_dispatch),
        log_scales: splats.log_scales.into_dispatch(),
        opacity_logits: splats.opacity_logits.into_dispatch(),
        sh: splats.sh.into_dispatch(),
        cam_from_world: cam_from_world.into_dispatch(),
        features: features.map_or_else(|| absent.clone(), Tensor::into_dispatch),
        screen_grad: screen_grad.map_or(absent, Tensor::into_dispatch),
    };
    let output = <Dispatch as SplatOps>::rasterize_splats(parents, job);
    Ok(Rendered {
        output: Tensor::from_dispatch(output),
        prepared: prepared.clone(),
    })
}

/// [`prepare`] and [`rasterize`] in a row.
///
/// # Errors
/// As those.
///
/// # Panics
/// As [`rasterize`].
pub fn render(
    splats: Splats,
    cam_from_world: Tensor<2>,
    camera: &Camera,
    options: &RenderOptions,
    features: Option<Tensor<2>>,
    screen_grad: Option<Tensor<1>>,
) -> Result<Rendered, SplatError> {
    let prepared = prepare(&splats, &cam_from_world, camera, options)?;
    rasterize(&prepared, splats, cam_from_world, features, screen_grad)
}
