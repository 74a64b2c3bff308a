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

/// `count` samples: evenly spread moments, and points that cover the disc evenly (Vogel's sunflower) and are turned by `turn`
/// of a full turn.
///
/// From 4 on they have the mean and the covariance of all moments of an exposure and all points of a lens: 0, 1/12 for a moment, 1/4
/// for each coordinate on the lens and 0 between any two. So a picture of a few samples is neither shifted against one of many
/// nor blurred more or less, and no lens looks like a path. 2 and 3 have it as far as so few can. A single sample is the middle of
/// both.
#[must_use]
pub fn samples(count: usize, turn: f64) -> Vec<Sample> {
    if count < 2 {
        return vec![Sample::through_the_middle(0.0); count];
    }
    let n = count as f64;
    // Points follow each other as they do in the sunflower, so that no moment has a side of the lens; from a fifth of them on, early
    // ones lie as far out as late ones.
    let first = (count + 2) / 5;
    let mut all: Vec<Sample> = (0..count)
        .map(|i| {
            let point = (i + first) % count;
            let radius = ((point as f64 + 0.5) / n).sqrt();
            let angle = point as f64 * GOLDEN_ANGLE + turn * TAU;
            Sample {
                moment: (i as f64 + 0.5) / n - 0.5,
                lens: [radius * angle.cos(), radius * angle.sin()],
            }
        })
        .collect();
    match_exposure(&mut all);
    all
}

/// Mean of a function of the samples.
fn mean(all: &[Sample], of: impl Fn(&Sample) -> f64) -> f64 {
    all.iter().map(of).sum::<f64>() / all.len() as f64
}

/// Moves what is nearly so by as little as it takes to have the mean and the covariance of an exposure.
fn match_exposure(all: &mut [Sample]) {
    let middle = [0, 1].map(|k| mean(all, |s| s.lens[k]));
    let longer = (mean(all, |s| s.moment * s.moment) * 12.0).sqrt().recip();
    for sample in &mut *all {
        sample.moment *= longer;
        sample.lens = [0, 1].map(|k| sample.lens[k] - middle[k]);
    }
    if all.len() < 4 {
        let square = mean(all, |s| s.lens[0] * s.lens[0] + s.lens[1] * s.lens[1]);
        let wider = (2.0 * square).sqrt().recip();
        for sample in all {
            sample.lens = sample.lens.map(|u| u * wider);
        }
        return;
    }
    let along = [0, 1].map(|k| 12.0 * mean(all, |s| s.moment * s.lens[k]));
    for sample in &mut *all {
        sample.lens = [0, 1].map(|k| sample.lens[k] - along[k] * sample.moment);
    }
    let covariance = |i: usize, j: usize| 4.0 * mean(all, |s| s.lens[i] * s.lens[j]);
    let [[a, b], [_, c]] = [0, 1].map(|i| [0, 1].map(|j| covariance(i, j)));
    // The root of a matrix M of 2x2 is (M + √|M| I) / √(tr M + 2 √|M|); this is its inverse.
    let root = (a * c - b * b).sqrt();
    let scale = (root * (a + c + 2.0 * root).sqrt()).recip();
    let [xx, xy, yy] = [c + root, -b, a + root].map(|v| v * scale);
    for sample in all {
        let [x, y] = sample.lens;
        sample.lens = [xx * x + xy * y, xy * x + yy * y];
    }
}

/// A blur: a disc drawn along a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlurSize {
    /// Length of the path, px.
    pub path_px: f64,
    /// Diameter of the disc, px.
    pub disc_px: f64,
}

/// Distance of samples from each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spacing {
    /// Along a path, px. A row of samples has the mean and the variance of its path whatever their number, so that they may lie
    /// farther apart than on a disc, which they cover in two directions.
    pub path_px: f64,
    /// On a disc, px.
    pub disc_px: f64,
}

/// How many samples a blur wants: from 1, where both its parts are under half of their spacing, up to `limit`.
#[must_use]
pub fn samples_for(blur: BlurSize, spacing: Spacing, limit: usize) -> usize {
    let (length, disc) = (
        blur.path_px / spacing.path_px,
        blur.disc_px / spacing.disc_px,
    );
    let longest = length.max(disc);
    if longest.is_nan() || longest <= 0.5 {
        return 1;
    }
    // The area that is covered, with one row of samples where it is a line.
    let swept = disc * blur.path_px / spacing.disc_px;
    let count = length + swept + 0.25 * PI * disc * disc;
    (1 + count.ceil().min(limit as f64) as usize).min(limit.max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_samples_have_the_mean_and_the_covariance_of_an_exposure() {
        for count in 2..=96 {
            for turn in [0.0, 0.3, 0.77] {
                let taken = samples(count, turn);
                assert_eq!(taken.len(), count);
                let parts =
                    |s: &Sample| [s.moment * 12.0_f64.sqrt(), 2.0 * s.lens[0], 2.0 * s.lens[1]];
                let square = |i: usize, j: usize| mean(&taken, |s| parts(s)[i] * parts(s)[j]);
                for i in 0..3 {
                    let middle = mean(&taken, |s| parts(s)[i]);
                    assert!(middle.abs() < 1e-12, "{count}: mean {middle} of part {i}");
                    for j in (0..=i).filter(|_| count >= 4) {
                        let exact = f64::from(u8::from(i == j));
                        let is = square(i, j);
                        assert!((is - exact).abs() < 1e-9, "{count}: {is} of {i} and {j}");
                    }
                }
                let [time, lens] = [square(0, 0), square(1, 1) + square(2, 2)];
                assert!((time - 1.0).abs() < 1e-12 && (lens - 2.0).abs() < 1e-9);
            }
        }
    }

    /// Moments do not leave the exposure, and points hardly the lens.
    #[test]
    fn samples_lie_where_the_shutter_is_open_and_on_the_lens() {
        for count in 1..=96 {
            for sample in samples(count, 0.2) {
                assert!(sample.moment.abs() < 0.5, "{count}: {sample:?}");
                let radius = sample.lens[0].hypot(sample.lens[1]);
                assert!(radius < 1.02, "{count}: {radius}");
            }
        }
    }

    /// Early moments look through points as far out as late ones do.
    #[test]
    fn moments_and_distances_from_the_middle_are_not_correlated() {
        for count in 4..=40 {
            let taken = samples(count, 0.1);
            let radius = |s: &Sample| s.lens[0].hypot(s.lens[1]) - 2.0 / 3.0;
            let covariance = mean(&taken, |s| s.moment * radius(s));
            let correlation = covariance / ((1.0_f64 / 12.0).sqrt() * (1.0_f64 / 18.0).sqrt());
            assert!(correlation.abs() < 0.25, "{count}: {correlation}");
        }
    }

    #[test]
    fn the_number_of_samples_grows_with_the_blur() {
        let spacing = Spacing {
            path_px: 1.5,
            disc_px: 0.75,
        };
        let count =
            |path_px, disc_px, limit| samples_for(BlurSize { path_px, disc_px }, spacing, limit);
        assert_eq!(count(0.0, 0.0, 16), 1);
        assert_eq!(count(0.6, 0.3, 16), 1);
        assert_eq!(count(f64::NAN, 0.0, 16), 1);
        assert_eq!(count(6.0, 0.0, 16), 5);
        // A disc that is two spacings wide has the area of pi cells.
        assert_eq!(count(0.0, 1.5, 16), 5);
        // Beside a disc, its rows along the path lie as closely as it does.
        assert_eq!(count(6.0, 0.75, 64), 1 + 4 + 8 + 1);
        assert!(count(1e300, 1e300, 16) == 16);
    }
}
