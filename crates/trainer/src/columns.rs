//! A few known columns, and what of values is a sum of them.

use burn::tensor::{DType, Device, Tensor, TensorData};

/// Columns that are orthonormal, so that two small products find what of values they span.
#[derive(Clone, Debug)]
pub(crate) struct Columns {
    columns: Tensor<2>,
    /// Without the rows that do not tell.
    transposed: Tensor<2>,
}

/// A column of which no more than this share of its square is left beside the others, or no more than this at all, is none.
const LEAST: f64 = 1e-12;

impl Columns {
    /// An orthonormal basis of what columns span, one or more of a length, in the place of each one; 0 where it adds nothing.
    pub(crate) fn spanning(columns: Vec<Vec<f64>>, options: (&Device, DType)) -> Self {
        let all = vec![true; columns[0].len()];
        Self::told_by(&all, columns, options)
    }

    /// The same, but that only these rows tell what of values the columns span; the others follow.
    pub(crate) fn told_by(
        rows: &[bool],
        columns: Vec<Vec<f64>>,
        (device, dtype): (&Device, DType),
    ) -> Self {
        let of_rows = |column: &[f64]| -> Vec<f64> {
            let values = column.iter().zip(rows);
            values
                .map(|(v, told)| if *told { *v } else { 0.0 })
                .collect()
        };
        let dot =
            |a: &[f64], b: &[f64]| -> f64 { of_rows(a).iter().zip(b).map(|(a, b)| a * b).sum() };
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
        let told = basis.iter().flat_map(|column| of_rows(column));
        let transposed = TensorData::new(told.collect::<Vec<f64>>(), shape);
        let transposed = Tensor::<2>::from_data(transposed, (device, dtype)).inner();
        let [count, height] = shape;
        let columns = (0..height).flat_map(|row| basis.iter().map(move |column| column[row]));
        let columns = TensorData::new(columns.collect::<Vec<f64>>(), [height, count]);
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
