//! Launches of the products.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{cubes, empty, units};

use crate::cube::product::{
    End, MOST, Plan, Rows, SIDE, Tiles, outer_kernel, product_kernel, sum_kernel,
};

/// Cubes that a GPU should have to do at least, and pixels that a part of a sum over them should have at least.
const ENOUGH: usize = 512;
const LEAST: usize = 256;

/// Rows of pixels, in one buffer or in two.
#[derive(Clone, Debug)]
pub(super) struct Pixels {
    pub(super) values: CubeTensor,
    pub(super) joined: Option<CubeTensor>,
    pub(super) rows: Rows,
    /// Height and width.
    pub(super) size: [usize; 2],
}

impl Pixels {
    /// Each pixel by itself.
    pub(super) fn plain(values: CubeTensor, channels: usize, size: [usize; 2]) -> Self {
        let rows = Rows {
            kernel: 1,
            channels,
            joined: 0,
        };
        Self {
            values,
            joined: None,
            rows,
            size,
        }
    }

    fn number(&self) -> usize {
        self.size[0] * self.size[1]
    }

    /// Something stands where nothing is read.
    fn buffers(&self) -> [CubeTensor; 2] {
        let joined = self.joined.as_ref().unwrap_or(&self.values);
        [self.values.clone(), joined.clone()]
    }

    /// Times a weight `[taps, outputs]`, plus a bias, then ReLU if wanted: `[pixels, outputs]`.
    pub(super) fn layer(
        &self,
        weight: &CubeTensor,
        bias: &CubeTensor,
        outputs: usize,
        relu: bool,
    ) -> CubeTensor {
        let output = empty(weight, [self.number(), outputs], DType::F32);
        let plan = Plan {
            rows: self.rows,
            outputs,
            mirrored: false,
            inputs: 0,
            first: 0,
            end: if relu { End::Relu } else { End::Bias },
        };
        self.product(weight, bias, &output, plan);
        output
    }

    /// These are gradients of a layer's outputs: the gradient of `outputs` of its `inputs` channels, from `first` on.
    pub(super) fn back(
        &self,
        weight: &CubeTensor,
        [inputs, first, outputs]: [usize; 3],
        target: Target<'_>,
    ) -> CubeTensor {
        let (output, other, end) = match target {
            Target::New => (None, weight, End::Plain),
            Target::Masked(mask) => (None, mask, End::Masked),
            Target::Added(sum) => (Some(sum.clone()), weight, End::Added),
        };
        let output = output.unwrap_or_else(|| empty(weight, [self.number(), outputs], DType::F32));
        let plan = Plan {
            rows: self.rows,
            outputs,
            mirrored: true,
            inputs,
            first,
            end,
        };
        self.product(weight, other, &output, plan);
        output
    }

    fn product(&self, weight: &CubeTensor, other: &CubeTensor, output: &CubeTensor, plan: Plan) {
        if self.number() == 0 {
            return;
        }
        let across = Tiles::new(plan.outputs);
        let down = self.number().div_ceil(SIDE * MOST);
        let [values, joined] = self.buffers();
        let (count, dim) = cubes(&weight.client, down * across.count, SIDE * SIDE);
        product_kernel::launch(
            &weight.client,
            count,
            dim,
            values.into_buffer_arg(),
            joined.into_buffer_arg(),
            weight.clone().into_buffer_arg(),
            other.clone().into_buffer_arg(),
            output.clone().into_buffer_arg(),
            self.size[0],
            self.size[1],
            plan,
            across,
        );
    }

    /// Sums over the pixels of their rows times `gradient` `[pixels, outputs]`, and of the gradient itself: of the first `own`
    /// outputs, weight `[taps, own]` and bias `[1, own]`, and then of the others.
    pub(super) fn sums(
        &self,
        gradient: &CubeTensor,
        outputs: usize,
        own: usize,
    ) -> [CubeTensor; 4] {
        let taps = self.rows.taps();
        let [down, across] = [taps + 1, outputs].map(Tiles::new);
        let tiles = down.count * across.count;
        let wanted = (self.number() / LEAST).clamp(1, (ENOUGH / tiles).max(1));
        let per_part = self.number().div_ceil(wanted).next_multiple_of(SIDE);
        let number = if per_part == 0 {
            0
        } else {
            self.number().div_ceil(per_part)
        };
        let of = |shape: [usize; 2]| {
            let shape = if shape[1] == 0 { [1, 1] } else { shape };
            empty(gradient, shape, DType::F32)
        };
        let client = &gradient.client;
        let parts = of([number.max(1) * (taps + 1), outputs]);
        if number > 0 {
            let [values, joined] = self.buffers();
            let (count, dim) = cubes(client, number * tiles, SIDE * SIDE);
            outer_kernel::launch(
                client,
                count,
                dim,
                values.into_buffer_arg(),
                joined.into_buffer_arg(),
                gradient.clone().into_buffer_arg(),
                parts.clone().into_buffer_arg(),
                self.size[0],
                self.size[1],
                per_part,
                self.rows,
                outputs,
                down,
                across,
            );
        }
        let others = outputs - own;
        let all = [
            of([taps, own]),
            of([1, own]),
            of([taps, others]),
            of([1, others]),
        ];
        let [weight, bias, other_weight, other_bias] = all.clone();
        let (count, dim) = units(client, (taps + 1) * outputs);
        sum_kernel::launch(
            client,
            count,
            dim,
            parts.into_buffer_arg(),
            weight.into_buffer_arg(),
            bias.into_buffer_arg(),
            other_weight.into_buffer_arg(),
            other_bias.into_buffer_arg(),
            number,
            taps,
            outputs,
            own,
        );
        all
    }
}

/// Where a gradient goes.
#[derive(Debug)]
pub(super) enum Target<'a> {
    New,
    /// It counts where the values are positive.
    Masked(&'a CubeTensor),
    /// It is added to what is there.
    Added(&'a CubeTensor),
}
