//! What paths are made of: polylines through moments of the exposure that are equally far apart.
//!
//! A hand's shake turns within an exposure, and more sharply than a polynomial of a few numbers can. The functions are
//! hierarchical: the first goes straight from the start to the end, each later one adds a bend, so that a path of fewer
//! parts is one of more parts with zeros.

/// Function k of a path at a moment s from -1/2 to 1/2, 0 in the middle: s, then |s|, then tents of slope 1 over the parts'
/// further ends, those with k even odd in s (-s gives the negative), the others even.
pub(crate) fn shape(k: usize, s: f64) -> f64 {
    match k {
        0 => s,
        1 => s.abs(),
        _ => {
            let level = k.ilog2();
            let width = 0.5_f64.powi(level as i32 + 1);
            let index = (k - (1 << level)) / 2;
            let center = (2 * index + 1) as f64 * width;
            let tent = (width - (s.abs() - center).abs()).max(0.0);
            if k.is_multiple_of(2) {
                tent.copysign(s)
            } else {
                tent
            }
        }
    }
}

/// Mean of function k over the exposure.
pub(crate) fn mean(k: usize) -> f64 {
    match k {
        1 => 0.25,
        k if k.is_multiple_of(2) => 0.0,
        k => 2.0 * 0.25_f64.powi(k.ilog2() as i32 + 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers whose path goes through `places` at the ends of its parts, from -1/2 to 1/2; the middle place is 0.
    fn through(places: &[f64]) -> Vec<f64> {
        let parts = places.len() - 1;
        let mut path = Vec::new();
        for k in 0..parts {
            // Functions of later levels are zero at the ends of earlier ones.
            let at = |s: f64| {
                let own: f64 = path.iter().enumerate().map(|(k, c)| c * shape(k, s)).sum();
                let place = places[((s + 0.5) * parts as f64).round() as usize];
                place - own
            };
            let peak = peak(k);
            let (after, before) = (at(peak), at(-peak));
            let part = if k % 2 == 0 {
                after - before
            } else {
                after + before
            };
            path.push(0.5 * part / shape(k, peak));
        }
        path
    }

    /// Where function k is largest.
    fn peak(k: usize) -> f64 {
        let grid = (0..=8).map(|i| f64::from(i) / 16.0);
        let better = |best: f64, s: f64| {
            if shape(k, s) > shape(k, best) {
                s
            } else {
                best
            }
        };
        grid.fold(0.0, better)
    }

    #[test]
    fn any_polyline_through_the_middle_is_a_path() {
        for (parts, seed) in [1, 2, 4, 8].into_iter().flat_map(|p| [(p, 0.3), (p, 1.9)]) {
            let mut places: Vec<f64> = (0..=parts)
                .map(|i| 5.0 * (1.7 * i as f64 + seed).sin())
                .collect();
            if parts == 1 {
                places[1] = -places[0];
            } else {
                places[parts / 2] = 0.0;
            }
            let path = through(&places);
            for i in 0..=16 * parts {
                let s = i as f64 / (16 * parts) as f64 - 0.5;
                let (part, share) = (i / 16, (i % 16) as f64 / 16.0);
                let next = places[(part + 1).min(parts)];
                let expected = (1.0 - share) * places[part] + share * next;
                let found: f64 = path.iter().enumerate().map(|(k, c)| c * shape(k, s)).sum();
                assert!(
                    (found - expected).abs() < 1e-12,
                    "{parts} parts at {s}: {found}, {expected}"
                );
            }
        }
    }

    #[test]
    fn means_are_those_over_the_exposure() {
        for k in 0..8 {
            let moments = (0..1024).map(|i| (f64::from(i) + 0.5) / 1024.0 - 0.5);
            let sum: f64 = moments.map(|s| shape(k, s)).sum();
            assert!((mean(k) - sum / 1024.0).abs() < 1e-5, "{k}");
        }
    }

    #[test]
    fn functions_are_odd_and_even_by_turns() {
        for k in 0..8 {
            for i in 0..=20 {
                let s = f64::from(i) / 40.0;
                let sign = if k % 2 == 0 { -1.0 } else { 1.0 };
                assert_eq!(shape(k, -s), sign * shape(k, s), "{k} at {s}");
            }
        }
    }
}
