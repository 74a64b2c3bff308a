//! Softness: a blur that every pixel of every frame shares is the scene's own. Gaussians that have sharpened under a lens leave
//! frames too sharp without it, also where the lens was not there; softer ones would not. One that every pixel of a frame shares may
//! be the rest of its path, and is no lens either (RESULTS.md, "A lens that is not there").

use burn::tensor::Tensor;

/// Variances of the blurs that are tried, px²: sharper Gaussians than these make up for are not to be had.
pub(super) const SOFTNESS: [f64; 5] = [0.03, 0.06, 0.125, 0.25, 0.5];

/// A picture [H, W, C] blurred everywhere alike: each pixel with its neighbours, along rows and columns by `variance` (px², at most
/// 0.5, where the weights are 1, 2, 1). Outside the picture it goes on as its border.
pub(super) fn softened(picture: &Tensor<3>, variance: f64) -> Tensor<3> {
    softened_along(0, &softened_along(1, picture, variance), variance)
}

/// The same along columns (`dim` 0) or rows (1) alone.
pub(super) fn softened_along(dim: usize, picture: &Tensor<3>, variance: f64) -> Tensor<3> {
    let n = picture.dims()[dim];
    if n == 1 {
        return picture.clone();
    }
    let part = |start, length| picture.clone().narrow(dim, start, length);
    let before = Tensor::cat(vec![part(0, 1), part(0, n - 1)], dim);
    let after = Tensor::cat(vec![part(1, n - 1), part(n - 1, 1)], dim);
    picture.clone() * (1.0 - variance) + (before + after) * (0.5 * variance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensors::host;
    use burn::tensor::{Device, TensorData};

    fn picture(values: Vec<f32>, [height, width]: [usize; 2]) -> Tensor<3> {
        let data = TensorData::new(values, [height, width, 1]);
        Tensor::from_data(data, &Device::flex())
    }

    #[test]
    fn a_point_spreads_by_its_variance_and_keeps_its_light() {
        let [height, width] = [7, 9];
        let mut point = vec![0.0; height * width];
        point[3 * width + 4] = 1.0;
        for variance in SOFTNESS {
            let spread = host(softened(&picture(point.clone(), [height, width]), variance));
            let moment = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
                let at = |i: usize| of((i / width) as f64 - 3.0, (i % width) as f64 - 4.0);
                let each = spread.iter().enumerate();
                each.map(|(i, v)| f64::from(*v) * at(i)).sum()
            };
            assert!((moment(&|_, _| 1.0) - 1.0).abs() < 1e-6);
            assert!((moment(&|y, _| y * y) - variance).abs() < 1e-6);
            assert!((moment(&|_, x| x * x) - variance).abs() < 1e-6);
            assert!(moment(&|y, x| y * x + y + x).abs() < 1e-6);
        }
    }

    /// Also of one row, of one column and of one pixel.
    #[test]
    fn what_is_even_stays_even_up_to_the_border() {
        for size in [[4, 5], [1, 6], [6, 1], [1, 1]] {
            let even = picture(vec![0.3; size[0] * size[1]], size);
            let soft = host(softened(&even, 0.5));
            assert!(soft.iter().all(|v| (v - 0.3).abs() < 1e-6), "{size:?}");
        }
    }
}
