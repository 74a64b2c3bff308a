//! Pictures, maps and points of a lens with distortion, as a pinhole would have them.
//!
//! The pinhole keeps the picture's size, its principal point and the ratio of its focal lengths. Their
//! length is the shortest one with which every pixel lies inside the source picture, so nothing is
//! made up at the border and as much as possible of the source is kept.

use splat_core::Camera;

use crate::camera_model::Lens;
use crate::{Image, Map};

/// Displacements below this are no distortion, px.
const NEGLIGIBLE_PX: f64 = 1e-3;

/// Bounds of the new focal length over the source's. Below, the picture's middle would lose half of
/// its detail; above, more than half of the field of view would be lost, and no lens is so.
const ZOOM: [f64; 2] = [0.5, 2.0];

/// Between depths that differ by more than this share runs an edge, and they are not averaged.
const DEPTH_EDGE: f32 = 0.05;

/// How a view's distortion was undone.
#[derive(Clone, Debug, PartialEq)]
pub struct Undistortion {
    lens: Lens,
    camera: Camera,
    displacement_px: f64,
}

impl Undistortion {
    /// Undoes a lens; its camera has the size of the source picture. `Ok(None)` where it moves no pixel,
    /// and an error in words where no pinhole sees what it sees.
    pub(crate) fn of(lens: &Lens) -> Result<Option<Self>, String> {
        let displacement_px = lens.largest_displacement();
        if displacement_px < NEGLIGIBLE_PX {
            return Ok(None);
        }
        let Some(zoom) = smallest_zoom(lens) else {
            return Err(format!(
                "the distortion of its camera model {} folds the picture over, or leaves less than half of it",
                lens.model
            ));
        };
        Ok(Some(Self {
            lens: lens.clone(),
            camera: zoomed(&lens.camera, zoom),
            displacement_px,
        }))
    }

    /// The pinhole that the results are seen by, of the source's size.
    pub(crate) fn camera(&self) -> &Camera {
        &self.camera
    }

    pub(crate) fn model(&self) -> &str {
        &self.lens.model
    }

    /// Largest displacement of the source's pixels against a pinhole of its focal length, px.
    pub(crate) fn displacement_px(&self) -> f64 {
        self.displacement_px
    }

    /// The pinhole's focal length over the source's.
    pub(crate) fn zoom(&self) -> f64 {
        self.camera.fx / self.lens.camera.fx
    }

    /// Where in the source picture a place of the new one is, px.
    fn source(&self, x: f64, y: f64) -> (f64, f64) {
        source(&self.lens, &self.camera, x, y)
    }

    /// Where in the new picture a place of the source is, px. None where the lens puts nothing there.
    pub(crate) fn point(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let (from, to) = (&self.lens.camera, &self.camera);
        let distorted = ((x - from.cx) / from.fx, (y - from.cy) / from.fy);
        let (u, v) = self.lens.distortion.undo(distorted)?;
        Some((to.fx * u + to.cx, to.fy * v + to.cy))
    }

    /// A picture of the source's size, by cubic interpolation (Catmull and Rom): it keeps detail that
    /// bilinear would blur.
    pub(crate) fn image(&self, image: &Image) -> Image {
        let mut pixels = Vec::with_capacity(image.pixels.len());
        self.for_each_pixel(|x, y| {
            let (columns, rows) = (cubic(x, image.width), cubic(y, image.height));
            let mut sum = [0.0f64; 3];
            for (row, weight_y) in rows {
                for (column, weight_x) in columns {
                    let at = 3 * (row * image.width + column);
                    for (sum, &value) in sum.iter_mut().zip(&image.pixels[at..at + 3]) {
                        *sum += weight_y * weight_x * f64::from(value);
                    }
                }
            }
            pixels.extend(sum.map(|s| s.clamp(0.0, 1.0) as f32));
        });
        Image {
            width: self.camera.width,
            height: self.camera.height,
            pixels,
        }
    }

    /// A map of the source's size whose values may be averaged (masks), bilinear.
    pub(crate) fn map(&self, map: &Map) -> Map {
        self.mapped(map, |corners| {
            let sum: f64 = corners.iter().map(|&(w, v)| w * f64::from(v)).sum();
            sum as f32
        })
    }

    /// z-depth of the source's size (0 = missing): bilinear in disparity, which is linear on a plane, on a
    /// surface; the nearest pixel's at edges and beside what is missing.
    pub(crate) fn depth(&self, depth: &Map) -> Map {
        self.mapped(depth, |corners| {
            let values = corners.map(|(_, v)| v);
            let nearest = values.iter().copied().fold(f32::INFINITY, f32::min);
            let farthest = values.iter().copied().fold(0.0, f32::max);
            if nearest > 0.0 && farthest <= nearest * (1.0 + DEPTH_EDGE) {
                let sum: f64 = corners.iter().map(|&(w, v)| w / f64::from(v)).sum();
                return (1.0 / sum) as f32;
            }
            let heaviest = corners.iter().max_by(|a, b| a.0.total_cmp(&b.0));
            heaviest.map_or(0.0, |&(_, v)| v)
        })
    }

