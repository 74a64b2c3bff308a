//! Other sizes of pictures, maps and cameras.

use splat_core::{Camera, CameraModel};

use crate::{Image, Map};

/// Averages F x F blocks of a picture. What does not fill a block at the right and at the bottom is
/// cropped. `factor` is at least 1, which changes nothing, and at most the picture's smaller side.
#[must_use]
pub fn shrink_image(image: Image, factor: usize) -> Image {
    if factor == 1 {
        return image;
    }
    let (width, height) = (image.width / factor, image.height / factor);
    let mut pixels = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        for x in 0..width {
            let mut sum = [0.0f64; 3];
            for (sy, sx) in block(x, y, factor) {
                let at = (sy * image.width + sx) * 3;
                for c in 0..3 {
                    sum[c] += f64::from(image.pixels[at + c]);
                }
            }
            pixels.extend(sum.map(|s| (s / (factor * factor) as f64) as f32));
        }
    }
    Image {
        width,
        height,
        pixels,
    }
}

/// Averages F x F blocks of a map, as [`shrink_image`] does.
pub(crate) fn shrink_map(map: Map, factor: usize) -> Map {
    shrink(map, factor, |values| {
        let sum: f64 = values.map(f64::from).sum();
        (sum / (factor * factor) as f64) as f32
    })
}

/// Shrinks a z-depth map (0 = missing) by the mean **disparity** of each block's valid pixels; a block
/// without any is missing. Disparity, because it is what an estimator smooths at edges, and because a
/// block across an edge then leans towards the nearer surface, which is the one that is seen.
pub(crate) fn shrink_depth(depth: Map, factor: usize) -> Map {
    shrink(depth, factor, |values| {
        let (mut sum, mut valid) = (0.0f64, 0);
        for z in values.filter(|&z| z > 0.0) {
            sum += 1.0 / f64::from(z);
            valid += 1;
        }
        if valid == 0 {
            0.0
        } else {
            (f64::from(valid) / sum) as f32
        }
    })
}

fn shrink(map: Map, factor: usize, mean: impl Fn(&mut dyn Iterator<Item = f32>) -> f32) -> Map {
    if factor == 1 {
        return map;
    }
    let (width, height) = (map.width / factor, map.height / factor);
    let mut values = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let mut of_block = block(x, y, factor).map(|(sy, sx)| map.values[sy * map.width + sx]);
            values.push(mean(&mut of_block));
        }
    }
    Map {
        width,
        height,
        values,
    }
}

/// Source pixels (row, column) of block (x, y), row by row.
fn block(x: usize, y: usize, factor: usize) -> impl Iterator<Item = (usize, usize)> {
    (y * factor..(y + 1) * factor)
        .flat_map(move |sy| (x * factor..(x + 1) * factor).map(move |sx| (sy, sx)))
}

/// Nearest-neighbour resize: depth has edges that must not be averaged.
pub(crate) fn resize_nearest(map: &Map, width: usize, height: usize) -> Map {
    let mut values = Vec::with_capacity(width * height);
    for y in 0..height {
        // The source pixel under the target pixel's centre.
        let sy = (2 * y + 1) * map.height / (2 * height);
        for x in 0..width {
            let sx = (2 * x + 1) * map.width / (2 * width);
            values.push(map.values[sy * map.width + sx]);
        }
    }
    Map {
        width,
        height,
        values,
    }
}

/// The camera of a picture that was shrunk by [`shrink_image`].
pub(crate) fn shrink_camera(camera: &Camera, factor: usize) -> Camera {
    let size = (camera.width / factor, camera.height / factor);
    scaled(camera, size, |x| x / factor as f64, |y| y / factor as f64)
}

/// The camera of the same picture at another size.
pub(crate) fn resize_camera(camera: &Camera, width: usize, height: usize) -> Camera {
    let sx = width as f64 / camera.width as f64;
    let sy = height as f64 / camera.height as f64;
    scaled(camera, (width, height), |x| x * sx, |y| y * sy)
}

/// With pixel centres at + 0.5 a resize is a plain scaling of all pixel coordinates.
fn scaled(
    camera: &Camera,
    (width, height): (usize, usize),
    x: impl Fn(f64) -> f64,
    y: impl Fn(f64) -> f64,
) -> Camera {
    match camera.model {
        CameraModel::Pinhole => {
            let (fx, fy, cx, cy) = (x(camera.fx), y(camera.fy), x(camera.cx), y(camera.cy));
            Camera::pinhole([width, height], [fx, fy], [cx, cy]).with_near(camera.near)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn area_filter_of_a_ramp_is_the_ramp() {
        // p(x, y) = a x + b y at pixel centres; a block's mean is the ramp at the block's centre.
        let ramp = |x: f64, y: f64| 0.01 * x + 0.02 * y;
        let (width, height, factor) = (11, 7, 3);
        let mut image = Image {
            width,
            height,
            pixels: Vec::new(),
        };
        for y in 0..height {
            for x in 0..width {
                let v = ramp(x as f64 + 0.5, y as f64 + 0.5) as f32;
                image.pixels.extend([v, 0.5 * v, 1.0 - v]);
            }
        }
        let small = shrink_image(image, factor);
        assert_eq!(
            (small.width, small.height),
            (3, 2),
            "remainders are cropped"
        );
        for y in 0..small.height {
            for x in 0..small.width {
                let f = factor as f64;
                let v = ramp((x as f64 + 0.5) * f, (y as f64 + 0.5) * f) as f32;
                let at = (y * small.width + x) * 3;
                for (got, want) in small.pixels[at..at + 3].iter().zip([v, 0.5 * v, 1.0 - v]) {
                    assert!((got - want).abs() < 1e-6, "{got} is not {want}");
                }
            }
        }
    }

    #[test]
    fn depth_averages_the_disparity_of_valid_pixels() {
        let depth = Map {
            width: 4,
            height: 2,
            values: vec![2.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0],
        };
        let small = shrink_depth(depth, 2);
        let mean = 1.0 / ((1.0 / 2.0 + 1.0 / 4.0) / 2.0);
        assert_eq!(small.values, [mean, 0.0]);
    }

    #[test]
    fn shrunk_and_resized_cameras_see_the_same_rays() {
        let camera = Camera::pinhole([64, 48], [50.0, 51.0], [31.0, 25.5]);
        let point = DVec3::new(0.3, -0.2, 2.0);
        let pixel = camera.project(point);
        assert!((shrink_camera(&camera, 2).project(point) * 2.0 - pixel).length() < 1e-12);
        assert!((resize_camera(&camera, 32, 24).project(point) * 2.0 - pixel).length() < 1e-12);
    }

    #[test]
    fn nearest_repeats_and_skips_pixels() {
        let map = Map {
            width: 2,
            height: 1,
            values: vec![1.0, 2.0],
        };
        assert_eq!(resize_nearest(&map, 4, 1).values, [1.0, 1.0, 2.0, 2.0]);
        assert_eq!(resize_nearest(&map, 1, 1).values, [2.0]);
    }
}
