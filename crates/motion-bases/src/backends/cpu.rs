//! Backends whose tensors lie in main memory share the kernel of [`crate::cpu`].

use burn::backend::{TensorMetadata as _, tensor::FloatTensor};
use host::{HostBackend, HostFloat, tensor, with_float};

use crate::backends::fit::fit_slope_on;
use crate::cpu::moved::{Inputs, moved};
use crate::cpu::moved_backward::moved_backward;
use crate::fit_data::FitStep;
use crate::ops::{FitSlope, MotionBackwardOps, MotionOps};

macro_rules! host_ops {
    ($backend:ty) => {
        impl MotionOps for $backend {
            fn moved(
                coefficients: FloatTensor<Self>,
                bases: FloatTensor<Self>,
                means: FloatTensor<Self>,
            ) -> FloatTensor<Self> {
                with_float!(means.dtype(), T => moved_on::<T, Self>([coefficients, bases, means]))
            }

            fn fit(
                rots: FloatTensor<Self>,
                transls: FloatTensor<Self>,
                coefficients: FloatTensor<Self>,
                means: FloatTensor<Self>,
                step: FitStep,
            ) -> FloatTensor<Self> {
                Self::fit_slope([rots, transls, coefficients, means], &step).0
            }
        }

        impl MotionBackwardOps for $backend {
            fn moved_backward(
                inputs: [FloatTensor<Self>; 3],
                gradient: FloatTensor<Self>,
                wanted: [bool; 3],
            ) -> [Option<FloatTensor<Self>>; 3] {
                with_float!(gradient.dtype(), T => moved_backward_on::<T, Self>(inputs, gradient, wanted))
            }

            fn fit_slope(inputs: [FloatTensor<Self>; 4], step: &FitStep) -> FitSlope<Self> {
                with_float!(inputs[0].dtype(), T => fit_slope_on::<T, Self>(inputs, step))
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

/// Calls `run` with the inputs as slices.
fn with_inputs<T: HostFloat, B: HostBackend, R>(
    tensors: &mut [FloatTensor<B>; 3],
    run: impl FnOnce(&Inputs<'_, T>) -> R,
) -> R {
    let [coefficients, bases, means] = tensors.each_mut().map(B::elements::<T>);
    run(&Inputs {
        coefficients: &coefficients,
        bases: &bases,
        means: &means,
    })
}

fn moved_on<T: HostFloat, B: HostBackend>(mut tensors: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    let output = with_inputs::<T, B, _>(&mut tensors, moved);
    let length = output.len();
    tensor::<T, B>(output, [length], &tensors[2])
}

fn moved_backward_on<T: HostFloat, B: HostBackend>(
    mut tensors: [FloatTensor<B>; 3],
    mut gradient: FloatTensor<B>,
    wanted: [bool; 3],
) -> [Option<FloatTensor<B>>; 3] {
    let gradients = with_inputs::<T, B, _>(&mut tensors, |inputs| {
        moved_backward(inputs, &B::elements::<T>(&mut gradient))
    });
    let mut all = gradients.into_iter().zip(wanted);
    tensors.map(|like| {
        let (values, wanted) = all.next().expect("a gradient for every input");
        wanted.then(|| tensor::<T, B>(values, like.shape(), &like))
    })
}