    /// A map of the source's size, each value made of its four neighbours in the source and their weights.
    fn mapped(&self, map: &Map, value: impl Fn([(f64, f32); 4]) -> f32) -> Map {
        let mut values = Vec::with_capacity(map.values.len());
        self.for_each_pixel(|x, y| {
            let ([left, right], [above, below]) = (linear(x, map.width), linear(y, map.height));
            let corner = |(row, weight_y): (usize, f64), (column, weight_x): (usize, f64)| {
                (weight_y * weight_x, map.values[row * map.width + column])
            };
            values.push(value([
                corner(above, left),
                corner(above, right),
                corner(below, left),
                corner(below, right),
            ]));
        });
        Map {
            width: self.camera.width,
            height: self.camera.height,
            values,
        }
    }

    /// Where each pixel's centre is in the source, row by row.
    fn for_each_pixel(&self, mut visit: impl FnMut(f64, f64)) {
        let (width, height) = (self.camera.width as f64, self.camera.height as f64);
        for row in 0..self.camera.height {
            for column in 0..self.camera.width {
                let (x, y) = self.source(column as f64 + 0.5, row as f64 + 0.5);
                // A rational lens may have a pole that the search for the zoom has not met.
                visit(x.max(0.0).min(width), y.max(0.0).min(height));
            }
        }
    }
}

