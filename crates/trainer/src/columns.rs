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
/// Rows that do not tell follow a column where those that do hold such a share of its square.
const FOLLOWED: f64 = 0.1;

impl Columns {
    /// An orthonormal basis of what columns span, one or more of a length, in the place of each one; 0 where it adds nothing.
    pub(crate) fn spanning(columns: Vec<Vec<f64>>) -> Self {
        let all = vec![true; columns[0].len()];
        Self::told_by(all, columns)
    }

    /// The same, but that only these rows tell what of values the columns span; the others follow, but for columns of which these
    /// rows hold so little that noise of theirs would be the others' many times over: those are none of theirs.
    pub(crate) fn told_by(told: Vec<bool>, columns: Vec<Vec<f64>>) -> Self {
        let mut basis: Vec<Vec<f64>> = Vec::new();
        for mut column in columns {
            let whole = dot(&told, &column, &column);
            for other in &basis {
                let along = dot(&told, &column, other);
                add(&mut column, -along, other);
            }
            let left = dot(&told, &column, &column);
            let unscaled: f64 = column.iter().map(|value| value * value).sum();
            let scale = if left > LEAST * whole.max(1.0) {
                left.sqrt().recip()
            } else {
                0.0
            };
            column.iter_mut().for_each(|value| *value *= scale);
            if left < FOLLOWED * unscaled {
                for (value, told) in column.iter_mut().zip(&told) {
                    *value = if *told { *value } else { 0.0 };
                }
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// Slow waves of 80 frames, of which some in a row do not tell.
    fn waves(gap: std::ops::Range<usize>) -> Columns {
        let frames = 80_usize;
        let told = (0..frames).map(|i| !gap.contains(&i)).collect();
        let wave = |k: usize| {
            let angle = |i: usize| PI * k as f64 * (i as f64 + 0.5) / frames as f64;
            (0..frames).map(|i| angle(i).cos()).collect()
        };
        Columns::told_by(told, (0..=10).map(wave).collect())
    }

    #[test]
    fn rows_that_do_not_tell_follow_by_no_more_than_a_few_times_what_the_others_say() {
        for gap in [30..36, 30..50, 2..25, 60..80] {
            let columns = waves(gap.clone());
            let rows = columns.projection();
            for row in gap.clone() {
                // How far noise of size one in each row that tells shifts this one.
                let shift = rows[80 * row..80 * (row + 1)].iter();
                let shift = shift.map(|v| v * v).sum::<f64>().sqrt();
                assert!(shift < 3.0, "{gap:?}, {row}: {shift}");
            }
        }
    }

    #[test]
    fn rows_beside_those_that_tell_are_as_the_waves_they_tell_of() {
        let columns = waves(30..33);
        let values: Vec<f64> = (0..80)
            .map(|i| 0.7 + (PI * 3.0 * (f64::from(i) + 0.5) / 80.0).cos())
            .collect();
        let mut seen = values.clone();
        seen[30..33].fill(9.0);
        for (found, expected) in columns.part_of(&seen).iter().zip(&values) {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }
}
