//! How much the frames of a video differ in sharpness. A blur that never changes cannot be told from a blurry world; one that
//! changes shows in the frames before anything is trained.

use crate::correspondence::{Shared, is_still, pair_changes, shared};
use crate::statistics::median;
use io::{Frame, Image};
use splat_core::Camera;

/// Of the pairs of frames of a sharp video nine in ten differ in the fine contrast of what both see by less than this (the
/// logarithm's change). Measured in docs/SURVEY.md.
const SHARP: f64 = 0.15;
/// Neighbouring frames of a sharp video see nearly the same, and the contrast of all that they see differs by less than this
/// (median of the logarithm's change).
const SHARP_AS_A_WHOLE: f64 = 0.07;

/// About so many pixels of a frame are looked up, evenly spread; up to four times as many where all are.
const PIXELS: usize = 50_000;
/// Fewer pixels that two frames share say too little.
const LEAST_SHARED: usize = 200;
/// What is seen s times as large has squared second differences that are smaller by s at edges, and by the fourth power of s where
/// it is smooth.
const ENLARGED: f64 = 4.0;

/// Variance of a second difference of values that were rounded to 1/255.
const ROUNDING: f64 = 6.0 / 12.0 / (255.0 * 255.0);

/// How frames differ in sharpness, as factors' logarithms.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SharpnessChange {
    /// How much nine in ten pairs of frames differ at most in the fine contrast of what both see, as far as its distance does not
    /// explain that. `None` where too little is known in depth.
    pub(crate) shared: Option<f64>,
    /// Median change of the fine contrast of all that is seen from a frame to the next. `None` with less than three frames or
    /// where movers fill them.
    pub(crate) whole: Option<f64>,
}

impl SharpnessChange {
    /// Of a video's frames, outside of the movers.
    pub(crate) fn of(frames: &[Frame]) -> Self {
        Self {
            shared: pair_changes(frames, shared_change).map(|changes| changes.most),
            whole: whole_change(frames),
        }
    }

    /// Whether they are blurred, as far as can be told; where it cannot they may be.
    pub(crate) fn is_blurred(self) -> bool {
        match (self.shared, self.whole) {
            (Some(change), _) => change > SHARP,
            (None, Some(change)) => change > SHARP_AS_A_WHOLE,
            (None, None) => true,
        }
    }
}

/// Size of the change of the fine contrast of what two frames share: of the mean squared second differences along rows and columns.
fn shared_change(a: &Frame, b: &Frame) -> Option<f64> {
    let Image { width, height, .. } = a.view.image;
    let step = (width * height / PIXELS).isqrt().max(1);
    let (mut count, mut sums, mut enlarged) = (0_usize, [0.0; 2], 0.0);
    for Shared { pixels, depths } in shared(a, b, step)? {
        let Some(here) = fineness(a, pixels[0]) else {
            continue;
        };
        let Some(there) = fineness(b, pixels[1]) else {
            continue;
        };
        count += 1;
        sums[0] += here;
        sums[1] += there;
        enlarged += (depths[0] / depths[1]).ln();
    }
    if count < LEAST_SHARED {
        return None;
    }
    let mean = |sum: f64| sum / count as f64;
    let [before, after] = sums.map(|sum| (mean(sum) + 2.0 * ROUNDING).ln());
    let focal = |camera: &Camera| (camera.fx * camera.fy).sqrt();
    let enlarged = mean(enlarged) + (focal(&b.view.camera) / focal(&a.view.camera)).ln();
    let most = -ENLARGED * enlarged;
    let change = after - before;
    Some((change - change.clamp(most.min(0.0), most.max(0.0))).abs())
}

