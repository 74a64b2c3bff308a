//! The blur kernel of a pixel: from where in the sharp picture its light came.

use crate::views::{pixel_center, pixel_index};
use glam::{DAffine3, DVec2};
use io::Map;
use splat_core::Camera;

/// From where in the sharp picture the light of a pixel of the blurry one came, as points that carry a part of it.
///
/// As in the paper, the blurry picture is the sum of the sharp one at the points, times their weights: what a point of the
/// sharp picture becomes in the blurry one is the same, turned by half a turn.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelKernel {
    /// Where, px from the pixel, and how much; together 1.
    points: Vec<(DVec2, f64)>,
}

impl PixelKernel {
    /// Of a picture that is not blurred.
    #[must_use]
    pub fn none() -> Self {
        Self {
            points: vec![(DVec2::ZERO, 1.0)],
        }
    }

    /// Of a pixel whose light came in equal parts from `cameras`, each a map from the middle camera's space to its own. `at` is the
    /// pixel's place (px), and `depth` the z-depth that the middle camera sees there: what lies around it is taken to be as far.
    #[must_use]
    pub fn exposed(camera: &Camera, cameras: &[DAffine3], at: DVec2, depth: f64) -> Self {
        let weight = 1.0 / cameras.len() as f64;
        let point = camera.unproject(at, depth);
        let points = cameras.iter().map(|from_middle| {
            let came_from = camera.project(from_middle.inverse().transform_point3(point));
            (came_from - at, weight)
        });
        Self {
            points: points.collect(),
        }
    }

    /// Of the pixel of an index, blurred by a square of K² `weights` to the share `intensity`. As the blur itself does, what lies
    /// outside of the picture is left out.
    #[must_use]
    pub(crate) fn of_weights(
        camera: &Camera,
        weights: &[f32],
        intensity: f64,
        index: usize,
    ) -> Self {
        let side = weights.len().isqrt();
        let half = (side / 2) as f64;
        let at = pixel_center(camera, index);
        let size = DVec2::new(camera.width as f64, camera.height as f64);
        let cells = weights.iter().enumerate().map(|(j, weight)| {
            let cell = DVec2::new((j % side) as f64, (j / side) as f64);
            (cell - half, f64::from(*weight))
        });
        let inside = |(by, _): &(DVec2, f64)| {
            let to = at + *by;
            to.cmpgt(DVec2::ZERO).all() && to.cmplt(size).all()
        };
        let mut points: Vec<_> = cells.filter(inside).collect();
        let sum: f64 = points.iter().map(|(_, weight)| weight).sum();
        for (_, weight) in &mut points {
            *weight *= intensity / sum.max(f64::MIN_POSITIVE);
        }
        points.push((DVec2::ZERO, 1.0 - intensity));
        Self { points }
    }

    /// Of a picture that cameras collected, and that was then blurred by this kernel of the pixel of an index.
    #[must_use]
    pub(crate) fn after(
        &self,
        camera: &Camera,
        cameras: &[DAffine3],
        depth: &Map,
        index: usize,
    ) -> Self {
        let at = pixel_center(camera, index);
        let mut points = Vec::with_capacity(self.points.len() * cameras.len());
        for &(by, weight) in &self.points {
            let z = f64::from(depth.values[pixel_index(camera, at + by)]);
            let exposed = Self::exposed(camera, cameras, at + by, z);
            let further = exposed.points.iter();
            points.extend(further.map(|(more, part)| (by + *more, weight * part)));
        }
        Self { points }
    }

    /// The same around its own middle: a shift of all kernels of a frame is the same as one of the scene.
    #[must_use]
    pub fn centred(mut self) -> Self {
        let parts = self.points.iter();
        let middle: DVec2 = parts.map(|(by, weight)| *by * *weight).sum();
        for (by, _) in &mut self.points {
            *by -= middle;
        }
        self
    }

    /// How far its points lie from the pixel along x or y at most, px.
    fn reach(&self) -> f64 {
        let points = self.points.iter();
        let reaches = points.map(|(by, _)| by.abs().max_element());
        reaches.fold(0.0, f64::max)
    }

    /// Radius of the square of pixels around the pixel that holds all of its points.
    #[must_use]
    pub fn radius(&self) -> usize {
        // What is a whole number but for rounding is one.
        (self.reach() - 1e-6).max(0.0).ceil() as usize
    }

