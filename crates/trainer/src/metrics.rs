//! Scores of pictures, in f64.
//!
//! Pictures on slices are row-major [H, W, 3] in [0, 1]; the caller quantises them to 8 bit first, so that the
//! score is that of the PNG which is written.

use crate::cpu::ssim::{WINDOW_EDGE, ssim_map};
use crate::ops::{LARGE_SCALE, TrainerOps};
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use host::read;

/// PSNR of identical pictures, in dB, so that a score stays a number that JSON can hold. One unit of
/// 8 bit off in a single sample of a million is 108 dB; anything better counts as this much.
pub const LARGEST_PSNR: f64 = 120.0;

/// Peak signal-to-noise ratio in dB for a peak of 1: -10 log10(mean squared error), at most [`LARGEST_PSNR`].
///
/// # Panics
/// Panics if the pictures differ in size or are empty.
#[must_use]
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "two pictures of one size");
    assert!(!a.is_empty(), "a picture has pixels");
    let sum: f64 = a.iter().zip(b).map(|(a, b)| squared(*a, *b)).sum();
    decibel(sum, a.len())
}

/// PSNR over the pixels [H, W] where `mask` is set, in dB; `None` where it is set nowhere.
///
/// # Panics
/// Panics if the sizes do not agree.
#[must_use]
pub fn masked_psnr(a: &[f32], b: &[f32], mask: &[bool]) -> Option<f64> {
    assert_eq!(a.len(), b.len(), "two pictures of one size");
    assert_eq!(a.len(), mask.len() * 3, "a mask has one entry per pixel");
    let (sum, samples) = masked_error(a, b, mask);
    (samples > 0).then(|| decibel(sum, samples))
}

/// Sum of squared differences over the pixels [H, W] of two pictures [H, W, 3] where `mask` is set, and their samples.
pub(crate) fn masked_error(a: &[f32], b: &[f32], mask: &[bool]) -> (f64, usize) {
    let pixels = a.chunks_exact(3).zip(b.chunks_exact(3)).zip(mask);
    let set = pixels.filter(|(_, set)| **set);
    set.fold((0.0, 0), |(sum, samples), ((a, b), _)| {
        let error: f64 = a.iter().zip(b).map(|(a, b)| squared(*a, *b)).sum();
        (sum + error, samples + 3)
    })
}

/// PSNR in dB of two pictures [H, W, 3] as they are, over the `valid` pixels [H, W]; `None` means all. Not a number where no
/// pixel is valid.
///
/// # Panics
/// Panics if the pictures' shapes or dtypes differ, or if `valid` does not have H W entries.
#[must_use]
pub fn psnr_of(picture: &Tensor<3>, target: &Tensor<3>, valid: Option<&[bool]>) -> f64 {
    let error = SquaredError::of(picture, target, valid);
    let sums: Vec<f64> = read(error.sums.clone()).iter().collect();
    error.psnr(&sums)
}

/// The squared differences of two pictures, to be read together with other numbers.
pub(crate) struct SquaredError {
    /// See [`TrainerOps::squared_error`], `[2]`, without a graph.
    pub(crate) sums: Tensor<1>,
    samples: usize,
}

impl SquaredError {
    /// See [`psnr_of`].
    pub(crate) fn of(picture: &Tensor<3>, target: &Tensor<3>, valid: Option<&[bool]>) -> Self {
        let [height, width, channels] = picture.dims();
        assert_eq!(
            target.dims(),
            [height, width, channels],
            "two pictures of one size"
        );
        assert_eq!(channels, 3, "pictures have three channels");
        let pixels = valid.map_or(height * width, |valid| {
            assert_eq!(valid.len(), height * width, "one validity per pixel");
            valid.iter().filter(|valid| **valid).count()
        });
        let sums = <Dispatch as TrainerOps>::squared_error(
            picture.clone().inner().into_dispatch(),
            target.clone().inner().into_dispatch(),
            valid,
        );
        Self {
            sums: Tensor::from_dispatch(sums),
            samples: pixels * 3,
        }
    }

    /// PSNR in dB; `sums` are the values of `self.sums`. Not a number where no pixel is valid.
    pub(crate) fn psnr(&self, sums: &[f64]) -> f64 {
        if self.samples == 0 {
            return f64::NAN;
        }
        let scale = f64::from(LARGE_SCALE);
        decibel(sums[0] + sums[1] / (scale * scale), self.samples)
    }
}

/// Structural similarity (Wang et al., 2004): 11x11 Gaussian window of sigma 1.5, C1 = 0.01², C2 = 0.03²,
/// mean over the region where the window fits and over the channels.
///
/// `None` for a picture smaller than the window.
///
/// # Panics
/// Panics if a picture's length is not `width * height * 3`.
#[must_use]
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> Option<f64> {
    assert_eq!(a.len(), width * height * 3, "a is [H, W, 3]");
    assert_eq!(b.len(), width * height * 3, "b is [H, W, 3]");
    const EDGE: usize = WINDOW_EDGE;
    if width <= 2 * EDGE || height <= 2 * EDGE {
        return None;
    }
    let wide = |picture: &[f32]| -> Vec<f64> { picture.iter().map(|v| f64::from(*v)).collect() };
    let map = ssim_map(&wide(a), &wide(b), width, height);
    let mut sum = 0.0;
    for row in EDGE..height - EDGE {
        sum += map[(row * width + EDGE) * 3..(row * width + width - EDGE) * 3]
            .iter()
            .sum::<f64>();
    }
    let count = (width - 2 * EDGE) * (height - 2 * EDGE) * 3;
    Some(sum / count as f64)
}

