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
