//! What a render takes, as tensors, and the checks of their shapes and types.

use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::DAffine3;

use crate::camera::{Camera, pose_rows};
use crate::error::SplatError;
use crate::gaussians::Gaussians;

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

/// From where Gaussians are seen, and how.
#[derive(Clone, Debug)]
pub struct Viewpoint {
    /// Intrinsics, size and near plane.
    pub camera: Camera,
    /// Rows [R | t] of a rigid transform from the world to the camera, [3, 4], of the Gaussians' float type.
    pub cam_from_world: Tensor<2>,
    /// SH bands up to this degree are used; at most the stored degree.
    pub sh_degree: usize,
}

/// What must agree between a prepared view and what it is blended with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Number N of Gaussians.
    pub(crate) rows: usize,
    /// Number F of left rotations.
    pub(crate) left: usize,
    /// Columns of the spherical harmonics.
    pub(crate) sh: usize,
    pub(crate) dtype: DType,
}

impl Layout {
    /// Refuses SH bands that are not stored.
    pub(crate) fn check_degree(&self, active: usize) -> Result<(), SplatError> {
        let stored = (self.sh / 3).isqrt() - 1;
        if active > stored {
            return Err(SplatError::ShDegree { active, stored });
        }
        Ok(())
    }
}

impl Splats {
    /// Plain arrays as tensors of f32.
    ///
    /// # Errors
    /// As [`Gaussians::check`].
    pub fn new(gaussians: &Gaussians, device: &Device) -> Result<Self, SplatError> {
        gaussians.check()?;
        let slices = gaussians.slices();
        let rows = |values: &[f32], columns| {
            let data = TensorData::new(values.to_vec(), [gaussians.len(), columns]);
            Tensor::from_data(data, (device, DType::F32))
        };
        Ok(Self {
            means: rows(slices.means, 3),
            quats: rows(slices.quats, 4),
            left_rotations: None,
            log_scales: rows(slices.log_scales, 3),
            opacity_logits: rows(slices.opacity_logits, 1),
            sh: rows(slices.sh, 3 * (gaussians.sh_degree + 1).pow(2)),
        })
    }

    /// Refuses shapes and float types that do not go together, with the pose's.
    pub(crate) fn layout(&self, cam_from_world: &Tensor<2>) -> Result<Layout, SplatError> {
        let n = self.means.dims()[0];
        check_shape("means", self.means.dims(), [n, 3])?;
        check_shape("quats", self.quats.dims(), [n, 4])?;
        check_shape("log_scales", self.log_scales.dims(), [n, 3])?;
        check_shape("opacity_logits", self.opacity_logits.dims(), [n, 1])?;
        check_shape("cam_from_world", cam_from_world.dims(), [3, 4])?;
        let left = self.left_rotations.as_ref();
        let found = left.map_or([0, 3, 3], Tensor::dims);
        check_shape("left_rotations", found, [found[0].min(n), 3, 3])?;
        let [rows, columns] = self.sh.dims();
        if rows != n || ![3, 12, 27, 48].contains(&columns) {
            return Err(SplatError::Shape {
                tensor: "sh",
                found: vec![rows, columns],
                expected: format!("[{n}, B * 3] with B of 1, 4, 9 or 16"),
            });
        }
        let dtype = self.means.dtype();
        for (name, found) in [
            ("means", dtype),
            ("quats", self.quats.dtype()),
            ("left_rotations", left.map_or(dtype, Tensor::dtype)),
            ("log_scales", self.log_scales.dtype()),
            ("opacity_logits", self.opacity_logits.dtype()),
            ("sh", self.sh.dtype()),
            ("cam_from_world", cam_from_world.dtype()),
        ] {
            check_dtype(name, found, dtype)?;
        }
        Ok(Layout {
            rows: n,
            left: found[0],
            sh: columns,
            dtype,
        })
    }
}

impl Viewpoint {
    /// A view from a pose, on the device and in the float type of the Gaussians that are to be seen.
    #[must_use]
    pub fn new(
        camera: &Camera,
        cam_from_world: &DAffine3,
        sh_degree: usize,
        splats: &Splats,
    ) -> Self {
        let means = &splats.means;
        let rows = TensorData::new(pose_rows(cam_from_world).to_vec(), [3, 4]);
        Self {
            camera: camera.clone(),
            cam_from_world: Tensor::from_data(rows, (&means.device(), means.dtype())),
            sh_degree,
        }
    }
}

/// Refuses another shape than the one that fits.
pub(crate) fn check_shape<const D: usize>(
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

/// Refuses another float type than that of the means, and all that are neither f32 nor f64.
pub(crate) fn check_dtype(
    tensor: &'static str,
    found: DType,
    expected: DType,
) -> Result<(), SplatError> {
    if found == expected && matches!(found, DType::F32 | DType::F64) {
        return Ok(());
    }
    Err(SplatError::Dtype {
        tensor,
        found: format!("{found:?}"),
        expected: format!("{expected:?}"),
    })
}
