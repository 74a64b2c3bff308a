//! `blur.png`: blurry frame, sharp render, and how it was blurred: an intensity map and the kernels at a few pixels, or
//! the camera's path and its discs at a few pixels and depths.

use io::Image;
use trainer::{KernelView, TakenView, TrainingView, ViewBlur};

/// Kernels are shown for so many pixels of a frame.
const COLUMNS: usize = 8;
/// Gap between pictures, px.
const GAP: usize = 2;

/// The frames that a sheet shows: a few, spread over time.
pub(crate) fn frames(count: usize) -> Vec<usize> {
    let mut frames: Vec<usize> = (0..4).map(|i| (2 * i + 1) * count / 8).collect();
    frames.dedup();
    frames
}

/// One frame's row of the sheet, without the blurry frame where that is not at hand; `None` where blur is not modelled.
pub(crate) fn row(blurry: Option<&Image>, view: &TrainingView) -> Option<Image> {
    match view.blur.as_ref()? {
        ViewBlur::Kernels(kernels) => Some(kernel_row(blurry, &view.sharp, kernels)),
        ViewBlur::Camera(camera) => Some(camera_row(blurry, &view.sharp, camera)),
        ViewBlur::Both(camera, kernels) => stack(&[
            camera_row(blurry, &view.sharp, camera),
            kernel_row(None, &view.sharp, kernels),
        ]),
    }
}

fn kernel_row(blurry: Option<&Image>, sharp: &Image, view: &KernelView) -> Image {
    let (intensity, kernels) = (&view.intensity, &view.kernels);
    let (width, height) = (sharp.width, sharp.height);
    let pictures: Vec<&Image> = blurry.into_iter().chain([sharp]).collect();
    let shown = pictures.len() + 1;
    let across = shown * width + (shown - 1) * GAP;
    let size = (kernels.len() / (width * height)).isqrt();
    let zoom = (across / COLUMNS / (size + 1)).clamp(1, 16);
    let strip = size * zoom + GAP;
    let mut sheet = canvas(
        across.max(COLUMNS * (size * zoom + GAP)),
        height + GAP + 3 * strip,
    );
    for (i, picture) in pictures.iter().enumerate() {
        paste(&mut sheet, i * (width + GAP), 0, picture);
    }
    let left = pictures.len() * (width + GAP);
    for (i, &m) in intensity.values.iter().enumerate() {
        put(&mut sheet, left + i % width, i / width, [m; 3]);
    }
    for gy in 0..3 {
        for gx in 0..COLUMNS {
            let (x, y) = (
                (2 * gx + 1) * width / (2 * COLUMNS),
                (2 * gy + 1) * height / 6,
            );
            let at = (y * width + x) * size * size;
            let kernel = &kernels[at..at + size * size];
            let largest = kernel.iter().fold(1e-12_f32, |a, &b| a.max(b));
            for v in 0..size * zoom {
                for u in 0..size * zoom {
                    let value = kernel[v / zoom * size + u / zoom] / largest;
                    put(
                        &mut sheet,
                        gx * (size * zoom + GAP) + u,
                        height + GAP + gy * strip + v,
                        [value; 3],
                    );
                }
            }
        }
    }
    sheet
}

