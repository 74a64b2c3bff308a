//! Gradients against central differences in f64.

use burn::tensor::{DType, Device, Tensor, TensorData};

/// Limits on the disagreement between an analytic and a numeric gradient of one input.
#[derive(Clone, Copy, Debug)]
pub struct GradLimits {
    /// Largest absolute error, relative to the numeric gradient's largest entry.
    pub element: f64,
    /// Relative L2 error of the whole tensor.
    pub l2: f64,
    /// Step of the central difference.
    pub step: f64,
}

impl Default for GradLimits {
    fn default() -> Self {
        Self {
            element: 1e-5,
            l2: 1e-5,
            step: 1e-5,
        }
    }
}

/// Checks the gradient of a scalar function of named f64 matrices against central differences.
///
/// `f` gets the inputs (f64, on an autodiff device, in the given order) and returns a tensor of
/// shape [1]. Every entry of every input is perturbed by itself. A numeric gradient that is zero
/// everywhere fails the check, unless the analytic one is zero too and `allow_zero` names the input.
///
/// # Panics
/// Panics, naming the input and the figures, when a limit is exceeded.
pub fn check_gradients(
    device: &Device,
    inputs: &[(&str, [usize; 2], Vec<f64>)],
    allow_zero: &[&str],
    limits: GradLimits,
    f: impl Fn(&[Tensor<2>]) -> Tensor<1>,
) {
    let device = device.clone().autodiff();
    let tensors = |values: &[Vec<f64>]| -> Vec<Tensor<2>> {
        inputs
            .iter()
            .zip(values)
            .map(|((_, shape, _), v)| {
                Tensor::<2>::from_data(TensorData::new(v.clone(), *shape), (&device, DType::F64))
                    .require_grad()
            })
            .collect()
    };
    let start: Vec<Vec<f64>> = inputs.iter().map(|(_, _, v)| v.clone()).collect();
    let scalar = |values: &[Vec<f64>]| -> f64 { f(&tensors(values)).into_scalar::<f64>() };

    let leaves = tensors(&start);
    let grads = f(&leaves).backward();
    for (index, (name, _, values)) in inputs.iter().enumerate() {
        let analytic: Vec<f64> = leaves[index].grad(&grads).map_or_else(
            || vec![0.0; values.len()],
            |g| g.into_data().try_to_vec::<f64>().expect("an f64 gradient"),
        );
        let numeric: Vec<f64> = (0..values.len())
            .map(|k| {
                let mut moved = start.clone();
                moved[index][k] = values[k] + limits.step;
                let plus = scalar(&moved);
                moved[index][k] = values[k] - limits.step;
                (plus - scalar(&moved)) / (2.0 * limits.step)
            })
            .collect();
        let largest = numeric.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let norm = numeric.iter().map(|v| v * v).sum::<f64>().sqrt();
        let (mut worst, mut at, mut square) = (0.0_f64, 0, 0.0);
        for (k, (a, n)) in analytic.iter().zip(&numeric).enumerate() {
            assert!(a.is_finite(), "gradient of {name}[{k}] is {a}");
            square += (a - n) * (a - n);
            if (a - n).abs() > worst {
                (worst, at) = ((a - n).abs(), k);
            }
        }
        if allow_zero.contains(name) && largest == 0.0 {
            assert!(
                worst == 0.0,
                "gradient of {name} should be zero, is {worst} at {at}"
            );
            continue;
        }
        assert!(
            largest > 0.0,
            "numeric gradient of {name} is zero everywhere: the check says nothing"
        );
        assert!(
            worst <= limits.element * largest && square.sqrt() <= limits.l2 * norm,
            "gradient of {name}: worst error {worst:.3e} at {at} (analytic {:.9e}, numeric {:.9e}), largest entry {largest:.3e}, relative L2 {:.3e}",
            analytic[at],
            numeric[at],
            square.sqrt() / norm,
        );
    }
}
