//! The lens in one frame, for what makes discs without samples.

use burn::tensor::Tensor;

/// A lens that is focused.
#[derive(Clone, Debug)]
pub(super) struct Lens {
    /// Radius, scene sizes, [1, 1].
    pub(super) aperture: Tensor<2>,
    /// Disparity of focus, S / distance, [1, 1].
    pub(super) focus: Tensor<2>,
    /// Scene size S, scene units.
    pub(super) size: f64,
}

impl Lens {
    /// Radius of the discs at some depths [N, 1], scene units; negative in front of the focus.
    pub(super) fn radius_at(&self, depths: Tensor<2>) -> Tensor<2> {
        (depths * self.focus.clone() - self.size) * self.aperture.clone()
    }

    /// The same at one depth in an image with this focal length, px, [1, 1].
    pub(super) fn radius_in_image(&self, depth: f64, focal: f64) -> Tensor<2> {
        (self.focus.clone() - self.size / depth) * self.aperture.clone() * focal
    }
}

/// What the tests of both kinds of discs look through.
#[cfg(test)]
pub(super) mod examples {
    use super::{Lens, Tensor};
    use crate::views::pose_tensor;
    use burn::tensor::{DType, Device, TensorData};
    use capture::{Capture, samples};
    use glam::DAffine3;
    use splat_core::{Camera, Exposed, Exposure, Splats, Transfer, Viewpoint, expose};

    /// Scene size, scene units.
    const SIZE: f64 = 4.0;
    /// Focal length, px.
    pub(in crate::blur::camera) const FOCAL: f64 = 60.0;

    pub(in crate::blur::camera) fn tensor<const D: usize>(
        values: impl IntoIterator<Item = f64>,
        shape: [usize; D],
    ) -> Tensor<D> {
        let data = TensorData::new(values.into_iter().collect(), shape);
        Tensor::from_data(data, (&Device::flex().autodiff(), DType::F64))
    }

    pub(in crate::blur::camera) fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
        host::read(tensor.detach()).iter::<f64>().collect()
    }

    /// A square picture along the z-axis.
    pub(in crate::blur::camera) fn ahead(side: usize) -> Viewpoint {
        Viewpoint {
            camera: Camera::pinhole([side; 2], [FOCAL; 2], [side as f64 / 2.0; 2]),
            cam_from_world: pose_tensor(
                &DAffine3::IDENTITY,
                (&Device::flex().autodiff(), DType::F64),
            ),
            sh_degree: 0,
        }
    }

    pub(in crate::blur::camera) fn lens(aperture: f64, focus: f64) -> Lens {
        Lens {
            aperture: tensor([aperture], [1, 1]),
            focus: tensor([focus], [1, 1]),
            size: SIZE,
        }
    }

    /// What 256 points of the lens see.
    pub(in crate::blur::camera) fn through_points(
        splats: Splats,
        view: &Viewpoint,
        lens: &Lens,
        transfer: Transfer,
    ) -> Exposed {
        let mut capture = Capture::still(1, 1, (&Device::flex().autodiff(), DType::F64));
        capture.aperture = lens.aperture.clone();
        capture.focus = lens.focus.clone();
        let exposure = Exposure {
            poses: capture.poses(0, &view.cam_from_world, &samples(256, 0.0), SIZE),
            movers: None,
            transfer,
        };
        expose(splats, view, exposure, None).expect("a picture")
    }
}