    /// The weights on a square of (2 `radius` + 1)² pixels around the pixel, row-major: a point's is shared by the four pixels
    /// around it as bilinear interpolation does. What lies outside is left out, so that they may sum to less than 1.
    #[must_use]
    pub fn on_grid(&self, radius: usize) -> Vec<f64> {
        let side = 2 * radius + 1;
        let mut grid = vec![0.0; side * side];
        for (by, weight) in &self.points {
            let place = *by + radius as f64;
            let (corner, part) = (place.floor(), place.fract_gl());
            for (dx, x) in [(0.0, 1.0 - part.x), (1.0, part.x)] {
                for (dy, y) in [(0.0, 1.0 - part.y), (1.0, part.y)] {
                    let (column, row) = (corner.x + dx, corner.y + dy);
                    let inside = |k: f64| (0.0..side as f64).contains(&k);
                    if inside(column) && inside(row) {
                        grid[row as usize * side + column as usize] += weight * x * y;
                    }
                }
            }
        }
        grid
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bpnet::{BlurField, composite};
    use burn::tensor::{Device, Tensor, TensorData};
    use glam::{DMat3, DVec3};

    fn camera() -> Camera {
        Camera::pinhole([21, 21], [50.0, 40.0], [10.0, 9.0])
    }

    #[test]
    fn light_came_from_where_the_point_is_that_the_pixel_showed() {
        let at = DVec2::new(5.5, 6.5);
        // A camera that stands further to the right by 0.1 shows the point to the left: f 0.1 / z, so that what it shows here came
        // from further to the right.
        let right = DAffine3::from_translation(DVec3::new(-0.1, 0.0, 0.0));
        let kernel = PixelKernel::exposed(&camera(), &[right], at, 2.5);
        assert!((kernel.points[0].0 - DVec2::new(2.0, 0.0)).length() < 1e-12);
        // A point of a lens off its middle sees the plane of focus where the middle sees it, whatever the aperture.
        let shear = |u: f64, focus: f64| DAffine3 {
            matrix3: DMat3::from_cols(DVec3::X, DVec3::Y, DVec3::new(u / focus, 0.0, 1.0)),
            translation: DVec3::new(-u, 0.0, 0.0),
        };
        let points = [shear(-0.1, 2.5), shear(0.1, 2.5)];
        assert!(PixelKernel::exposed(&camera(), &points, at, 2.5).reach() < 1e-12);
        let disc = PixelKernel::exposed(&camera(), &points, at, 5.0);
        // f a |1 / focus - 1 / z|
        assert!((disc.reach() - 50.0 * 0.1 * 0.2).abs() < 1e-12);
        let blurred = disc.on_grid(1);
        assert!((blurred[3] - 0.5).abs() < 1e-12 && (blurred[5] - 0.5).abs() < 1e-12);
    }

    #[test]
    fn a_grid_holds_all_of_it_as_bilinear_interpolation_does() {
        let kernel = PixelKernel {
            points: vec![(DVec2::new(0.25, -0.5), 0.4), (DVec2::new(-1.0, 1.0), 0.6)],
        };
        let expected = [0.0, 0.15, 0.05, 0.0, 0.15, 0.05, 0.6, 0.0, 0.0];
        let close = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(close(&kernel.on_grid(1), &expected));
        assert!((kernel.on_grid(4).iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!((kernel.on_grid(0).iter().sum::<f64>() - 0.15).abs() < 1e-12);
        let centred = kernel.clone().centred();
        let middle: DVec2 = centred.points.iter().map(|(by, w)| *by * *w).sum();
        assert!(middle.length() < 1e-12, "{middle}");
        assert!((centred.reach() - 0.9).abs() < 1e-12);
    }

    #[test]
    fn weights_are_those_of_the_blur_with_what_is_inside() {
        let middle = 10 * 21 + 10;
        let mut weights = [0.0; 9];
        (weights[1], weights[5]) = (0.25, 0.75);
        let kernel = PixelKernel::of_weights(&camera(), &weights, 0.8, middle);
        let expected = [0.0, 0.2, 0.0, 0.0, 0.2, 0.6, 0.0, 0.0, 0.0];
        for (found, expected) in kernel.on_grid(1).iter().zip(expected) {
            assert!((found - expected).abs() < 1e-7, "{found} {expected}");
        }
        // In the first row there is nothing above.
        let kernel = PixelKernel::of_weights(&camera(), &weights, 0.8, 10);
        let grid = kernel.on_grid(1);
        assert!(grid[1] == 0.0 && (grid[5] - 0.8).abs() < 1e-12, "{grid:?}");
    }

    #[test]
    fn kernels_of_weights_are_those_that_bpnet_blurs_by() {
        let (camera, entries) = (camera(), 25);
        let count = camera.num_pixels();
        let some = |count: usize, seed: f32| -> Vec<f32> {
            (0..count)
                .map(|k| 0.5 + 0.5 * (seed * k as f32).sin())
                .collect()
        };
        let (image, intensity) = (some(3 * count, 1.7), some(count, 2.3));
        let mut weights = some(entries * count, 0.9);
        for kernel in weights.chunks_exact_mut(entries) {
            let sum: f32 = kernel.iter().sum();
            kernel.iter_mut().for_each(|w| *w /= sum);
        }
        let device = Device::flex();
        let tensor = |values: &[f32], depth: usize| {
            let data = TensorData::new(values.to_vec(), [21, 21, depth]);
            Tensor::<3>::from_data(data, &device)
        };
        let field = BlurField::new(
            tensor(&weights, entries),
            tensor(&intensity, 1).squeeze_dim(2),
        );
        let blurred = composite(tensor(&image, 3), &field.expect("a field")).expect("a picture");
        let blurred = crate::tensors::host(blurred.picture());
        for index in 0..count {
            let weights = &weights[index * entries..(index + 1) * entries];
            let intensity = f64::from(intensity[index]);
            let kernel = PixelKernel::of_weights(&camera, weights, intensity, index);
            let sum = kernel.points.iter().map(|(by, weight)| {
                let from = pixel_index(&camera, pixel_center(&camera, index) + *by);
                weight * f64::from(image[3 * from])
            });
            let (made, found) = (sum.sum::<f64>(), f64::from(blurred[3 * index]));
            assert!((made - found).abs() < 1e-5, "{index}: {made} {found}");
        }
    }

    #[test]
    fn one_blur_after_another_is_their_convolution() {
        let camera = camera();
        let depth = Map {
            width: 21,
            height: 21,
            values: vec![2.5; 441],
        };
        let moved = |x: f64| DAffine3::from_translation(DVec3::new(-x / 20.0, 0.0, 0.0));
        let mut down = [0.0; 9];
        (down[1], down[4]) = (0.5, 0.5);
        let index = 10 * 21 + 10;
        let window = PixelKernel::of_weights(&camera, &down, 1.0, index);
        let both = window.after(&camera, &[moved(0.0), moved(1.0)], &depth, index);
        let expected = [0.0, 0.25, 0.25, 0.0, 0.25, 0.25, 0.0, 0.0, 0.0];
        for (found, expected) in both.on_grid(1).iter().zip(expected) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
    }
}