fn squared(a: f32, b: f32) -> f64 {
    let difference = f64::from(a) - f64::from(b);
    difference * difference
}

/// PSNR of a sum of squared differences; NaN where that is.
pub(crate) fn decibel(sum: f64, samples: usize) -> f64 {
    let psnr = -10.0 * (sum / samples as f64).log10();
    // Not `min`, by which NaN would be a perfect picture.
    if psnr > LARGEST_PSNR {
        LARGEST_PSNR
    } else {
        psnr
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_is_no_perfect_picture() {
        assert!(psnr(&[f32::NAN; 3], &[0.5; 3]).is_nan());
        let masked = masked_psnr(&[f32::NAN; 3], &[0.5; 3], &[true]);
        assert!(masked.expect("a pixel").is_nan());
        assert_eq!(psnr(&[0.5; 3], &[0.5; 3]), LARGEST_PSNR);
    }

    #[test]
    fn psnr_of_known_errors() {
        // Mean squared error 0.01: 20 dB.
        assert!((psnr(&[0.5; 12], &[0.6; 12]) - 20.0).abs() < 1e-5);
        // One sample of four is off by 1: mean squared error 1/4.
        let off = psnr(&[0.0; 4], &[0.0, 0.0, 0.0, 1.0]);
        assert!((off - 10.0 * 4.0_f64.log10()).abs() < 1e-12);
        assert_eq!(psnr(&[0.3; 3], &[0.3; 3]), LARGEST_PSNR);
    }

    #[test]
    fn masked_psnr_sees_only_the_mask() {
        let (a, b) = ([0.0; 6], [0.1, 0.1, 0.1, 1.0, 1.0, 1.0]);
        let score = masked_psnr(&a, &b, &[true, false]).expect("one pixel is set");
        assert!((score - 20.0).abs() < 1e-5);
        assert_eq!(masked_psnr(&a, &b, &[false, false]), None);
        let whole = masked_psnr(&a, &b, &[true, true]).expect("both pixels are set");
        assert!((whole - psnr(&a, &b)).abs() < 1e-12);
    }

    /// SSIM with the window laid over every pixel where it fits, straight from the definition.
    fn direct(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
        let weight = |k: usize| (-((k as f64 - 5.0).powi(2)) / (2.0 * 1.5 * 1.5)).exp();
        let total: f64 = (0..11).map(weight).sum::<f64>().powi(2);
        let (mut sum, mut count) = (0.0, 0);
        for y in 0..height - 10 {
            for x in 0..width - 10 {
                for channel in 0..3 {
                    let moments = |f: &dyn Fn(f64, f64) -> f64| {
                        let mut sum = 0.0;
                        for v in 0..11 {
                            for u in 0..11 {
                                let k = ((y + v) * width + x + u) * 3 + channel;
                                sum += weight(u) * weight(v) / total
                                    * f(f64::from(a[k]), f64::from(b[k]));
                            }
                        }
                        sum
                    };
                    let (m, n) = (moments(&|a, _| a), moments(&|_, b| b));
                    let va = moments(&|a, _| (a - m).powi(2));
                    let vb = moments(&|_, b| (b - n).powi(2));
                    let c = moments(&|a, b| (a - m) * (b - n));
                    sum += (2.0 * m * n + 0.01_f64.powi(2)) * (2.0 * c + 0.03_f64.powi(2))
                        / ((m * m + n * n + 0.01_f64.powi(2)) * (va + vb + 0.03_f64.powi(2)));
                    count += 1;
                }
            }
        }
        sum / f64::from(count)
    }

    #[test]
    fn ssim_agrees_with_its_definition() {
        let (width, height) = (17, 13);
        let a: Vec<f32> = (0..width * height * 3)
            .map(|k| 0.5 + 0.5 * ((k * k) as f32 * 0.37).sin())
            .collect();
        let b: Vec<f32> = a
            .iter()
            .enumerate()
            .map(|(k, v)| 0.8 * v + 0.1 * (k as f32 * 1.7).cos())
            .collect();
        let score = ssim(&a, &b, width, height).expect("larger than the window");
        let expected = direct(&a, &b, width, height);
        assert!((score - expected).abs() < 1e-10, "{score} and {expected}");
        assert!((ssim(&a, &a, width, height).expect("large enough") - 1.0).abs() < 1e-12);
        assert_eq!(ssim(&a[..10 * 13 * 3], &b[..10 * 13 * 3], 10, 13), None);
    }
}