/// Where a pinhole's pixel is seen by the lens, px.
fn source(lens: &Lens, pinhole: &Camera, x: f64, y: f64) -> (f64, f64) {
    let (u, v) = ((x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy);
    let (du, dv) = lens.distortion.apply(u, v);
    let c = &lens.camera;
    (c.fx * du + c.cx, c.fy * dv + c.cy)
}

fn zoomed(camera: &Camera, zoom: f64) -> Camera {
    Camera::pinhole(
        [camera.width, camera.height],
        [zoom * camera.fx, zoom * camera.fy],
        [camera.cx, camera.cy],
    )
    .with_near(camera.near)
}

/// The smallest zoom with which the new picture lies inside the source, by bisection.
fn smallest_zoom(lens: &Lens) -> Option<f64> {
    let [mut low, mut high] = ZOOM;
    if lies_inside(lens, low) {
        return Some(low);
    }
    if !lies_inside(lens, high) {
        return None;
    }
    // To a thousandth of a pixel for any picture.
    while high - low > 1e-8 {
        let middle = 0.5 * (low + high);
        if lies_inside(lens, middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    Some(high)
}

/// Whether the whole new picture lies inside the source: its border does, and nothing within is folded.
fn lies_inside(lens: &Lens, zoom: f64) -> bool {
    const GRID: usize = 16;
    let camera = zoomed(&lens.camera, zoom);
    let (width, height) = (camera.width as f64, camera.height as f64);
    let is_inside = |x: f64, y: f64| {
        let (sx, sy) = source(lens, &camera, x, y);
        (0.0..=width).contains(&sx) && (0.0..=height).contains(&sy)
    };
    let mut across = (0..=camera.width).map(|x| x as f64);
    let mut down = (0..=camera.height).map(|y| y as f64);
    let is_unfolded = |x: f64, y: f64| {
        let (u, v) = ((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy);
        lens.distortion.area_scale(u, v) > 0.0
    };
    let share = |i: usize| i as f64 / GRID as f64;
    let mut grid = (0..=GRID).flat_map(|j| (0..=GRID).map(move |i| (share(i), share(j))));
    across.all(|x| is_inside(x, 0.0) && is_inside(x, height))
        && down.all(|y| is_inside(0.0, y) && is_inside(width, y))
        && grid.all(|(i, j)| is_unfolded(i * width, j * height))
}

/// The two pixels around a place and their weights; beyond the border the outermost one.
fn linear(at: f64, count: usize) -> [(usize, f64); 2] {
    let (first, t) = cell(at);
    [(first, 1.0 - t), (first + 1, t)].map(|(i, w)| (within(i, count), w))
}

/// The four pixels around a place and their weights in the cubic of Catmull and Rom.
fn cubic(at: f64, count: usize) -> [(usize, f64); 4] {
    let (first, t) = cell(at);
    let weights = [
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    ];
    let pixels = [first - 1, first, first + 1, first + 2];
    std::array::from_fn(|i| (within(pixels[i], count), weights[i]))
}

/// The last pixel whose centre is not beyond a place, and how far the place is on the way to the next.
fn cell(at: f64) -> (i64, f64) {
    let floor = (at - 0.5).floor();
    (floor as i64, at - 0.5 - floor)
}

fn within(pixel: i64, count: usize) -> usize {
    usize::try_from(pixel).unwrap_or(0).min(count - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera_model::Distortion;

    fn lens(distortion: Distortion) -> Lens {
        Lens {
            distortion,
            ..Lens::pinhole(Camera::pinhole([96, 64], [80.0, 82.0], [47.0, 33.0]))
        }
    }

    fn radial(k1: f64, k2: f64) -> Distortion {
        Distortion::Radial {
            num: [k1, k2, 0.0, 0.0],
            den: [0.0; 3],
            tangential: [1e-3, -2e-3],
        }
    }

    #[test]
    fn cubic_and_linear_weights_give_back_ramps() {
        for at in [0.5, 3.0, 4.2, 7.5, 12.49] {
            let of_cubic: f64 = cubic(at, 100).iter().map(|(i, w)| *i as f64 * w).sum();
            let of_linear: f64 = linear(at, 100).iter().map(|(i, w)| *i as f64 * w).sum();
            // A ramp ends at the border, where the outermost pixel is repeated.
            if at >= 2.0 {
                assert!((of_cubic - (at - 0.5)).abs() < 1e-12, "{at}: {of_cubic}");
            }
            assert!((of_linear - (at - 0.5)).abs() < 1e-12, "{at}: {of_linear}");
        }
        assert_eq!(linear(-3.0, 5).map(|(i, _)| i), [0, 0]);
        assert_eq!(cubic(9.0, 5).map(|(i, _)| i), [4; 4]);
    }

    #[test]
    fn the_new_picture_fills_the_source_and_does_not_leave_it() {
        for (distortion, wider) in [
            (radial(-0.2, 0.05), true),
            (radial(0.15, 0.0), false),
            (Distortion::Fisheye { k: [0.0; 4] }, true),
            (Distortion::Fov { omega: 0.7 }, false),
        ] {
            let undone = Undistortion::of(&lens(distortion.clone()))
                .unwrap()
                .unwrap();
            let (mut x, mut y) = ([f64::INFINITY, 0.0], [f64::INFINITY, 0.0]);
            for j in 0..=4 * 64 {
                for i in 0..=4 * 96 {
                    let (sx, sy) = undone.source(0.25 * f64::from(i), 0.25 * f64::from(j));
                    x = [x[0].min(sx), x[1].max(sx)];
                    y = [y[0].min(sy), y[1].max(sy)];
                }
            }
            let slack = [x[0], 96.0 - x[1], y[0], 64.0 - y[1]];
            let least = slack.into_iter().fold(f64::INFINITY, f64::min);
            assert!((-1e-3..1e-3).contains(&least), "{distortion:?}: {slack:?}");
            if wider {
                assert!(undone.zoom() < 1.0, "{distortion:?}: {}", undone.zoom());
            }
        }
    }

    #[test]
    fn points_come_back_from_where_pixels_are_taken() {
        let undone = Undistortion::of(&lens(radial(-0.2, 0.05)))
            .unwrap()
            .unwrap();
        for (x, y) in [(0.5, 0.5), (90.0, 10.0), (47.0, 33.0), (12.0, 60.0)] {
            let (sx, sy) = undone.source(x, y);
            let (bx, by) = undone.point(sx, sy).unwrap();
            assert!((bx - x).hypot(by - y) < 1e-7, "{x} {y}: {bx} {by}");
        }
    }

    #[test]
    fn edges_of_depth_and_what_is_missing_stay_sharp() {
        let undone = Undistortion::of(&lens(radial(-0.2, 0.05)))
            .unwrap()
            .unwrap();
        let values = (0..96 * 64).map(|i| match i % 96 {
            0..30 => 2.0,
            30..60 => 5.0,
            _ => 0.0,
        });
        let depth = undone.depth(&Map {
            width: 96,
            height: 64,
            values: values.collect(),
        });
        let known = |z: &f32| *z == 0.0 || (z - 2.0).abs() < 1e-6 || (z - 5.0).abs() < 1e-6;
        assert!(depth.values.iter().all(known), "no depth in between");
        for wanted in [0.0, 2.0, 5.0] {
            let near = |z: &&f32| (**z - wanted).abs() < 1e-6;
            assert!(depth.values.iter().filter(near).count() > 1000, "{wanted}");
        }
    }

    #[test]
    fn pinholes_are_left_alone_and_folded_pictures_refused() {
        assert_eq!(Undistortion::of(&lens(Distortion::NONE)), Ok(None));
        assert!(Undistortion::of(&lens(radial(-3.0, 0.0))).is_err());
        assert!(Undistortion::of(&lens(radial(1e300, 1e300))).is_err());
    }
}
