//! A few known columns, and what of values is a sum of them.

use burn::tensor::{DType, Device, Tensor, TensorData};

/// Columns that are orthonormal, so that two small products find what of values they span.
#[derive(Clone, Debug)]
pub(crate) struct Columns {
    columns: Tensor<2>,
    transposed: Tensor<2>,
}

/// A column of which no more than this share of its square is left beside the others, or no more than this at all, is none.
const LEAST: f64 = 1e-12;

impl Columns {
    /// An orthonormal basis of what columns span, one or more of a length, in the place of each one; 0 where it adds nothing.
    pub(crate) fn spanning(columns: Vec<Vec<f64>>, (device, dtype): (&Device, DType)) -> Self {
        let dot = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for mut column in columns {
            let whole = dot(&column, &column);
            for other in &basis {
                let along = dot(&column, other);
                column
                    .iter_mut()
                    .zip(other)
                    .for_each(|(value, other)| *value -= along * other);
            }
            let left = dot(&column, &column);
            let scale = if left > LEAST * whole.max(1.0) {
                left.sqrt().recip()
            } else {
                0.0
            };
            column.iter_mut().for_each(|value| *value *= scale);
            basis.push(column);
        }
        let shape = [basis.len(), basis[0].len()];
        let transposed = TensorData::new(basis.concat(), shape);
        let transposed = Tensor::<2>::from_data(transposed, (device, dtype)).inner();
        let [count, rows] = shape;
        let columns = (0..rows).flat_map(|row| basis.iter().map(move |column| column[row]));
        let columns = TensorData::new(columns.collect::<Vec<f64>>(), [rows, count]);
        Self {
            columns: Tensor::<2>::from_data(columns, (device, dtype)).inner(),
            transposed,
        }
    }

    /// What of values [M, C] they span.
    pub(crate) fn part_of(&self, values: Tensor<2>) -> Tensor<2> {
        let parts = self.transposed.clone().matmul(values);
        self.columns.clone().matmul(parts)
    }
}