/// Squared second differences of the picture at a pixel, along its row and its column; `None` at the border and beside what is masked.
fn fineness(frame: &Frame, pixel: usize) -> Option<f64> {
    let Image { width, height, .. } = frame.view.image;
    let (x, y) = (pixel % width, pixel / width);
    let inside = (1..width.saturating_sub(1)).contains(&x);
    if !inside || !(1..height.saturating_sub(1)).contains(&y) {
        return None;
    }
    let around = [pixel - 1, pixel, pixel + 1, pixel - width, pixel + width];
    let is_still = around.iter().all(|k| is_still(frame, *k));
    is_still.then(|| {
        let along = |step| second_difference(&frame.view.image, pixel, step).powi(2);
        along(1) + along(width)
    })
}

/// Median change of the fine contrast from a frame to the next: of the mean squared second differences along rows and along columns.
fn whole_change(frames: &[Frame]) -> Option<f64> {
    let contrasts: Vec<[Option<f64>; 2]> = frames
        .iter()
        .map(|frame| [true, false].map(|rows| contrast(frame, rows)))
        .collect();
    let pairs = contrasts.windows(2).flat_map(|pair| {
        let axes = pair[0].iter().zip(&pair[1]);
        axes.filter_map(|(a, b)| Some(((*a)? - (*b)?).abs()))
    });
    let changes: Vec<f64> = pairs.collect();
    (changes.len() >= 4).then(|| median(&changes))
}

/// Logarithm of the mean squared second difference along rows or columns.
fn contrast(frame: &Frame, rows: bool) -> Option<f64> {
    let Image { width, height, .. } = frame.view.image;
    let step = if rows { 1 } else { width };
    let (mut sum, mut count) = (0.0, 0);
    let [across, down] = if rows { [1, 0] } else { [0, 1] };
    for y in down..height.saturating_sub(down) {
        for x in across..width.saturating_sub(across) {
            let i = y * width + x;
            if [i - step, i, i + step].iter().all(|k| is_still(frame, *k)) {
                sum += second_difference(&frame.view.image, i, step).powi(2);
                count += 1;
            }
        }
    }
    (count > 0).then(|| (sum / f64::from(count) + ROUNDING).ln())
}

