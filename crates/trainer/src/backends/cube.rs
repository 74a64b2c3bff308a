//! GPUs, by the kernels of [`crate::cube`].

use burn::backend::tensor::FloatTensor;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use bytemuck::NoUninit;
use host::cube::{cubes, empty, flat, units, zeros};
use host::tensor;

use crate::cpu::adam::{AdamUpdate, SteppedRows, corrections};
use crate::cpu::depth::{NEAREST, SAMPLE};
use crate::cpu::detail::weights as detail_weights;
use crate::cube::adam::{WindowLaunch, adam_kernel};
use crate::cube::depth::{FIT, counts_kernel, fit_kernel, sample_kernel, targets_kernel};
use crate::cube::detail::{detail_kernel, gather_kernel};
use crate::cube::mask::{
    BINS, LEVELS, columns_kernel, histogram_kernel, rows_kernel, weights_kernel,
};
use crate::cube::reduce::{TEAM, squared_error_kernel, sums_kernel};
use crate::cube::ssim::{gradient_kernel, lanes_kernel, tiles};
use crate::cube::{depth, mask, reduce};
use crate::ops::{AdamTensors, DepthTargets, ImageLossBackwardOps, ImageLossOps, TrainerOps};

/// A copy on the device of `like`.
fn uploaded<E: NoUninit>(values: &[E], like: &CubeTensor, dtype: DType) -> CubeTensor {
    CubeTensor::new_contiguous(
        like.client.clone(),
        like.device.clone(),
        Shape::from([values.len()]),
        like.client.create_from_slice(bytemuck::cast_slice(values)),
        dtype,
    )
}

/// A bit for every pixel, 32 to a number; where all are valid, some number that no kernel looks at.
fn valid_bits(valid: Option<&[bool]>, like: &CubeTensor) -> CubeTensor {
    let Some(valid) = valid else {
        return empty(like, [1], DType::U32);
    };
    let bits = |pixels: &[bool]| {
        let each = pixels.iter().enumerate();
        each.fold(0_u32, |bits, (k, valid)| bits | u32::from(*valid) << k)
    };
    let words: Vec<u32> = valid.chunks(32).map(bits).collect();
    uploaded(&words, like, DType::U32)
}

/// The tensor in a buffer that nothing else holds.
fn owned(tensor: CubeTensor) -> CubeTensor {
    let tensor = flat(tensor);
    if tensor.can_mut() {
        tensor
    } else {
        flat(tensor.copy())
    }
}

impl TrainerOps for CubeBackend {
    fn adam(
        tensors: AdamTensors<Self>,
        gradient: FloatTensor<Self>,
        update: AdamUpdate,
    ) -> AdamTensors<Self> {
        let AdamUpdate { rates, lead, rows } = &update;
        let stepped: Vec<(usize, usize, u32, &[f64])> = match rows {
            SteppedRows::All(steps) => {
                let first = lead.as_ref().map_or(0, |(rows, _)| *rows);
                let lead = lead
                    .iter()
                    .map(|(rows, rates)| (0, *rows, *steps, &**rates));
                let rest = (first, gradient.meta.shape()[0] - first, *steps, &**rates);
                let all = lead.chain([rest]);
                all.filter(|(_, rows, ..)| *rows > 0).collect()
            }
            SteppedRows::Drawn(rows) => {
                let alone = rows.iter().map(|(row, steps)| (*row, 1, *steps, &**rates));
                alone.collect()
            }
        };
        if gradient.meta.num_elements() == 0 || stepped.is_empty() {
            return tensors;
        }
        let [parameter, moment1, moment2] =
            [tensors.parameter, tensors.moment1, tensors.moment2].map(owned);
        let gradient = flat(gradient);
        // Rates go as plain numbers, two to a launch: a buffer of them would have to be copied to the device each time.
        for (first_row, rows, steps, rates) in stepped {
            let runs: Vec<&[f64]> = rates.chunk_by(|a, b| a == b).collect();
            let [first_correction, second_correction] = corrections(steps).map(|c| c as f32);
            let mut from = 0;
            for pair in runs.chunks(2) {
                let (first, second) = (pair[0], pair[pair.len() - 1]);
                let split = from + first.len();
                let to = from + pair.iter().map(|run| run.len()).sum::<usize>();
                let (count, dim) = units(&gradient.client, rows * (to - from));
                adam_kernel::launch(
                    &gradient.client,
                    count,
                    dim,
                    parameter.clone().into_buffer_arg(),
                    gradient.clone().into_buffer_arg(),
                    moment1.clone().into_buffer_arg(),
                    moment2.clone().into_buffer_arg(),
                    WindowLaunch::new(
                        first_row as u32,
                        rows as u32,
                        rates.len() as u32,
                        from as u32,
                        split as u32,
                        to as u32,
                        first[0] as f32,
                        second[0] as f32,
                        first_correction,
                        second_correction,
                    ),
                );
                from = to;
            }
        }
        AdamTensors {
            parameter,
            moment1,
            moment2,
        }
    }

