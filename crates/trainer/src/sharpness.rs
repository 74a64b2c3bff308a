//! How much the frames of a video differ in sharpness. A blur that never changes cannot be told from a blurry world; one that
//! changes shows in the frames before anything is trained.

use crate::statistics::median;
use io::{Frame, Image, Map};

/// Neighbouring frames of a sharp video see nearly the same, and their contrast differs by less than this (median of the
/// logarithm's change).
const SHARP: f64 = 0.07;

/// Variance of a second difference of values that were rounded to 1/255.
const ROUNDING: f64 = 6.0 / 12.0 / (255.0 * 255.0);

/// Median change of the fine contrast from a frame to the next, as a factor's logarithm: of the mean squared second
/// differences along rows and along columns, outside of the movers. `None` with less than three frames or where movers fill
/// them.
pub(crate) fn sharpness_change(frames: &[Frame]) -> Option<f64> {
    let contrasts: Vec<[Option<f64>; 2]> = frames
        .iter()
        .map(|frame| {
            [true, false].map(|rows| contrast(&frame.view.image, frame.mask.as_ref(), rows))
        })
        .collect();
    let pairs = contrasts.windows(2).flat_map(|pair| {
        let axes = pair[0].iter().zip(&pair[1]);
        axes.filter_map(|(a, b)| Some(((*a)? - (*b)?).abs()))
    });
    let changes: Vec<f64> = pairs.collect();
    (changes.len() >= 4).then(|| median(&changes))
}

/// Whether frames that differ so much in sharpness are blurred.
pub(crate) fn is_blurred(change: f64) -> bool {
    change > SHARP
}

/// Logarithm of the mean squared second difference along rows or columns.
fn contrast(image: &Image, mask: Option<&Map>, rows: bool) -> Option<f64> {
    let (width, height) = (image.width, image.height);
    let step = if rows { 1 } else { width };
    let still = |i: usize| mask.is_none_or(|mask| mask.values[i] < 0.5);
    let gray = |i: usize| {
        let pixel = &image.pixels[3 * i..3 * i + 3];
        pixel.iter().copied().map(f64::from).sum::<f64>() / 3.0
    };
    let (mut sum, mut count) = (0.0, 0);
    let [across, down] = if rows { [1, 0] } else { [0, 1] };
    for y in down..height.saturating_sub(down) {
        for x in across..width.saturating_sub(across) {
            let i = y * width + x;
            let [before, after] = [i - step, i + step];
            if still(before) && still(i) && still(after) {
                sum += (2.0 * gray(i) - gray(before) - gray(after)).powi(2);
                count += 1;
            }
        }
    }
    (count > 0).then(|| (sum / f64::from(count) + ROUNDING).ln())
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DAffine3;
    use io::View;
    use splat_core::Camera;

    /// A frame of waves that were blurred along rows by a box of `blur` px.
    fn frame(blur: usize, shift: f64) -> Frame {
        let (width, height) = (48, 32);
        let wave = |x: f64, y: f64| 0.5 + 0.2 * (1.3 * x).sin() + 0.2 * (1.1 * y + 0.4 * x).cos();
        let value = |i: usize| {
            let (x, y) = ((i % width) as f64 + shift, (i / width) as f64);
            let taps = (0..blur).map(|k| wave(x + k as f64, y));
            (taps.sum::<f64>() / blur as f64) as f32
        };
        let pixels = (0..width * height).flat_map(|i| [value(i); 3]);
        Frame {
            view: View {
                name: String::new(),
                camera: Camera::pinhole([width, height], [40.0; 2], [24.0, 16.0]),
                cam_from_world: DAffine3::IDENTITY,
                time: 0.0,
                image: Image {
                    width,
                    height,
                    pixels: pixels.collect(),
                },
            },
            depth: None,
            mask: None,
        }
    }

    fn change(blurs: impl Fn(usize) -> usize) -> Option<f64> {
        let frames: Vec<_> = (0..8).map(|k| frame(blurs(k), 0.7 * k as f64)).collect();
        sharpness_change(&frames)
    }

    #[test]
    fn frames_that_are_equally_sharp_or_equally_blurred_do_not_differ() {
        for blur in [1, 3] {
            let change = change(|_| blur).expect("frames enough");
            assert!(!is_blurred(change), "{blur}: {change}");
        }
    }

    #[test]
    fn frames_that_are_blurred_by_turns_differ() {
        let change = change(|k| 1 + k % 3).expect("frames enough");
        assert!(is_blurred(change), "{change}");
    }

    #[test]
    fn movers_do_not_count_and_black_frames_do_not_either() {
        let mut frames: Vec<_> = (0..6).map(|k| frame(1 + k % 3, 0.0)).collect();
        for frame in &mut frames {
            let (width, height) = (frame.view.image.width, frame.view.image.height);
            frame.mask = Some(Map {
                width,
                height,
                values: vec![1.0; width * height],
            });
        }
        assert_eq!(sharpness_change(&frames), None);
        for frame in &mut frames {
            frame.mask = None;
            frame.view.image.pixels.fill(0.0);
        }
        assert_eq!(sharpness_change(&frames), Some(0.0));
        assert_eq!(sharpness_change(&frames[..2]), None);
    }
}
