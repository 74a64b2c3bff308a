//! Means, their standard errors, and what nothing beats.

use serde::{Deserialize, Serialize};

/// A mean over seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The mean.
    pub mean: f64,
    /// Its standard error, the root of the sample's variance (n - 1) over n; none for a single value.
    pub standard_error: Option<f64>,
    /// Number of values.
    pub count: usize,
}

impl Summary {
    /// Of values, if there are any.
    #[must_use]
    pub fn of(values: &[f64]) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
        Some(Self {
            mean,
            standard_error: (values.len() > 1).then(|| (squares / (n - 1.0) / n).sqrt()),
            count: values.len(),
        })
    }

    /// The mean of means that know nothing of each other, such as those of several scenes. Its error is what the seeds' errors
    /// make of it, and says nothing of other scenes; none where one of them has none.
    #[must_use]
    pub fn over(parts: &[Self]) -> Option<Self> {
        let n = parts.len() as f64;
        let squares: Option<f64> = parts
            .iter()
            .map(|part| part.standard_error.map(|e| e * e))
            .sum();
        (!parts.is_empty()).then(|| Self {
            mean: parts.iter().map(|part| part.mean).sum::<f64>() / n,
            standard_error: squares.map(|sum| sum.sqrt() / n),
            count: parts.iter().map(|part| part.count).sum(),
        })
    }

    /// Whether it is farther from zero than two standard errors.
    #[must_use]
    pub fn is_clear(&self) -> bool {
        self.standard_error
            .is_some_and(|error| self.mean.abs() > 2.0 * error)
    }
}

/// Which points (cost, quality) nothing beats: no other has as little cost and more quality, or less cost and as much quality. In order
/// of their cost.
pub(crate) fn pareto_front(points: &[(f64, f64)]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&a, &b| {
        let (a, b) = (points[a], points[b]);
        a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1))
    });
    let mut best = f64::NEG_INFINITY;
    let mut front: Vec<usize> = Vec::new();
    for index in order {
        let is_twin = front
            .last()
            .is_some_and(|last| points[*last] == points[index]);
        if points[index].1 > best || is_twin {
            best = points[index].1;
            front.push(index);
        }
    }
    front
}

#[cfg(test)]
mod tests {
    use super::*;
    use property::property;

    #[test]
    fn a_mean_and_its_error_by_hand() {
        // 2, 4, 4, 4, 5, 5, 7, 9: mean 5, squares 32, so the error is sqrt(32 / 7 / 8).
        let summary = Summary::of(&[2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]).expect("values");
        assert_eq!((summary.mean, summary.count), (5.0, 8));
        let error = summary.standard_error.expect("several values");
        assert!((error - (32.0_f64 / 56.0).sqrt()).abs() < 1e-15);
        // Two values: half their distance.
        let two = Summary::of(&[31.0, 31.5]).expect("values");
        assert_eq!(two.mean, 31.25);
        assert!((two.standard_error.expect("two") - 0.25).abs() < 1e-12);
        assert_eq!(Summary::of(&[]), None);
        let one = Summary::of(&[3.0]).expect("a value");
        assert_eq!((one.mean, one.standard_error), (3.0, None));
        assert!(!one.is_clear(), "of one seed nothing is known");
    }

    #[test]
    fn a_mean_moves_with_its_values_and_its_error_does_not() {
        property("a mean moves with its values", 500, |u| {
            let values: Vec<f64> = (0..u.int_in_range(2..=9)?)
                .map(|_| Ok(f64::from(u.int_in_range(-1000..=1000)?) / 8.0))
                .collect::<Result<_, _>>()?;
            let (shift, scale) = (f64::from(u.int_in_range(-99..=99)?), -4.0);
            let changed: Vec<f64> = values.iter().map(|v| shift + scale * v).collect();
            let (a, b) = (Summary::of(&values), Summary::of(&changed));
            let (a, b) = (a.expect("values"), b.expect("values"));
            assert!((b.mean - (shift + scale * a.mean)).abs() < 1e-9);
            let errors = (
                a.standard_error.expect("several"),
                b.standard_error.expect("several"),
            );
            assert!((errors.1 - scale.abs() * errors.0).abs() < 1e-9);
            // The same values again: the mean stays, the error shrinks.
            let twice = Summary::of(&[values.clone(), values].concat()).expect("values");
            assert!((twice.mean - a.mean).abs() < 1e-9);
            assert!(twice.standard_error.expect("several") <= errors.0 + 1e-12);
            Ok(())
        });
    }

    #[test]
    fn errors_of_scenes_add_in_squares() {
        let part = |mean, error| Summary {
            mean,
            standard_error: Some(error),
            count: 2,
        };
        let over = Summary::over(&[part(1.0, 0.3), part(3.0, 0.4)]).expect("parts");
        assert_eq!((over.mean, over.count), (2.0, 4));
        assert!((over.standard_error.expect("known") - 0.25).abs() < 1e-15);
        let single = Summary {
            standard_error: None,
            ..part(1.0, 0.0)
        };
        let over = Summary::over(&[part(1.0, 0.3), single]).expect("parts");
        assert_eq!(over.standard_error, None);
        assert_eq!(Summary::over(&[]), None);
    }

    #[test]
    fn nothing_on_the_front_is_beaten_and_all_else_is() {
        property("nothing on the front is beaten", 500, |u| {
            let points: Vec<(f64, f64)> = (0..u.int_in_range(0..=12)?)
                .map(|_| {
                    Ok((
                        f64::from(u.int_in_range(0..=6)?),
                        f64::from(u.int_in_range(0..=6)?),
                    ))
                })
                .collect::<Result<_, _>>()?;
            let front = pareto_front(&points);
            let beats = |a: (f64, f64), b: (f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
            for (index, point) in points.iter().enumerate() {
                let is_beaten = points.iter().any(|other| beats(*other, *point));
                assert_eq!(!is_beaten, front.contains(&index), "{points:?}: {point:?}");
            }
            assert!(front.windows(2).all(|w| points[w[0]].0 <= points[w[1]].0));
            Ok(())
        });
    }
}
