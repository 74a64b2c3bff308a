//! The first fit on any backend: in main memory.

use burn::backend::{TensorMetadata as _, tensor::FloatTensor};
use host::{HostBackend, HostFloat, tensor};

use crate::cpu::fit::{Fitted, fit};
use crate::fit_data::FitStep;
use crate::ops::FitSlope;

pub(super) fn fit_slope_on<T: HostFloat, B: HostBackend>(
    mut inputs: [FloatTensor<B>; 4],
    step: &FitStep,
) -> FitSlope<B> {
    let slope = {
        let [rots, transls, coefficients, means] = inputs.each_mut().map(B::elements::<T>);
        fit(
            &Fitted {
                rots: &rots,
                transls: &transls,
                coefficients: &coefficients,
                means: &means,
            },
            step,
        )
    };
    let loss = tensor::<T, B>(vec![slope.loss], [1], &inputs[0]);
    let mut gradients = slope.gradients.into_iter();
    let gradients = inputs.map(|like| {
        let values = gradients.next().expect("a gradient for every input");
        tensor::<T, B>(values, like.shape(), &like)
    });
    (loss, gradients)
}