    fn depth_targets(
        depth: FloatTensor<Self>,
        alpha: FloatTensor<Self>,
        given: FloatTensor<Self>,
        scene_size: f64,
    ) -> DepthTargets<Self> {
        let [depth, alpha, given] = [depth, alpha, given].map(flat);
        let client = alpha.client.clone();
        let of = |shape: &[usize], dtype| empty(&alpha, shape, dtype);
        let [per_alpha, wanted, weight] = [(); 3].map(|()| of(alpha.meta.shape(), DType::F32));
        if given.meta.num_elements() > 0 {
            let (nearest, size) = ((NEAREST * scene_size) as f32, scene_size as f32);
            let blocks = alpha.meta.num_elements().div_ceil(depth::BLOCK);
            let sums = of(&[blocks], DType::U32);
            let (count, dim) = cubes(&client, blocks, TEAM);
            counts_kernel::launch(
                &client,
                count,
                dim,
                alpha.clone().into_buffer_arg(),
                given.clone().into_buffer_arg(),
                sums.clone().into_buffer_arg(),
            );
            let pairs = of(&[SAMPLE, 2], DType::F32);
            let total = of(&[1], DType::U32);
            let (count, dim) = cubes(&client, blocks, TEAM);
            sample_kernel::launch(
                &client,
                count,
                dim,
                depth.into_buffer_arg(),
                alpha.clone().into_buffer_arg(),
                given.clone().into_buffer_arg(),
                sums.into_buffer_arg(),
                pairs.clone().into_buffer_arg(),
                total.clone().into_buffer_arg(),
                nearest,
                size,
            );
            let fit = of(&[FIT], DType::F32);
            let (count, dim) = cubes(&client, 1, TEAM);
            fit_kernel::launch(
                &client,
                count,
                dim,
                pairs.into_buffer_arg(),
                total.into_buffer_arg(),
                fit.clone().into_buffer_arg(),
            );
            let (count, dim) = units(&client, alpha.meta.num_elements());
            targets_kernel::launch(
                &client,
                count,
                dim,
                alpha.clone().into_buffer_arg(),
                given.into_buffer_arg(),
                fit.into_buffer_arg(),
                per_alpha.clone().into_buffer_arg(),
                wanted.clone().into_buffer_arg(),
                weight.clone().into_buffer_arg(),
                nearest,
                size,
            );
        }
        DepthTargets {
            per_alpha,
            wanted,
            weight,
        }
    }

    fn mask_weights(
        rendered: FloatTensor<Self>,
        target: FloatTensor<Self>,
        valid: Option<&[bool]>,
        band: usize,
    ) -> FloatTensor<Self> {
        let [rendered, given] = [rendered, target].map(flat);
        let client = rendered.client.clone();
        let of = |shape: &[usize], dtype| empty(&rendered, shape, dtype);
        let weights = of(rendered.meta.shape(), DType::F32);
        let pixels = rendered.meta.num_elements();
        if pixels == 0 {
            return weights;
        }
        let width = rendered.meta.shape()[1] as u32;
        // A wider band sees no more.
        let band = band.min(pixels) as u32;
        let bins = of(&[BINS], DType::U32);
        let [along, near] = [(); 2].map(|()| of(&[pixels], DType::U32));
        let (count, dim) = units(&client, pixels.max(BINS));
        rows_kernel::launch(
            &client,
            count,
            dim,
            given.clone().into_buffer_arg(),
            along.clone().into_buffer_arg(),
            bins.clone().into_buffer_arg(),
            width,
            band,
        );
        let (count, dim) = units(&client, pixels);
        columns_kernel::launch(
            &client,
            count,
            dim,
            along.into_buffer_arg(),
            valid_bits(valid, &rendered).into_buffer_arg(),
            near.clone().into_buffer_arg(),
            width,
            band,
            valid.is_some(),
        );
        let blocks = pixels.div_ceil(mask::BLOCK);
        for level in 0..LEVELS {
            let (count, dim) = cubes(&client, blocks, TEAM);
            histogram_kernel::launch(
                &client,
                count,
                dim,
                rendered.clone().into_buffer_arg(),
                given.clone().into_buffer_arg(),
                near.clone().into_buffer_arg(),
                bins.clone().into_buffer_arg(),
                level,
            );
        }
        let (count, dim) = cubes(&client, blocks, TEAM);
        weights_kernel::launch(
            &client,
            count,
            dim,
            rendered.clone().into_buffer_arg(),
            given.into_buffer_arg(),
            near.into_buffer_arg(),
            bins.into_buffer_arg(),
            weights.clone().into_buffer_arg(),
        );
        weights
    }

