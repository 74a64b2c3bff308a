//! Scores of pictures on plain slices, in f64.
//!
//! Pictures are row-major [H, W, 3] in [0, 1]; the caller quantises them to 8 bit first, so that the
//! score is that of the PNG which is written.

use crate::losses::{WINDOW_EDGE, ssim_map};

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
    let mut sum = 0.0;
    let mut pixels = 0;
    for (pixel, _) in mask.iter().enumerate().filter(|(_, set)| **set) {
        sum += (3 * pixel..3 * pixel + 3)
            .map(|k| squared(a[k], b[k]))
            .sum::<f64>();
        pixels += 1;
    }
    (pixels > 0).then(|| decibel(sum, pixels * 3))
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

fn decibel(sum: f64, samples: usize) -> f64 {
    (-10.0 * (sum / samples as f64).log10()).min(LARGEST_PSNR)
}
