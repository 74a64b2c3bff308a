//! Gradients against central differences in f64: four figures per input, all with limits.
//!
//! One step size, chosen beforehand. Cases are built so that no hard cut-off (alpha threshold, early stop, clamp, kink of an
//! absolute value) lies within a step of the point that is checked.

use crate::{noise, tensor, values};
use burn::tensor::{DType, Device, Tensor};
use std::fmt;

/// How far an analytic gradient is from a numeric one.
#[derive(Clone, Copy, Debug)]
pub struct GradReport {
    /// Largest absolute error of an entry, relative to the numeric gradient's largest entry.
    pub element: f64,
    /// Where that is.
    pub at: usize,
    /// L2 norm of the error, relative to the numeric gradient's.
    pub l2: f64,
    /// 1 − cosine of the angle between the two.
    pub angle: f64,
    /// Mean signed error, relative to the numeric gradient's mean magnitude: what a systematic fault leaves where
    /// random errors cancel.
    pub bias: f64,
}

impl GradReport {
    /// The figures of an analytic gradient against a numeric one of the same length, which is not zero everywhere.
    #[must_use]
    pub fn new(analytic: &[f64], numeric: &[f64]) -> Self {
        let dot = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        let error: Vec<f64> = analytic.iter().zip(numeric).map(|(a, n)| a - n).collect();
        let largest = numeric.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        // A NaN counts as the largest.
        let magnitude = |k: usize| {
            if error[k].is_nan() {
                f64::INFINITY
            } else {
                error[k].abs()
            }
        };
        let at =
            (0..error.len()).fold(0, |at, k| if magnitude(k) > magnitude(at) { k } else { at });
        let norm = dot(numeric, numeric).sqrt();
        let total: f64 = numeric.iter().map(|v| v.abs()).sum();
        Self {
            element: error[at].abs() / largest,
            at,
            l2: dot(&error, &error).sqrt() / norm,
            angle: 1.0 - dot(analytic, numeric) / (dot(analytic, analytic).sqrt() * norm),
            bias: error.iter().sum::<f64>() / total,
        }
    }

    /// Whether all four figures are within the limits; one that is not a number is not.
    #[must_use]
    pub fn within(&self, limits: &GradLimits) -> bool {
        self.element <= limits.element
            && self.l2 <= limits.l2
            && self.angle <= limits.angle
            && self.bias.abs() <= limits.bias
    }
}

impl fmt::Display for GradReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "largest element error {:.1e} at {}, relative L2 {:.1e}, 1 - cosine {:.1e}, bias {:.1e}",
            self.element, self.at, self.l2, self.angle, self.bias
        )
    }
}

/// Limits on the figures of a [`GradReport`], and the step of the central differences.
#[derive(Clone, Copy, Debug)]
pub struct GradLimits {
    /// On [`GradReport::element`].
    pub element: f64,
    /// On [`GradReport::l2`].
    pub l2: f64,
    /// On [`GradReport::angle`].
    pub angle: f64,
    /// On [`GradReport::bias`], of either sign.
    pub bias: f64,
    /// Step of the central difference.
    pub step: f64,
}

impl Default for GradLimits {
    /// At a step of 1e-6 truncation and rounding both leave some 1e-9 of an ordinary gradient.
    fn default() -> Self {
        Self {
            element: 1e-6,
            l2: 1e-6,
            angle: 1e-10,
            bias: 1e-7,
            step: 1e-6,
        }
    }
}

