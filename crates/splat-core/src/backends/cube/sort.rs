//! Prefix sums and sorts of tables on a GPU.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{cubes, empty, full};

use crate::cube::scan::{self, block_scan_kernel, block_sums_kernel};
use crate::cube::sort::{self, DIGIT, digits_kernel, place_kernel};

/// The sum of all counts before each.
pub(super) fn before(counts: &CubeTensor) -> CubeTensor {
    let length = counts.meta.num_elements();
    let blocks = length.div_ceil(scan::BLOCK);
    let starts = if blocks == 1 {
        full(counts, [1], 0)
    } else {
        let sums = empty(counts, [blocks], DType::U32);
        let (number, dim) = cubes(&counts.client, blocks, scan::UNITS);
        block_sums_kernel::launch(
            &counts.client,
            number,
            dim,
            counts.clone().into_buffer_arg(),
            sums.clone().into_buffer_arg(),
        );
        before(&sums)
    };
    let sums = empty(counts, [length], DType::U32);
    let (number, dim) = cubes(&counts.client, blocks, scan::UNITS);
    block_scan_kernel::launch(
        &counts.client,
        number,
        dim,
        counts.clone().into_buffer_arg(),
        starts.into_buffer_arg(),
        sums.clone().into_buffer_arg(),
    );
    sums
}

/// Keys in order by their lowest `bits`, and the place that each had; equal keys keep their order.
pub(super) fn sorted(keys: CubeTensor, bits: u32) -> [CubeTensor; 2] {
    let length = keys.meta.num_elements();
    let blocks = length.div_ceil(sort::BLOCK);
    let client = keys.client.clone();
    let (mut keys, mut values) = (keys.clone(), keys);
    for pass in 0..bits.div_ceil(DIGIT) {
        let shift = pass * DIGIT;
        let table = empty(&keys, [sort::table(blocks)], DType::U32);
        let (number, dim) = cubes(&client, blocks, sort::UNITS);
        digits_kernel::launch(
            &client,
            number.clone(),
            dim,
            keys.clone().into_buffer_arg(),
            table.clone().into_buffer_arg(),
            shift,
        );
        let [to_keys, to_values] = [(); 2].map(|()| empty(&keys, [length], DType::U32));
        place_kernel::launch(
            &client,
            number,
            dim,
            keys.into_buffer_arg(),
            values.into_buffer_arg(),
            before(&table).into_buffer_arg(),
            to_keys.clone().into_buffer_arg(),
            to_values.clone().into_buffer_arg(),
            shift,
            pass == 0,
        );
        (keys, values) = (to_keys, to_values);
    }
    [keys, values]
}
