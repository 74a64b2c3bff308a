//! Products of small matrices in all of f32.

use burn::tensor::Tensor;

/// The product of two matrices, [r, k] and [k, c], as sums of products; r k c numbers are made on the way.
///
/// Burn's own goes to a GPU's matrix units where there are any, and CUDA's see ten bits of an f32 (TF32): a pose that is turned by
/// them is off by tenths of a px.
#[must_use]
pub fn product(left: Tensor<2>, right: Tensor<2>) -> Tensor<2> {
    let ([rows, inner], [_, columns]) = (left.dims(), right.dims());
    let (left, right) = (
        left.reshape([1, rows, inner]),
        right.reshape([1, inner, columns]),
    );
    products(left, right).reshape([rows, columns])
}

/// [`product`] of each of n pairs, [n, r, k] and [n, k, c]; where there is one on a side, it goes with all.
#[must_use]
pub fn products(left: Tensor<3>, right: Tensor<3>) -> Tensor<3> {
    let ([n, rows, inner], [m, _, columns]) = (left.dims(), right.dims());
    (left.reshape([n, rows, inner, 1]) * right.reshape([m, 1, inner, columns]))
        .sum_dim(2)
        .reshape([n.max(m), rows, columns])
}

#[cfg(all(test, feature = "flex"))]
mod tests {
    use super::*;
    use burn::tensor::{DType, Device, TensorData};

    fn numbers(from: f64, count: usize) -> Vec<f64> {
        (0..count).map(|k| (1.7 * k as f64 + from).sin()).collect()
    }

    /// The sum over k of left[i, k] right[k, j].
    fn entry(left: &[f64], right: &[f64], [inner, columns]: [usize; 2], at: [usize; 2]) -> f64 {
        (0..inner)
            .map(|k| left[at[0] * inner + k] * right[k * columns + at[1]])
            .sum()
    }

    #[test]
    fn each_entry_is_the_sum_over_a_row_and_a_column() {
        let options = (&Device::flex(), DType::F64);
        let (left, right) = (numbers(0.2, 2 * 3 * 4), numbers(0.9, 2 * 4 * 5));
        let tensor = |values: &[f64], shape: [usize; 3]| {
            Tensor::<3>::from_data(TensorData::new(values.to_vec(), shape), options)
        };
        let values = |tensor: Tensor<3>| tensor.try_into_vec_as::<f64>().expect("f64");
        let both = values(products(
            tensor(&left, [2, 3, 4]),
            tensor(&right, [2, 4, 5]),
        ));
        let shared = values(products(
            tensor(&left[..12], [1, 3, 4]),
            tensor(&right, [2, 4, 5]),
        ));
        let one = product(
            tensor(&left[..12], [1, 3, 4]).reshape([3, 4]),
            tensor(&right[..20], [1, 4, 5]).reshape([4, 5]),
        );
        let one = values(one.reshape([1, 3, 5]));
        for (place, found) in both.iter().enumerate() {
            let (pair, at) = (place / 15, [place % 15 / 5, place % 5]);
            let right = &right[20 * pair..20 * (pair + 1)];
            let of = |left: &[f64]| entry(left, right, [4, 5], at);
            let (own, first) = (of(&left[12 * pair..12 * (pair + 1)]), of(&left[..12]));
            assert!((found - own).abs() < 1e-14, "{place}: {found} {own}");
            assert!((shared[place] - first).abs() < 1e-14, "{place}: shared");
            if pair == 0 {
                assert!((one[place] - own).abs() < 1e-14, "{place}: one");
            }
        }
    }
}
