//! What kernels on a GPU share: tensors as they read and write them, and how many units they take.

#[allow(missing_docs, reason = "macros write items of their own beside each")]
pub mod finite;
#[allow(missing_docs, reason = "macros write items of their own beside each")]
pub mod sums;
#[allow(
    missing_docs,
    missing_debug_implementations,
    reason = "macros write items of their own beside each"
)]
pub mod vec3;

use burn::tensor::{DType, Shape};
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::ops::numeric::{empty_device_contiguous_dtype, full_device_dtype, zeros_client};
use burn_cubecl::tensor::CubeTensor;
use cubecl::calculate_cube_count_elemwise;
use cubecl::ir::UIntKind;
use cubecl::prelude::{Client, CubeCount, CubeDim, ElemType, InputScalar};

/// Units of a cube where nothing asks for another number.
const UNITS: u32 = 128;

/// A tensor of f32 with its elements in order.
///
/// # Panics
/// On any other dtype: kernels on a GPU compute in f32 alone.
#[must_use]
pub fn flat(tensor: CubeTensor) -> CubeTensor {
    assert_eq!(
        tensor.dtype,
        DType::F32,
        "kernels on a GPU compute in f32; run in other float types on the CPU"
    );
    into_contiguous(tensor)
}

/// A tensor beside another, whose elements may be anything.
#[must_use]
pub fn empty(like: &CubeTensor, shape: impl Into<Shape>, dtype: DType) -> CubeTensor {
    empty_device_contiguous_dtype(
        like.client.clone(),
        like.device.clone(),
        shape.into(),
        dtype,
    )
}

/// A tensor of u32 beside another, all of one value.
#[must_use]
pub fn full(like: &CubeTensor, shape: impl Into<Shape>, value: u32) -> CubeTensor {
    full_device_dtype(
        like.client.clone(),
        shape.into(),
        like.device.clone(),
        InputScalar::new(value, ElemType::UInt(UIntKind::U32)),
        DType::U32,
    )
}

/// A tensor of f32 beside another, all of them 0.
#[must_use]
pub fn zeros(like: &CubeTensor, shape: impl Into<Shape>) -> CubeTensor {
    zeros_client(
        like.client.clone(),
        like.device.clone(),
        shape.into(),
        DType::F32,
    )
}

/// Cubes for so many units, and their size. A few units too many may run: kernels look where they are.
#[must_use]
pub fn units(client: &Client, count: usize) -> (CubeCount, CubeDim) {
    let dim = CubeDim::new_1d(UNITS);
    (calculate_cube_count_elemwise(client, count, dim), dim)
}

/// So many cubes of `units` units each. A few cubes too many may run: kernels look where they are.
#[must_use]
pub fn cubes(client: &Client, count: usize, units: usize) -> (CubeCount, CubeDim) {
    let dim = CubeDim::new_1d(units as u32);
    (
        calculate_cube_count_elemwise(client, count * units, dim),
        dim,
    )
}