/// Checks the gradient of a scalar function of named f64 matrices against central differences, and
/// returns the figures of every input.
///
/// `f` gets the inputs (f64, on an autodiff device, in the given order) and returns a tensor of
/// shape `[1]`. Every entry of every input is perturbed by itself. A numeric gradient that is zero
/// everywhere fails the check, unless the analytic one is zero too and `allow_zero` names the input;
/// such an input has no figures.
///
/// # Panics
/// Panics, naming the input and the figures, when a limit is exceeded.
pub fn check_gradients(
    device: &Device,
    inputs: &[(&str, [usize; 2], Vec<f64>)],
    allow_zero: &[&str],
    limits: GradLimits,
    f: impl Fn(&[Tensor<2>]) -> Tensor<1>,
) -> Vec<(String, GradReport)> {
    let device = device.clone().autodiff();
    let leaves = |values: &[Vec<f64>]| -> Vec<Tensor<2>> {
        let shapes = inputs.iter().map(|(_, shape, _)| *shape);
        let leaf =
            |(v, shape): (&Vec<f64>, _)| tensor(v, shape, &device, DType::F64).require_grad();
        values.iter().zip(shapes).map(leaf).collect()
    };
    let start: Vec<Vec<f64>> = inputs.iter().map(|(_, _, v)| v.clone()).collect();
    let scalar = |values: &[Vec<f64>]| -> f64 { f(&leaves(values)).into_scalar::<f64>() };

    let at_start = leaves(&start);
    let grads = f(&at_start).backward();
    let mut reports = Vec::new();
    for (index, (name, _, entries)) in inputs.iter().enumerate() {
        let analytic = at_start[index]
            .grad(&grads)
            .map_or_else(|| vec![0.0; entries.len()], values);
        let mut moved = start.clone();
        let numeric: Vec<f64> = (0..entries.len())
            .map(|k| {
                let mut at = |step: f64| {
                    moved[index][k] = entries[k] + step;
                    scalar(&moved)
                };
                let difference = at(limits.step) - at(-limits.step);
                moved[index][k] = entries[k];
                difference / (2.0 * limits.step)
            })
            .collect();
        if numeric.iter().all(|v| *v == 0.0) {
            let zero = analytic.iter().all(|v| *v == 0.0);
            assert!(
                allow_zero.contains(name) && zero,
                "numeric gradient of {name} is zero everywhere; the analytic one {}",
                if zero {
                    "too: the check says nothing"
                } else {
                    "is not"
                }
            );
            continue;
        }
        let report = GradReport::new(&analytic, &numeric);
        assert!(
            report.within(&limits),
            "gradient of {name}: {report} (analytic {:.9e}, numeric {:.9e})",
            analytic[report.at],
            numeric[report.at],
        );
        reports.push(((*name).to_owned(), report));
    }
    reports
}

/// Central differences of `f` along `count` random directions of unit length, and what `gradient` says about them.
///
/// For functions of too many numbers to perturb each. `f` gets the displacement, as long as `gradient`; the figures are those of
/// the slopes along the directions.
pub fn directional_report(
    gradient: &[f64],
    count: usize,
    step: f64,
    seed: u64,
    mut f: impl FnMut(&[f64]) -> f64,
) -> GradReport {
    let (analytic, numeric): (Vec<f64>, Vec<f64>) = (0..count as u64)
        .map(|k| {
            let mut direction = noise(gradient.len(), seed + 1000 * k);
            let norm = direction.iter().map(|v| v * v).sum::<f64>().sqrt();
            direction.iter_mut().for_each(|v| *v /= norm);
            let slope: f64 = gradient.iter().zip(&direction).map(|(g, d)| g * d).sum();
            let mut at = |step: f64| f(&direction.iter().map(|d| d * step).collect::<Vec<_>>());
            (slope, (at(step) - at(-step)) / (2.0 * step))
        })
        .unzip();
    GradReport::new(&analytic, &numeric)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_figure_sees_its_fault() {
        let numeric = [1.0, -2.0, 3.0, -4.0];
        let limits = GradLimits::default();
        let report = |f: &dyn Fn(usize, f64) -> f64| {
            let analytic: Vec<f64> = numeric.iter().enumerate().map(|(k, v)| f(k, *v)).collect();
            GradReport::new(&analytic, &numeric)
        };
        let right = report(&|_, v| v);
        assert!(right.within(&limits) && right.element == 0.0, "{right}");
        // A wrong entry.
        let one = report(&|k, v| if k == 2 { v + 0.04 } else { v });
        assert!((one.element - 0.01).abs() < 1e-12 && one.at == 2, "{one}");
        assert!((one.l2 - 0.04 / 30.0_f64.sqrt()).abs() < 1e-12, "{one}");
        assert!((one.bias - 0.004).abs() < 1e-12, "{one}");
        assert!(one.angle > 1e-6, "{one}");
        // A factor leaves the direction as it is, the opposite direction does not.
        let twice = report(&|_, v| 2.0 * v);
        assert!(
            twice.angle.abs() < 1e-12 && (twice.l2 - 1.0).abs() < 1e-12,
            "{twice}"
        );
        assert!((report(&|_, v| -v).angle - 2.0).abs() < 1e-12);
        for broken in [f64::NAN, f64::INFINITY] {
            let broken = report(&|k, v| if k == 3 { broken } else { v });
            assert!(!broken.within(&limits) && broken.at == 3, "{broken}");
        }
    }

    #[test]
    fn directions_of_a_quadratic() {
        // f(x) = Σ k x² at x = 1: the gradient is 2 k.
        let gradient: Vec<f64> = (0..50).map(|k| 2.0 * f64::from(k)).collect();
        let f = |moved: &[f64]| -> f64 {
            let term = |(k, m): (usize, &f64)| k as f64 * (1.0 + m) * (1.0 + m);
            moved.iter().enumerate().map(term).sum()
        };
        let right = directional_report(&gradient, 8, 1e-5, 1, f);
        assert!(right.element < 1e-8 && right.l2 < 1e-8, "{right}");
        let mut wrong = gradient;
        wrong[49] = 0.0;
        assert!(directional_report(&wrong, 8, 1e-5, 1, f).l2 > 1e-2);
    }
}
