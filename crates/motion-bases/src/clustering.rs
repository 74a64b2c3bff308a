//! k-means with k-means++ seeding (Arthur and Vassilvitskii 2007), seeded and independent of the
//! number of threads.

use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Lloyd iterations at most; it stops earlier when the error falls by less than 1e-4 of itself.
const MAX_ITERATIONS: usize = 100;
/// Points per parallel task.
const CHUNK: usize = 256;

/// Labels 0..k' (each used at least once) of points of dimension `dim`, k' at most `k`.
///
/// There are fewer clusters than asked for where there are fewer distinct points, or where a
/// cluster loses all its members on the way.
pub(crate) fn cluster(
    points: &[f64],
    dim: usize,
    count: usize,
    k: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<usize> {
    if dim == 0 || k <= 1 || count == 0 {
        return vec![0; count];
    }
    let mut centers = seed_centers(points, dim, k, rng);
    let mut labels = vec![0; count];
    let mut last_error = f64::INFINITY;
    for _ in 0..MAX_ITERATIONS {
        let nearest = assign(points, dim, &centers);
        let error: f64 = nearest.iter().map(|&(_, distance)| distance).sum();
        labels = nearest.into_iter().map(|(label, _)| label).collect();
        // Written so that an error of zero stops it too.
        if last_error - error <= 1e-4 * last_error.min(f64::MAX) && last_error.is_finite() {
            break;
        }
        last_error = error;
        move_centers(points, dim, &labels, &mut centers);
    }
    compact(&labels, centers.len() / dim)
}

/// k-means++: each further centre is a point drawn with a probability proportional to its squared
/// distance from the centres so far.
fn seed_centers(points: &[f64], dim: usize, k: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let count = points.len() / dim;
    let row = |i: usize| &points[i * dim..(i + 1) * dim];
    let first = ((unit(rng) * count as f64) as usize).min(count - 1);
    let mut centers = row(first).to_vec();
    let mut distances = vec![f64::INFINITY; count];
    while centers.len() < k * dim {
        let newest = &centers[centers.len() - dim..];
        for (i, distance) in distances.iter_mut().enumerate() {
            *distance = distance.min(square_distance(row(i), newest));
        }
        let total: f64 = distances.iter().sum();
        if total <= 0.0 {
            break; // every point is a centre already
        }
        let mut left = unit(rng) * total;
        let mut chosen = None;
        for (i, &distance) in distances.iter().enumerate().filter(|&(_, &d)| d > 0.0) {
            chosen = Some(i);
            left -= distance;
            if left < 0.0 {
                break;
            }
        }
        let Some(chosen) = chosen else { break };
        centers.extend_from_slice(row(chosen));
    }
    centers
}

/// Nearest centre (the first of equals) and squared distance to it, for each point.
fn assign(points: &[f64], dim: usize, centers: &[f64]) -> Vec<(usize, f64)> {
    points
        .par_chunks(CHUNK * dim)
        .flat_map_iter(|chunk| {
            chunk.chunks_exact(dim).map(|point| {
                let mut best = (0, f64::INFINITY);
                for (label, center) in centers.chunks_exact(dim).enumerate() {
                    let distance = square_distance(point, center);
                    if distance < best.1 {
                        best = (label, distance);
                    }
                }
                best
            })
        })
        .collect()
}

/// Moves each centre to the mean of its members; one without members stays where it is.
fn move_centers(points: &[f64], dim: usize, labels: &[usize], centers: &mut [f64]) {
    let mut sums = vec![0.0; centers.len()];
    let mut counts = vec![0_usize; centers.len() / dim];
    for (point, &label) in points.chunks_exact(dim).zip(labels) {
        counts[label] += 1;
        for (sum, value) in sums[label * dim..(label + 1) * dim].iter_mut().zip(point) {
            *sum += value;
        }
    }
    for (label, &count) in counts.iter().enumerate().filter(|&(_, &count)| count > 0) {
        for k in label * dim..(label + 1) * dim {
            centers[k] = sums[k] / count as f64;
        }
    }
}

/// Numbers the labels that occur 0, 1, 2 … in their order.
fn compact(labels: &[usize], k: usize) -> Vec<usize> {
    let mut used = vec![false; k];
    for &label in labels {
        used[label] = true;
    }
    let mut next = 0;
    let renamed: Vec<usize> = used
        .iter()
        .map(|&used| {
            next += usize::from(used);
            next.saturating_sub(1)
        })
        .collect();
    labels.iter().map(|&label| renamed[label]).collect()
}

fn square_distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// A uniform number in [0, 1).
fn unit(rng: &mut ChaCha8Rng) -> f64 {
    (rand::Rng::next_u64(rng) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn rng(seed: u64) -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(seed)
    }

    fn blobs(count: usize) -> Vec<f64> {
        (0..count)
            .flat_map(|i| {
                let angle = i as f64;
                let middle = [10.0, -10.0, 0.0][i % 3];
                [middle + angle.sin(), middle.abs() + angle.cos()]
            })
            .collect()
    }

    #[test]
    fn separate_blobs_are_found_for_most_seeds() {
        let points = blobs(300);
        let found = (0..20)
            .filter(|&seed| {
                let labels = cluster(&points, 2, 300, 3, &mut rng(seed));
                (3..300).all(|i| labels[i] == labels[i % 3])
                    && labels[0] != labels[1]
                    && labels[1] != labels[2]
            })
            .count();
        assert!(found >= 18, "{found} of 20 seeds");
    }

    #[test]
    fn the_same_seed_gives_the_same_labels_with_any_number_of_threads() {
        let points = blobs(2000);
        let run = |threads| {
            rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .expect("a thread pool")
                .install(|| cluster(&points, 2, 2000, 7, &mut rng(5)))
        };
        assert_eq!(run(1), run(2));
        assert_eq!(run(1), run(1));
    }

    #[test]
    fn labels_are_dense_when_points_are_few_or_equal() {
        assert_eq!(cluster(&[1.0; 8], 2, 4, 3, &mut rng(1)), [0; 4]);
        assert_eq!(cluster(&[], 0, 3, 3, &mut rng(1)), [0; 3]);
        assert!(cluster(&[], 2, 0, 3, &mut rng(1)).is_empty());
        let labels = cluster(&[0.0, 0.0, 5.0, 5.0, 9.0], 1, 5, 20, &mut rng(1));
        let largest = labels.iter().copied().max().expect("labels");
        assert!(largest <= 2, "three distinct points: {labels:?}");
        assert!((0..=largest).all(|l| labels.contains(&l)), "{labels:?}");
        assert_eq!(compact(&[4, 1, 4, 2], 6), [2, 0, 2, 1]);
    }
}
