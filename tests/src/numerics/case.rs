//! One input of one op, and what f32 costs there.

use crate::{noise, tensor};
use burn::tensor::{DType, Device, Tensor};

/// Named arrays.
pub type Arrays = Vec<(&'static str, Vec<f64>)>;

/// Where an op runs, and in which float type.
#[derive(Clone, Debug)]
pub enum Place {
    /// On the CPU, in the type that training uses.
    F32,
    /// On the CPU: the reference.
    F64,
    /// On a device, in f32.
    Device(Device),
}

impl Place {
    /// What tensors that have gradients are made with.
    pub(super) fn options(&self) -> (Device, DType) {
        let (device, dtype) = match self {
            Self::F32 => (Device::flex(), DType::F32),
            Self::F64 => (Device::flex(), DType::F64),
            Self::Device(device) => (device.clone(), DType::F32),
        };
        (device.autodiff(), dtype)
    }
}

/// What an op gives, and the gradients of its inputs for a fixed, random gradient of its outputs.
#[derive(Debug, Default)]
pub struct Results {
    /// Outputs by name.
    pub forward: Arrays,
    /// Gradients by the inputs' names.
    pub backward: Arrays,
}

/// How a case runs on given inputs.
pub(super) type Run = Box<dyn Fn(&[Vec<f64>], &Place) -> Results>;

/// One input of one op.
pub struct Case {
    /// The op.
    pub op: &'static str,
    /// What is extreme about the input.
    pub name: String,
    /// The inputs, rounded to f32.
    pub(super) inputs: Vec<Vec<f64>>,
    pub(super) run: Run,
}

impl std::fmt::Debug for Case {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, {}", self.op, self.name)
    }
}

impl Case {
    pub(super) fn new(
        op: &'static str,
        name: impl Into<String>,
        inputs: Vec<Vec<f64>>,
        run: impl Fn(&[Vec<f64>], &Place) -> Results + 'static,
    ) -> Self {
        let rounded = |v: f64| f64::from(v as f32);
        Self {
            op,
            name: name.into(),
            inputs: inputs
                .into_iter()
                .map(|array| array.into_iter().map(rounded).collect())
                .collect(),
            run: Box::new(run),
        }
    }
}

/// Errors of f32 in one direction of a case.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Largest absolute error of any entry of any array.
    pub absolute: f64,
    /// Largest error of an array relative to its largest entry, or to 1e-6 where that is smaller.
    pub relative: f64,
    /// Largest error of an array as a share of what is promised; at most 1.
    pub of_promise: f64,
}

/// What a case came to.
#[derive(Clone, Debug)]
pub struct Row {
    /// The op.
    pub op: String,
    /// The case.
    pub name: String,
    /// The outputs.
    pub forward: Figures,
    /// The gradients.
    pub backward: Figures,
}

/// Runs a case in f32 there, and in f64.
///
/// # Panics
/// Panics if a result is not finite.
#[must_use]
pub fn measure(case: &Case, place: &Place) -> Row {
    let f32_results = (case.run)(&case.inputs, place);
    let exact = (case.run)(&case.inputs, &Place::F64);
    let moved: Vec<Results> = (0..4)
        .map(|draw| (case.run)(&moved_by_one_ulp(&case.inputs, draw), &Place::F64))
        .collect();
    let figures = |of: fn(&Results) -> &Arrays| {
        let mut figures = Figures::default();
        for (k, (name, exact)) in of(&exact).iter().enumerate() {
            let found = &of(&f32_results)[k].1;
            assert!(
                found.iter().chain(exact).all(|v| v.is_finite()),
                "{case:?}: {name} is not finite"
            );
            let error = largest_difference(found, exact);
            let spread = moved.iter().map(|m| largest_difference(&of(m)[k].1, exact));
            let spread = spread.fold(0.0, f64::max);
            let largest = exact.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
            let promise = 8.0 * spread + 1e-6 * largest.max(1.0);
            figures.absolute = figures.absolute.max(error);
            // What is zero but for rounding has no relative error.
            figures.relative = figures.relative.max(error / largest.max(1e-6));
            figures.of_promise = figures.of_promise.max(error / promise);
        }
        figures
    };
    Row {
        op: case.op.to_owned(),
        name: case.name.clone(),
        forward: figures(|r| &r.forward),
        backward: figures(|r| &r.backward),
    }
}

/// Every number one unit in the last place of f32 up or down, at random.
fn moved_by_one_ulp(inputs: &[Vec<f64>], draw: u64) -> Vec<Vec<f64>> {
    inputs
        .iter()
        .enumerate()
        .map(|(k, array)| {
            let signs = noise(array.len(), 1 + draw + 10 * k as u64);
            let moved = array.iter().zip(signs).map(|(v, sign)| {
                let v = *v as f32;
                f64::from(if sign > 0.0 {
                    v.next_up()
                } else {
                    v.next_down()
                })
            });
            moved.collect()
        })
        .collect()
}

/// A sum with fixed random weights that f32 holds.
pub(super) fn weigh<const D: usize>(x: Tensor<D>, seed: u64) -> Tensor<1> {
    let shape = x.dims();
    let weights = noise(shape.iter().product(), seed);
    let rounded: Vec<f64> = weights.iter().map(|v| f64::from(*v as f32)).collect();
    (x.clone() * tensor(&rounded, shape, &x.device(), x.dtype())).sum()
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "arrays of one case");
    a.iter().zip(b).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

/// Noise scaled and shifted.
pub(super) fn scaled(count: usize, seed: u64, scale: f64, shift: f64) -> Vec<f64> {
    noise(count, seed)
        .iter()
        .map(|v| v * scale + shift)
        .collect()
}
