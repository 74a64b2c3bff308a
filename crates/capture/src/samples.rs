//! Which moments and which points of the lens stand for an exposure.

use std::f64::consts::{PI, TAU};

/// Turn from one point of a sunflower to the next, rad: however many follow each other, no two directions are alike.
pub const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

/// A moment of an exposure and a point of the lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// From -1/2, where the shutter opens, to 1/2.
    pub moment: f64,
    /// On the unit disc.
    pub lens: [f64; 2],
}

impl Sample {
    /// A moment as the lens' middle sees it.
    #[must_use]
    pub fn through_the_middle(moment: f64) -> Self {
        Self {
            moment,
            lens: [0.0; 2],
        }
    }
}

/// `count` samples: one moment in each of as many equal parts of the exposure, and points that cover the disc evenly
/// (Vogel's sunflower), paired so that early and late moments see all of the lens.
///
/// Both are jittered: `jitter[0]` in [0, 1) is the place of the moment in its part, `jitter[1]` in [0, 1) turns the disc. A
/// single sample is the middle of both.
#[must_use]
pub fn samples(count: usize, jitter: [f64; 2]) -> Vec<Sample> {
    if count == 1 {
        return vec![Sample::through_the_middle(0.0)];
    }
    let stride = coprime_stride(count);
    let offset = balanced_offset(count, stride);
    (0..count)
        .map(|i| {
            let point = (i * stride + offset) % count;
            let radius = ((point as f64 + 0.5) / count as f64).sqrt();
            let angle = point as f64 * GOLDEN_ANGLE + jitter[1] * TAU;
            Sample {
                moment: (i as f64 + jitter[0]) / count as f64 - 0.5,
                lens: [radius * angle.cos(), radius * angle.sin()],
            }
        })
        .collect()
}

/// A step through `count` places that visits all of them, near the golden section so that neighbours lie far apart.
fn coprime_stride(count: usize) -> usize {
    let gcd = |mut a: usize, mut b: usize| {
        while b > 0 {
            (a, b) = (b, a % b);
        }
        a
    };
    let near = (count as f64 * 0.618).round() as usize;
    (near.max(1)..)
        .find(|stride| gcd(*stride, count) == 1)
        .unwrap_or(1)
}

/// Where to begin, so that late moments do not lie farther out than early ones, or nearer.
fn balanced_offset(count: usize, stride: usize) -> usize {
    let late = |i: usize| 2.0 * i as f64 - (count - 1) as f64;
    let slope = |offset: usize| -> f64 {
        let radius = |i: usize| (((i * stride + offset) % count) as f64 + 0.5).sqrt();
        (0..count).map(|i| late(i) * radius(i)).sum()
    };
    (0..count)
        .min_by(|a, b| slope(*a).abs().total_cmp(&slope(*b).abs()))
        .unwrap_or(0)
}

/// How many samples a blur wants that is a disc of diameter `disc_px` drawn along a path of `path_px`, at a distance of
/// `spacing_px` from each other: from 1, where both are under half of it, up to `limit`.
#[must_use]
pub fn samples_for(path_px: f64, disc_px: f64, spacing_px: f64, limit: usize) -> usize {
    let (length, disc) = (path_px / spacing_px, disc_px / spacing_px);
    let longest = length.max(disc);
    if longest.is_nan() || longest <= 0.5 {
        return 1;
    }
    // The area that is covered, with one row of samples where it is a line.
    let count = length + disc * length + 0.25 * PI * disc * disc;
    (1 + count.ceil().min(limit as f64) as usize).min(limit.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_cover_exposure_and_lens_evenly_whatever_their_number() {
        for count in 2..=40 {
            let taken = samples(count, [0.5, 0.3]);
            assert_eq!(taken.len(), count);
            let sum =
                |value: fn(&Sample) -> f64| taken.iter().map(value).sum::<f64>() / count as f64;
            assert!(
                sum(|s| s.moment).abs() < 1e-12,
                "{count}: middle of the moments"
            );
            // A uniform disc of radius 1 has mean |u|² = 1/2.
            let square = sum(|s| s.lens[0] * s.lens[0] + s.lens[1] * s.lens[1]);
            assert!(
                (square - 0.5).abs() < 1e-12,
                "{count}: mean square {square}"
            );
            let off = sum(|s| s.lens[0]).hypot(sum(|s| s.lens[1]));
            assert!(
                off < 0.75 / (count as f64).sqrt(),
                "{count}: middle of the lens {off}"
            );
        }
    }

    #[test]
    fn moments_and_points_are_not_correlated() {
        for count in 4..=40 {
            let taken = samples(count, [0.5, 0.1]);
            let radius = |s: &Sample| s.lens[0].hypot(s.lens[1]) - 2.0 / 3.0;
            let sum: f64 = taken.iter().map(|s| s.moment * radius(s)).sum();
            let correlation =
                sum / (count as f64 * (1.0_f64 / 12.0).sqrt() * (1.0_f64 / 18.0).sqrt());
            assert!(correlation.abs() < 0.25, "{count}: {correlation}");
        }
    }

    #[test]
    fn the_number_of_samples_grows_with_the_blur() {
        assert_eq!(samples_for(0.0, 0.0, 0.75, 16), 1);
        assert_eq!(samples_for(0.3, 0.3, 0.75, 16), 1);
        assert_eq!(samples_for(f64::NAN, 0.0, 0.75, 16), 1);
        assert_eq!(samples_for(3.0, 0.0, 0.75, 16), 5);
        assert!(samples_for(3.0, 2.0, 0.75, 64) > samples_for(3.0, 0.0, 0.75, 64));
        assert!(samples_for(1e300, 1e300, 0.75, 16) == 16);
    }
}
