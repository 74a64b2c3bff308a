//! GPUs, by the kernels of [`crate::cube`].

use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{cubes, empty, flat, units};

use crate::backends::fit::fit_slope_on;
use crate::cube::moved::{BASIS, moved_kernel, weights_kernel};
use crate::cube::moved_backward::{TEAM, bases_backward_kernel, rows_backward_kernel};
use crate::fit_data::FitStep;
use crate::ops::{FitSlope, MotionBackwardOps, MotionOps};

/// Softmax weights, bases and means.
struct Inputs {
    weights: CubeTensor,
    bases: CubeTensor,
    means: CubeTensor,
    /// Numbers of Gaussians, bases and moments.
    rows: usize,
    count: usize,
    moments: usize,
}

impl Inputs {
    fn new([coefficients, bases, means]: [CubeTensor; 3]) -> Self {
        let [coefficients, bases, means] = [coefficients, bases, means].map(flat);
        let (rows, count) = (means.meta.shape()[0], coefficients.meta.shape()[1]);
        let moments = bases.meta.num_elements() / (BASIS * count);
        let weights = empty(&means, [rows, count], DType::F32);
        let (cubes, dim) = units(&means.client, rows);
        weights_kernel::launch(
            &means.client,
            cubes,
            dim,
            coefficients.into_buffer_arg(),
            weights.clone().into_buffer_arg(),
            count,
        );
        Self {
            weights,
            bases,
            means,
            rows,
            count,
            moments,
        }
    }
}

impl MotionOps for CubeBackend {
    fn moved(
        coefficients: FloatTensor<Self>,
        bases: FloatTensor<Self>,
        means: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let inputs = Inputs::new([coefficients, bases, means]);
        let all = inputs.moments * inputs.rows;
        let output = empty(&inputs.means, [all * 12], DType::F32);
        let client = inputs.means.client.clone();
        let (cubes, dim) = units(&client, all);
        moved_kernel::launch(
            &client,
            cubes,
            dim,
            inputs.weights.into_buffer_arg(),
            inputs.bases.into_buffer_arg(),
            inputs.means.into_buffer_arg(),
            output.clone().into_buffer_arg(),
            inputs.count,
        );
        output
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

impl MotionBackwardOps for CubeBackend {
    fn moved_backward(
        inputs: [FloatTensor<Self>; 3],
        gradient: FloatTensor<Self>,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3] {
        let inputs = Inputs::new(inputs);
        let (rows, count, moments) = (inputs.rows, inputs.count, inputs.moments);
        let client = inputs.means.client.clone();
        let of = |shape: &[usize]| empty(&inputs.means, shape, DType::F32);
        let blends = of(&[rows, moments * BASIS]);
        let v_logits = of(&[rows, count]);
        let v_means = of(&[rows, 3]);
        let v_bases = of(inputs.bases.meta.shape());
        let (number, dim) = units(&client, rows);
        rows_backward_kernel::launch(
            &client,
            number,
            dim,
            inputs.weights.clone().into_buffer_arg(),
            inputs.bases.into_buffer_arg(),
            inputs.means.into_buffer_arg(),
            flat(gradient).into_buffer_arg(),
            blends.clone().into_buffer_arg(),
            v_logits.clone().into_buffer_arg(),
            v_means.clone().into_buffer_arg(),
            count,
        );
        if wanted[1] {
            let (number, dim) = cubes(&client, count * moments, TEAM);
            bases_backward_kernel::launch(
                &client,
                number,
                dim,
                inputs.weights.into_buffer_arg(),
                blends.into_buffer_arg(),
                v_bases.clone().into_buffer_arg(),
                count,
            );
        }
        let [of_logits, of_bases, of_means] = wanted;
        [
            of_logits.then_some(v_logits),
            of_bases.then_some(v_bases),
            of_means.then_some(v_means),
        ]
    }

    fn fit_slope(inputs: [FloatTensor<Self>; 4], step: &FitStep) -> FitSlope<Self> {
        fit_slope_on::<f32, Self>(inputs, step)
    }
}