/// Of grey values at a pixel and `step` before and behind it.
fn second_difference(image: &Image, pixel: usize, step: usize) -> f64 {
    let gray = |i: usize| {
        let color = &image.pixels[3 * i..3 * i + 3];
        color.iter().copied().map(f64::from).sum::<f64>() / 3.0
    };
    2.0 * gray(pixel) - gray(pixel - step) - gray(pixel + step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec2, DVec3};
    use io::{Map, View};

    const SIZE: [usize; 2] = [96, 64];

    /// A wall at z = 0 as a camera sees it from a place before it, through a box of `blur` px along rows: waves of many lengths,
    /// and edges.
    fn frame(place: DVec3, blur: usize) -> Frame {
        let [width, height] = SIZE;
        let camera = Camera::pinhole(SIZE, [80.0; 2], [48.0, 32.0]);
        let wave = |x: f64, y: f64| {
            let edge = f64::from(u8::from((3.0 * x + y).sin() > 0.3));
            0.4 + 0.1 * (37.0 * x).sin() + 0.1 * (29.0 * y + 8.0 * x).cos() + 0.2 * edge
        };
        let value = |i: usize| {
            let taps = (0..blur).map(|k| {
                let x = (i % width) as f64 + 0.5 + k as f64 - 0.5 * (blur - 1) as f64;
                let at = DVec2::new(x, (i / width) as f64 + 0.5);
                let seen = place + camera.unproject(at, -place.z);
                wave(seen.x, seen.y)
            });
            (taps.sum::<f64>() / blur as f64) as f32
        };
        let pixels = (0..width * height).flat_map(|i| [value(i); 3]);
        Frame {
            view: View {
                name: String::new(),
                cam_from_world: DAffine3::from_translation(-place),
                time: 0.0,
                image: Image {
                    width,
                    height,
                    pixels: pixels.collect(),
                },
                camera: camera.clone(),
            },
            depth: Some(Map {
                width,
                height,
                values: vec![-place.z as f32; width * height],
            }),
            mask: None,
        }
    }

    fn beside(k: usize) -> DVec3 {
        DVec3::new(0.05 * k as f64, 0.02 * (k % 3) as f64, -4.0)
    }

    fn change(frames: usize, blurs: impl Fn(usize) -> usize) -> [SharpnessChange; 2] {
        let mut frames: Vec<_> = (0..frames).map(|k| frame(beside(k), blurs(k))).collect();
        let known = SharpnessChange::of(&frames);
        frames.iter_mut().for_each(|frame| frame.depth = None);
        [known, SharpnessChange::of(&frames)]
    }

    #[test]
    fn frames_that_are_equally_sharp_or_equally_blurred_do_not_differ() {
        for blur in [1, 3] {
            let changes = change(16, |_| blur);
            assert!(changes[0].shared.is_some() && changes[1].shared.is_none());
            for change in changes {
                assert!(!change.is_blurred(), "{blur}: {change:?}");
            }
        }
    }

    #[test]
    fn frames_that_are_blurred_by_turns_differ() {
        for change in change(16, |k| 1 + k % 3) {
            assert!(change.is_blurred(), "{change:?}");
        }
    }

    /// What differs little from a frame to the next, or in few of them, is told by depth.
    #[test]
    fn a_slow_change_and_one_of_a_few_frames_are_told() {
        let [slow, _] = change(32, |k| 1 + k / 8);
        assert!(slow.is_blurred(), "{slow:?}");
        let [few, whole] = change(24, |k| if (9..13).contains(&k) { 4 } else { 1 });
        assert!(few.is_blurred(), "{few:?}");
        assert!(!whole.is_blurred(), "as a whole it is not: {whole:?}");
    }

    /// A wall that fills more and more of the picture has less contrast from pixel to pixel, and is as sharp.
    #[test]
    fn what_comes_nearer_is_no_blur() {
        for step in [0.12, -0.12] {
            let place = |k: usize| DVec3::new(0.0, 0.0, -5.0 + step * k as f64);
            let frames: Vec<_> = (0..16).map(|k| frame(place(k), 1)).collect();
            let change = SharpnessChange::of(&frames);
            assert!(!change.is_blurred(), "{step}: {change:?}");
            let bare = frames.first().zip(frames.last()).and_then(|(a, b)| {
                let [a, b] = [a, b].map(|f| contrast(f, true));
                Some((a? - b?).abs())
            });
            assert!(bare.is_some_and(|bare| bare > SHARP), "{step}: {bare:?}");
        }
    }

    #[test]
    fn depth_without_end_or_that_is_no_number_is_not_known() {
        let mut frames: Vec<_> = (0..6).map(|k| frame(beside(k), 1)).collect();
        let maps = frames.iter_mut().filter_map(|frame| frame.depth.as_mut());
        for (map, z) in maps.zip([f32::INFINITY, f32::NAN].into_iter().cycle()) {
            map.values.fill(z);
        }
        assert_eq!(SharpnessChange::of(&frames).shared, None);
    }

    #[test]
    fn movers_do_not_count_and_black_frames_do_not_either() {
        let mut frames: Vec<_> = (0..6).map(|k| frame(beside(k), 1 + k % 3)).collect();
        for frame in &mut frames {
            let [width, height] = SIZE;
            frame.mask = Some(Map {
                width,
                height,
                values: vec![1.0; width * height],
            });
        }
        let nothing = SharpnessChange::of(&frames);
        assert_eq!((nothing.shared, nothing.whole), (None, None));
        assert!(nothing.is_blurred(), "it may be");
        for frame in &mut frames {
            frame.mask = None;
            frame.view.image.pixels.fill(0.0);
        }
        let black = SharpnessChange::of(&frames);
        assert_eq!((black.shared, black.whole), (Some(0.0), Some(0.0)));
        let two = SharpnessChange::of(&frames[..2]);
        assert_eq!((two.shared, two.whole), (None, None));
    }
}
