//! Nearest neighbours among points in 3D (a k-d tree from `nabo`, on f64).

use glam::DVec3;
use nabo::{KDTree, NotNan, Point};
use rayon::prelude::*;

#[derive(Clone, Copy, Default)]
struct TreePoint([NotNan<f64>; 3]);

impl Point<f64> for TreePoint {
    const DIM: u32 = 3;
    fn set(&mut self, i: u32, value: NotNan<f64>) {
        self.0[i as usize] = value;
    }
    fn get(&self, i: u32) -> NotNan<f64> {
        self.0[i as usize]
    }
}

/// A point that is not finite sits at the origin: nabo's points cannot be NaN, and callers only pass
/// points that were lifted from finite depth.
fn tree_point(p: DVec3) -> TreePoint {
    TreePoint(p.to_array().map(|v| NotNan::new(v).unwrap_or_default()))
}

/// A searchable cloud of points.
pub(crate) struct Neighbors(KDTree<f64, TreePoint>);

impl Neighbors {
    /// Builds the tree; `None` for no points.
    pub(crate) fn new(points: &[DVec3]) -> Option<Self> {
        if points.is_empty() {
            return None;
        }
        Some(Self(KDTree::new(
            &points.iter().copied().map(tree_point).collect::<Vec<_>>(),
        )))
    }

    /// Index of the nearest point.
    pub(crate) fn nearest(&self, query: DVec3) -> usize {
        self.0
            .knn(1, &tree_point(query))
            .first()
            .map_or(0, |n| n.index as usize)
    }
}

/// For each point the mean distance to its three nearest other points (of those there are);
/// 0 for a single point.
pub(crate) fn mean_neighbor_distances(points: &[DVec3]) -> Vec<f64> {
    let Some(tree) = Neighbors::new(points) else {
        return Vec::new();
    };
    points
        .par_iter()
        .map(|&p| {
            // The nearest of the four is the point itself, or an equal one.
            let found = tree.0.knn(4, &tree_point(p));
            let others = &found[1.min(found.len())..];
            let sum: f64 = others.iter().map(|n| n.dist2.into_inner().sqrt()).sum();
            sum / others.len().max(1) as f64
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_on_a_line() {
        let points: Vec<DVec3> = [0.0, 1.0, 3.0, 6.0]
            .map(|x| DVec3::new(x, 0.0, 0.0))
            .to_vec();
        let mean = mean_neighbor_distances(&points);
        assert!((mean[0] - 10.0 / 3.0).abs() < 1e-12);
        assert!((mean[1] - (1.0 + 2.0 + 5.0) / 3.0).abs() < 1e-12);
        assert_eq!(mean_neighbor_distances(&points[..1]), vec![0.0]);
        assert!(mean_neighbor_distances(&[]).is_empty());
    }

    #[test]
    fn many_equal_points_are_no_trouble() {
        let points = vec![DVec3::ONE; 500];
        assert!(mean_neighbor_distances(&points).iter().all(|&d| d == 0.0));
    }
}
