//! A few known columns, and what of values is a sum of them.

/// Columns that are orthonormal over the rows that tell.
#[derive(Clone, Debug)]
pub(crate) struct Columns {
    basis: Vec<Vec<f64>>,
    /// The rows that tell what of values they span.
    told: Vec<bool>,
}

/// A column of which no more than this share of its square is left beside the others, or no more than this at all, is none.
const LEAST: f64 = 1e-12;

impl Columns {
    /// An orthonormal basis of what columns span, one or more of a length, in the place of each one; 0 where it adds nothing.
    pub(crate) fn spanning(columns: Vec<Vec<f64>>) -> Self {
        let all = vec![true; columns[0].len()];
        Self::told_by(all, columns)
    }

    /// The same, but that only these rows tell what of values the columns span; the others follow.
    pub(crate) fn told_by(told: Vec<bool>, columns: Vec<Vec<f64>>) -> Self {
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for mut column in columns {
            let whole = dot(&told, &column, &column);
            for other in &basis {
                let along = dot(&told, &column, other);
                add(&mut column, -along, other);
            }
            let left = dot(&told, &column, &column);
            let scale = if left > LEAST * whole.max(1.0) {
                left.sqrt().recip()
            } else {
                0.0
            };
            column.iter_mut().for_each(|value| *value *= scale);
            basis.push(column);
        }
        Self { basis, told }
    }

    /// What of values they span, a value a row.
    pub(crate) fn part_of(&self, values: &[f64]) -> Vec<f64> {
        let mut part = vec![0.0; values.len()];
        for column in &self.basis {
            add(&mut part, dot(&self.told, values, column), column);
        }
        part
    }

    /// The matrix that takes values to what of them they span, row by row: as many rows as columns.
    pub(crate) fn projection(&self) -> Vec<f64> {
        let rows = 0..self.told.len();
        let at = |row: usize, column: usize| -> f64 {
            let told = f64::from(u8::from(self.told[column]));
            self.basis.iter().map(|b| b[row] * b[column] * told).sum()
        };
        let each = |row| rows.clone().map(move |column| at(row, column));
        rows.clone().flat_map(each).collect()
    }
}

/// The product of two columns over the rows that tell.
fn dot(told: &[bool], a: &[f64], b: &[f64]) -> f64 {
    let rows = told.iter().zip(a).zip(b);
    rows.map(|((told, a), b)| if *told { a * b } else { 0.0 })
        .sum()
}

fn add(to: &mut [f64], times: f64, column: &[f64]) {
    for (value, other) in to.iter_mut().zip(column) {
        *value += times * other;
    }
}