    fn squared_error(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        valid: Option<&[bool]>,
    ) -> FloatTensor<Self> {
        let [a, b] = [a, b].map(flat);
        let samples = a.meta.num_elements();
        if samples == 0 {
            return zeros(&a, [2]);
        }
        let blocks = samples.div_ceil(reduce::BLOCK);
        let terms = empty(&a, [2, blocks], DType::F32);
        let (count, dim) = cubes(&a.client, blocks, TEAM);
        squared_error_kernel::launch(
            &a.client,
            count,
            dim,
            a.clone().into_buffer_arg(),
            b.into_buffer_arg(),
            valid_bits(valid, &a).into_buffer_arg(),
            terms.clone().into_buffer_arg(),
            valid.is_some(),
        );
        sums_of_rows(terms, 2)
    }
}

/// The sums of so many rows of one length.
fn sums_of_rows(terms: CubeTensor, rows: usize) -> CubeTensor {
    let sums = empty(&terms, [rows], DType::F32);
    let client = terms.client.clone();
    let (count, dim) = cubes(&client, rows, TEAM);
    sums_kernel::launch(
        &client,
        count,
        dim,
        terms.into_buffer_arg(),
        sums.clone().into_buffer_arg(),
    );
    sums
}

fn image_loss_on(
    a: CubeTensor,
    b: CubeTensor,
    weights: [f64; 2],
    wanted: bool,
) -> (CubeTensor, Option<CubeTensor>) {
    let [a, b] = [a, b].map(flat);
    let client = a.client.clone();
    let shape = a.meta.shape().clone();
    let gradient = wanted.then(|| empty(&a, shape.clone(), DType::F32));
    let size = [shape[0], shape[1]];
    if size.contains(&0) {
        // A mean of nothing.
        let value = tensor::<f32, CubeBackend>(vec![f32::NAN], [1], &a);
        return (value, gradient);
    }
    let [height, width] = size.map(|pixels| pixels as u32);
    let samples = a.meta.num_elements();
    let [l1_scale, ssim_scale] = weights.map(|w| (w / samples as f64) as f32);
    let partials = if wanted { 3 * samples } else { 1 };
    let partials = empty(&a, [partials], DType::F32);
    let tiles = tiles(size);
    let terms = empty(&a, [tiles], DType::F32);
    let (count, dim) = cubes(&client, tiles, TEAM);
    lanes_kernel::launch(
        &client,
        count,
        dim,
        a.clone().into_buffer_arg(),
        b.clone().into_buffer_arg(),
        partials.clone().into_buffer_arg(),
        terms.clone().into_buffer_arg(),
        width,
        height,
        l1_scale,
        ssim_scale,
        wanted,
    );
    let value = sums_of_rows(terms, 1);
    if let Some(gradient) = &gradient {
        let (count, dim) = cubes(&client, tiles, TEAM);
        gradient_kernel::launch(
            &client,
            count,
            dim,
            a.into_buffer_arg(),
            b.into_buffer_arg(),
            partials.into_buffer_arg(),
            gradient.clone().into_buffer_arg(),
            width,
            height,
            l1_scale,
            ssim_scale,
        );
    }
    (value, gradient)
}

fn detail_loss_on(a: CubeTensor, b: CubeTensor, wanted: bool) -> (CubeTensor, Option<CubeTensor>) {
    let [a, b] = [a, b].map(flat);
    let client = a.client.clone();
    let shape = a.meta.shape().clone();
    let samples = a.meta.num_elements();
    let [first, second] = detail_weights([shape[0], shape[1]]).map(|weight| weight as f32);
    if samples == 0 {
        return (zeros(&a, [1]), wanted.then_some(a));
    }
    let width = shape[1] as u32;
    let signs = empty(&a, [if wanted { 2 * samples } else { 1 }], DType::F32);
    let blocks = samples.div_ceil(reduce::BLOCK);
    let terms = empty(&a, [blocks], DType::F32);
    let (count, dim) = cubes(&client, blocks, TEAM);
    detail_kernel::launch(
        &client,
        count,
        dim,
        a.clone().into_buffer_arg(),
        b.into_buffer_arg(),
        signs.clone().into_buffer_arg(),
        terms.clone().into_buffer_arg(),
        width,
        first,
        second,
        wanted,
    );
    let gradient = wanted.then(|| {
        let gradient = empty(&a, shape, DType::F32);
        let (count, dim) = units(&client, samples);
        gather_kernel::launch(
            &client,
            count,
            dim,
            signs.into_buffer_arg(),
            gradient.clone().into_buffer_arg(),
            width,
        );
        gradient
    });
    (sums_of_rows(terms, 1), gradient)
}

impl ImageLossOps for CubeBackend {
    fn image_loss(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> FloatTensor<Self> {
        image_loss_on(a, b, weights, false).0
    }

    fn detail_loss(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self> {
        detail_loss_on(a, b, false).0
    }
}

impl ImageLossBackwardOps for CubeBackend {
    fn image_loss_and_gradient(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (value, gradient) = image_loss_on(a, b, weights, true);
        (value, gradient.expect("it was wanted"))
    }
    fn detail_loss_and_gradient(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (value, gradient) = detail_loss_on(a, b, true);
        (value, gradient.expect("it was wanted"))
    }
}
