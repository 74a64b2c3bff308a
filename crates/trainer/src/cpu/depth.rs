//! What a rendered depth is compared with: the given one, after the estimator's scale and shift are taken out.

use host::Real;

/// Pixels with a rendered alpha up to this have no depth worth comparing.
pub(crate) const OPAQUE: f64 = 0.5;

/// Depths below this part of the scene size count as this much before they are inverted.
pub(crate) const NEAREST: f64 = 0.05;

/// Below this many pixels no scale and shift are fitted.
pub(crate) const FEWEST: usize = 32;

/// More pixels than this do not make the fit better: an even sample is taken.
pub(crate) const SAMPLE: usize = 8192;

/// A fit with a scale beyond this factor, either way, is not believed.
pub(crate) const LARGEST_SCALE: f64 = 2.0;

/// Residuals well under this, in disparity times S, weigh in full; far above it pixels hardly count (Cauchy's weights).
pub(crate) const TOLERANCE: f64 = 0.02;

/// How often the weights are found anew.
pub(crate) const ROUNDS: usize = 10;

/// The disparity that an estimator should have given is `scale * given + shift`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DisparityFit {
    /// Factor.
    pub scale: f64,
    /// Added after it, in the disparity's unit.
    pub shift: f64,
}

impl DisparityFit {
    /// Leaves disparities as they are.
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        shift: 0.0,
    };
}

/// Robust scale and shift that bring `given` to `wanted`, disparities times the scene size S of the same pixels.
///
/// Weighted means and standard deviations of both are made equal (closed form, and symmetric: least squares would shrink
/// the scene's relief a little every time it is asked), with weights 1 / (1 + (residual / 0.02)²) from the fit before.
/// With fewer than 32 pixels, without relief (constant depth), where the two do not go together (correlation under a half)
/// or if the scale leaves [0.5, 2], nothing can be learned: [`DisparityFit::IDENTITY`].
///
/// # Panics
/// Panics if the lengths differ.
#[must_use]
pub fn fit_disparity(given: &[f64], wanted: &[f64]) -> DisparityFit {
    assert_eq!(given.len(), wanted.len(), "disparities of the same pixels");
    if given.len() < FEWEST {
        return DisparityFit::IDENTITY;
    }
    let stride = given.len().div_ceil(SAMPLE);
    let pairs = || given.iter().zip(wanted).step_by(stride);
    let mut fit = DisparityFit::IDENTITY;
    for _ in 0..ROUNDS {
        let weight = |x: f64, y: f64| {
            let residual = (y - fit.scale * x - fit.shift) / TOLERANCE;
            1.0 / (1.0 + residual * residual)
        };
        let (mut sum, mut mean_x, mut mean_y) = (0.0, 0.0, 0.0);
        for (x, y) in pairs() {
            let w = weight(*x, *y);
            sum += w;
            mean_x += w * x;
            mean_y += w * y;
        }
        (mean_x, mean_y) = (mean_x / sum, mean_y / sum);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (x, y) in pairs() {
            let (w, x, y) = (weight(*x, *y), x - mean_x, y - mean_y);
            xx += w * x * x;
            xy += w * x * y;
            yy += w * y * y;
        }
        // A relative spread under a thousandth of the disparity is rounding, not relief.
        let flat = xx <= 1e-6 * sum * mean_x * mean_x || yy <= 1e-6 * sum * mean_y * mean_y;
        let scale = (yy / xx).sqrt();
        if flat
            || xy < 0.5 * (xx * yy).sqrt()
            || !(1.0 / LARGEST_SCALE..=LARGEST_SCALE).contains(&scale)
        {
            return DisparityFit::IDENTITY;
        }
        fit = DisparityFit {
            scale,
            shift: mean_y - scale * mean_x,
        };
    }
    fit
}

/// What a rendered `depth` and `alpha` [H, W] are compared with: 1 / alpha, the disparity wanted, and the weight of every pixel,
/// zero where one does not count.
pub(crate) fn depth_targets<T: Real>(
    depth: &[T],
    alpha: &[T],
    given: &[T],
    scene_size: f64,
) -> [Vec<T>; 3] {
    let nearest = NEAREST * scene_size;
    let disparity = |depth: f64| scene_size / depth.max(nearest);
    let counted: Vec<usize> = (0..given.len())
        .filter(|k| {
            let given = given[*k].to_f64();
            alpha[*k].to_f64() > OPAQUE && given > 0.0 && given.is_finite()
        })
        .collect();
    let known: Vec<f64> = counted
        .iter()
        .map(|k| disparity(given[*k].to_f64()))
        .collect();
    let rendered: Vec<f64> = counted
        .iter()
        .map(|k| disparity(depth[*k].to_f64() / alpha[*k].to_f64()))
        .collect();
    let fit = fit_disparity(&known, &rendered);

    let mut targets = [(); 3].map(|()| vec![T::ZERO; given.len()]);
    for (k, known) in counted.iter().zip(&known) {
        targets[0][*k] = T::of(1.0 / alpha[*k].to_f64());
        targets[1][*k] = T::of(fit.scale * known + fit.shift);
        targets[2][*k] = T::of(1.0 / counted.len() as f64);
    }
    targets
}

#[cfg(test)]
mod tests {
    use super::*;

    fn relief(pixels: usize) -> Vec<f64> {
        (0..pixels)
            .map(|k| 1.0 + 0.6 * (k as f64 * 0.37).sin())
            .collect()
    }

    #[test]
    fn scale_and_shift_are_found_among_outliers() {
        let given = relief(30_000);
        for (scale, shift) in [(1.0, 0.0), (1.03, -0.02), (0.8, 0.3), (1.5, -0.1)] {
            let wanted: Vec<f64> = given
                .iter()
                .enumerate()
                .map(|(k, x)| {
                    // A fifth of the pixels show something else.
                    if (k / 7) % 5 == 0 {
                        4.0 + (k as f64 * 0.11).sin()
                    } else {
                        scale * x + shift
                    }
                })
                .collect();
            let fit = fit_disparity(&given, &wanted);
            assert!(
                (fit.scale - scale).abs() < 0.02 * scale && (fit.shift - shift).abs() < 0.02,
                "{fit:?} for {scale} and {shift}"
            );
        }
    }

    #[test]
    fn noise_does_not_flatten_the_relief() {
        let given: Vec<f64> = relief(5000)
            .iter()
            .enumerate()
            .map(|(k, x)| x + 0.2 * (k as f64 * 2.39).sin())
            .collect();
        let wanted: Vec<f64> = relief(5000)
            .iter()
            .enumerate()
            .map(|(k, x)| x + 0.2 * (k as f64 * 1.13).cos())
            .collect();
        let fit = fit_disparity(&given, &wanted);
        assert!((fit.scale - 1.0).abs() < 0.03, "{fit:?}");
    }

    #[test]
    fn where_nothing_can_be_learned_nothing_is_changed() {
        let same = |given: &[f64], wanted: &[f64]| {
            assert_eq!(fit_disparity(given, wanted), DisparityFit::IDENTITY);
        };
        let relief = relief(1000);
        same(&[], &[]);
        same(
            &relief[..31],
            &relief[..31].iter().map(|x| 1.1 * x).collect::<Vec<_>>(),
        );
        same(&[2.0; 1000], &relief);
        same(&relief, &[2.0; 1000]);
        same(&relief, &relief.iter().map(|x| -x).collect::<Vec<_>>());
        same(&relief, &relief.iter().map(|x| 5.0 * x).collect::<Vec<_>>());
    }
}