/// Blurry frame, sharp render, and what points become in the picture, many times enlarged: their discs, drawn along the camera's
/// path. A row for each depth, from near to far; on the left, in the middle and on the right of the picture.
fn camera_row(blurry: Option<&Image>, sharp: &Image, view: &TakenView) -> Image {
    let (width, height) = (sharp.width, sharp.height);
    let pictures: Vec<&Image> = blurry.into_iter().chain([sharp]).collect();
    let pairs = view.spots.windows(2);
    let across = 1 + pairs
        .take_while(|pair| pair[0].right_px < pair[1].right_px)
        .count();
    let side = height / (view.spots.len() / across).max(1);
    let mut sheet = canvas(pictures.len() * (width + GAP) + across * side, height);
    for (i, picture) in pictures.iter().enumerate() {
        paste(&mut sheet, i * (width + GAP), 0, picture);
    }
    let left = pictures.len() * (width + GAP);
    let reach = view.reach_px().max(1.0);
    for (at, spot) in view.spots.iter().enumerate() {
        let mut counts = vec![0.0_f32; side * side];
        for place in &spot.places {
            let [x, y] = place.map(|v| (0.5 + 0.45 * v / reach) * side as f64);
            let (x, y) = (x as usize, y as usize);
            if x < side && y < side {
                counts[y * side + x] += 1.0;
            }
        }
        let most = counts.iter().fold(1.0_f32, |a, &b| a.max(b));
        for (i, count) in counts.iter().enumerate() {
            let value = (count / most).sqrt();
            put(
                &mut sheet,
                left + at % across * side + i % side,
                at / across * side + i / side,
                [value; 3],
            );
        }
    }
    sheet
}

/// Rows one under the other; `None` for none.
pub(crate) fn stack(rows: &[Image]) -> Option<Image> {
    let width = rows.iter().map(|r| r.width).max()?;
    let mut sheet = canvas(width, rows.iter().map(|r| r.height + 2 * GAP).sum());
    let mut y = 0;
    for row in rows {
        paste(&mut sheet, 0, y, row);
        y += row.height + 2 * GAP;
    }
    Some(sheet)
}

fn canvas(width: usize, height: usize) -> Image {
    Image {
        width,
        height,
        pixels: [0.1, 0.1, 0.25].repeat(width * height),
    }
}

fn put(image: &mut Image, x: usize, y: usize, color: [f32; 3]) {
    let at = 3 * (y * image.width + x);
    image.pixels[at..at + 3].copy_from_slice(&color);
}

fn paste(image: &mut Image, x: usize, y: usize, from: &Image) {
    for v in 0..from.height {
        let at = 3 * ((y + v) * image.width + x);
        image.pixels[at..at + 3 * from.width]
            .copy_from_slice(&from.pixels[3 * v * from.width..3 * (v + 1) * from.width]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use trainer::{CameraFrame, Spot};

    #[test]
    fn spots_stand_by_depth_and_by_place_and_where_their_light_falls() {
        let (width, height) = (30, 24);
        // At two depths, one of them twice as near, and three places each: light that falls above or below the middle.
        let spot = |depth: f64, right_px: f64, y: f64| Spot {
            depth,
            right_px,
            places: vec![[0.0, y]],
        };
        let ys = [-2.0, 1.0, 2.0, -1.0, 0.0, 1.0];
        let view = TakenView {
            frame: CameraFrame {
                blur_px: 2.0,
                focus: 1.0,
                disc_px: 0.0,
                samples: 3,
                psnr: None,
            },
            shutter: 0.5,
            aperture: 0.0,
            spots: (0..6)
                .map(|i| spot([1.0, 2.0][i / 3], [-9.0, 0.0, 9.0][i % 3], ys[i]))
                .collect(),
        };
        let sharp = canvas(width, height);
        let sheet = camera_row(None, &sharp, &view);
        let side = height / 2;
        assert_eq!(
            [sheet.width, sheet.height],
            [width + GAP + 3 * side, height]
        );
        for (i, y) in ys.iter().enumerate() {
            let (left, top) = (width + GAP + i % 3 * side, i / 3 * side);
            let lit: Vec<[usize; 2]> = (0..side * side)
                .map(|k| [k % side, k / side])
                .filter(|[u, v]| sheet.pixels[3 * ((top + v) * sheet.width + left + u)] == 1.0)
                .collect();
            let [[u, v]] = lit[..] else {
                panic!("spot {i}: {lit:?}");
            };
            assert_eq!(u, side / 2, "spot {i}");
            let expected = (0.5 + 0.45 * y / 2.0) * side as f64;
            assert_eq!(v, expected as usize, "spot {i}");
        }
    }
}
