//! How well a reading of depth and poses agrees with points and pictures.

use super::reading::{Masks, Reading, readings};
use crate::alignment::{DisparityFit, MIN_POINTS, points_from};
use crate::correspondence::{every, seen_in};
use crate::lifting::sample_color;
use crate::placement::pixel_color;
use crate::statistics::median;
use crate::views::{pixel_index, seen_at};
use glam::{DAffine3, DVec3};
use io::Scene;
use splat_core::Camera;

/// About so many pixels of a picture are looked up in another.
const LOOKED_UP: usize = 4000;
/// At most so many pairs of frames are compared.
const PAIRS: usize = 48;
/// … and so many where a scale is looked for.
const FEW_PAIRS: usize = 6;
/// … of so many between one and ten times another.
const SCALES_PER_DECADE: f64 = 8.0;
/// Of so many pixels one is enough for a frame's median depth.
const SPARSE: usize = 17;
/// Pairs that share fewer pixels than this share of those with depth say nothing.
const LEAST_SHARED: f64 = 0.1;
/// Frames that are moved to where they differ more, by this factor, than unmoved ones are moved by no rule at all.
const NOT_AT_ALL: f64 = 2.0;
/// Pixels that go less far say nothing of poses, px.
pub(super) const LEAST_SHIFT: f64 = 1.0;
/// A reading that disagrees by less than this share of another is clearly better.
const CLEARLY: f64 = 0.7;
/// Masks that cover more of the pictures than this rather show what is still.
const MOST: f64 = 0.5;
/// Points whose colour is compared in a frame, at most.
const COLORED: usize = 500;

/// How a frame's depth goes with the sparse points, over all frames.
#[derive(Clone, Debug)]
pub(super) struct PointFit {
    /// Frames that see enough points.
    pub(super) frames: usize,
    /// Those of them where near and far are exchanged.
    pub(super) upside_down: usize,
    /// Median share by which disparity, aligned frame by frame, misses that of the points.
    pub(super) error: f64,
    /// The same for a frame's median disparity in the place of its depth.
    pub(super) spread: f64,
    /// Least and largest scale of the frames' alignment.
    pub(super) scales: [f64; 2],
}

/// How frames, warped to others by depth and pose, resemble them.
#[derive(Clone, Debug)]
pub(super) struct WarpFit {
    /// Pairs of frames that share enough; where none does, the rest is as by chance.
    pub(super) pairs: usize,
    /// Difference to the other frame, as a share of that of the unwarped frame, over all pairs.
    pub(super) ratio: f64,
    /// Difference where the mask says that things move, over that elsewhere; `None` without enough of both.
    pub(super) moving: Option<f64>,
    /// How far pixels go at the median, px.
    pub(super) shift_px: f64,
}

/// How points, projected into the frames, have the pictures' colours.
#[derive(Clone, Debug)]
pub(super) struct ColorFit {
    /// Share of the points that some frame has in its picture.
    pub(super) seen: f64,
    /// Median difference of colours, as a share of that between points and other points' places; `None` where points have one
    /// colour all, which tells nothing, and 1 where no frame sees any.
    pub(super) ratio: Option<f64>,
}

/// What a reading makes of a scene.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub(super) reading: Reading,
    pub(super) points: Option<PointFit>,
    pub(super) warp: Option<WarpFit>,
    pub(super) colors: Option<ColorFit>,
    /// How each frame's depth is aligned to the points; `None` where it is not.
    alignments: Vec<Option<DisparityFit>>,
    /// What depth that is not aligned is multiplied by.
    pub(super) scale: f64,
}

impl Fit {
    /// How little the inputs agree in this reading: 0 in full, 1 and more as if by chance.
    pub(super) fn disagreement(&self) -> Option<f64> {
        let measures = [
            self.points.as_ref().map(PointFit::disagreement),
            self.warp.as_ref().map(|w| w.ratio.min(NOT_AT_ALL)),
            self.colors.as_ref().and_then(|c| Some(c.ratio?.min(1.0))),
        ];
        let known: Vec<f64> = measures.into_iter().flatten().collect();
        (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
    }

    /// z-depth of a frame's pixel, aligned to the points; 0 where it is missing.
    pub(super) fn depth(&self, scene: &Scene, frame: usize, pixel: usize) -> f64 {
        let z = self.reading.depth(&scene.frames[frame], pixel);
        match &self.alignments[frame] {
            Some(fit) if z > 0.0 => fit.depth(z),
            _ => self.scale * z,
        }
    }

    /// Whether depth is multiplied by more than lies between scales that are tried.
    pub(super) fn is_rescaled(&self) -> bool {
        self.scale.log10().abs() > 0.5 / SCALES_PER_DECADE
    }

    /// Pose of a frame's camera.
    pub(super) fn pose(&self, scene: &Scene, frame: usize) -> DAffine3 {
        self.reading.pose(&scene.frames[frame])
    }
}

impl PointFit {
    /// 0 where depth and points agree, 1 where depth says nothing of the points, or the contrary of what it should.
    pub(super) fn disagreement(&self) -> f64 {
        let upside_down = self.upside_down as f64 / self.frames.max(1) as f64;
        (self.error / self.spread.max(1e-9))
            .min(1.0)
            .max(upside_down)
    }
}

fn has_depth(scene: &Scene) -> bool {
    scene.frames.iter().any(|f| f.depth.is_some())
}

/// What each reading makes of a scene, whose masks say that such a share of it moves (`None` where there are none or they are left
/// out); as given first. Where that is most of the pictures, the rest is what moves, unless pictures differ more where the masks
/// are.
pub(super) fn fits(scene: &Scene, moving_share: Option<f64>) -> Vec<Fit> {
    let has_depth = has_depth(scene);
    let free_scale = has_depth && scene.points.len() < MIN_POINTS;
    let moves_on_masks = || {
        let as_given = readings(scene.layout, Masks::Moving, free_scale);
        let as_given = as_given.into_iter().next();
        let warp = as_given.and_then(|reading| fit(scene, reading).warp);
        warp.and_then(|warp| warp.moving)
            .is_some_and(|moving| moving > 1.0)
    };
    let masks = match moving_share {
        None => Masks::Nothing,
        Some(share) if share > MOST && !moves_on_masks() => Masks::Still,
        Some(_) => Masks::Moving,
    };
    let mut readings = readings(scene.layout, masks, free_scale);
    if !has_depth {
        readings.retain(|r| !r.inverse_depth);
    }
    readings.into_iter().map(|r| fit(scene, r)).collect()
}

/// The reading in which the inputs agree best, if that is clearly better than as given.
pub(super) fn better(fits: &[Fit]) -> Option<&Fit> {
    let given = fits.first()?.disagreement()?;
    let others = fits[1..].iter();
    let known = others.filter_map(|fit| Some((fit, fit.disagreement()?)));
    let (best, found) = known.min_by(|a, b| a.1.total_cmp(&b.1))?;
    (found < CLEARLY * given).then_some(best)
}

fn fit(scene: &Scene, reading: Reading) -> Fit {
    let (points, alignments) = fit_points(scene, &reading);
    let mut fit = Fit {
        reading,
        points,
        warp: None,
        colors: fit_colors(scene, &reading),
        alignments,
        scale: 1.0,
    };
    if reading.free_scale {
        fit.scale = best_scale(scene, &fit);
    }
    fit.warp = fit_warp(scene, &fit, PAIRS);
    fit
}

/// The scale of depth with which frames are moved best, from where depth is as far as cameras are apart to a thousand times that.
fn best_scale(scene: &Scene, fit: &Fit) -> f64 {
    let frames = 0..scene.frames.len();
    let centers: Vec<DVec3> = frames
        .clone()
        .map(|k| fit.pose(scene, k).inverse().translation)
        .collect();
    let steps: Vec<f64> = centers.windows(2).map(|c| c[0].distance(c[1])).collect();
    let depths = frames.filter_map(|k| {
        let pixels = scene.frames[k].depth.as_ref()?.values.len();
        let known = (0..pixels).step_by(SPARSE).map(|i| fit.depth(scene, k, i));
        let known: Vec<f64> = known.filter(|z| *z > 0.0).collect();
        (!known.is_empty()).then(|| median(&known))
    });
    let depths: Vec<f64> = depths.collect();
    if steps.is_empty() || depths.is_empty() || median(&steps) <= 0.0 {
        return 1.0;
    }
    let unit = median(&steps) / median(&depths);
    let scales = (0..=24).map(|k| unit * 10_f64.powf(f64::from(k) / SCALES_PER_DECADE));
    let ratio = |scale: f64| {
        let scaled = Fit {
            scale,
            ..fit.clone()
        };
        fit_warp(scene, &scaled, FEW_PAIRS).map_or(f64::INFINITY, |warp| warp.ratio)
    };
    let rated = scales.map(|scale| (ratio(scale), scale));
    rated
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map_or(1.0, |best| best.1)
}

fn fit_points(scene: &Scene, reading: &Reading) -> (Option<PointFit>, Vec<Option<DisparityFit>>) {
    let (mut errors, mut spreads, mut scales) = (Vec::new(), Vec::new(), Vec::new());
    let (mut frames, mut upside_down) = (0, 0);
    let alignments = scene.frames.iter().map(|frame| {
        let pose = reading.pose(frame);
        let seen = points_from(frame, &pose, &scene.points);
        let pairs = seen.filter_map(|(i, point)| {
            let z = reading.depth(frame, i);
            (z > 0.0 && !reading.moves(frame, i)).then_some((1.0 / z, 1.0 / point))
        });
        let pairs: Vec<(f64, f64)> = pairs.collect();
        if pairs.len() < MIN_POINTS {
            return None;
        }
        frames += 1;
        let fit = DisparityFit::of(&pairs);
        let truth: Vec<f64> = pairs.iter().map(|p| p.1).collect();
        let middle = median(&truth);
        errors.extend(
            pairs
                .iter()
                .map(|(x, y)| (fit.scale * x + fit.shift - y).abs() / y),
        );
        spreads.extend(truth.iter().map(|y| (middle - y).abs() / y));
        if !fit.is_upright() {
            upside_down += 1;
            return None;
        }
        scales.push(fit.scale);
        Some(fit)
    });
    let alignments = alignments.collect();
    let points = (frames > 0).then(|| PointFit {
        frames,
        upside_down,
        error: median(&errors),
        spread: median(&spreads),
        scales: [
            scales.iter().copied().fold(f64::INFINITY, f64::min),
            scales.iter().copied().fold(0.0, f64::max),
        ],
    });
    (points, alignments)
}

/// Mean difference of two colours.
fn difference(a: [f32; 3], b: [f32; 3]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| f64::from((a - b).abs()) / 3.0)
        .sum()
}

fn fit_colors(scene: &Scene, reading: &Reading) -> Option<ColorFit> {
    let points = &scene.points;
    if points.len() < MIN_POINTS {
        return None;
    }
    let mut seen = vec![false; points.len()];
    let (mut own, mut others) = (Vec::new(), Vec::new());
    let mut colors = points.iter().map(|point| point.color);
    let is_plain = colors
        .next()
        .is_none_or(|first| colors.all(|color| color == first));
    for frame in &scene.frames {
        let pose = reading.pose(frame);
        let camera = &frame.view.camera;
        let mut visible = Vec::new();
        for (k, point) in points.iter().enumerate() {
            let at = seen_at(camera, pose.transform_point3(point.position));
            let Some(at) = at else { continue };
            seen[k] = true;
            if !reading.moves(frame, pixel_index(camera, at)) {
                visible.push((k, sample_color(frame, at)));
            }
        }
        let step = visible.len().div_ceil(COLORED).max(1);
        let chosen: Vec<_> = visible.into_iter().step_by(step).collect();
        for (j, (k, color)) in chosen.iter().enumerate() {
            let (_, other) = chosen[(j + chosen.len() / 2) % chosen.len()];
            own.push(difference(points[*k].color, *color));
            others.push(difference(points[*k].color, other));
        }
    }
    let share = seen.iter().filter(|s| **s).count() as f64 / points.len() as f64;
    let ratio = if others.is_empty() {
        Some(1.0)
    } else {
        let by_chance = median(&others);
        (!is_plain && by_chance > 0.01).then(|| median(&own) / by_chance)
    };
    Some(ColorFit { seen: share, ratio })
}

/// Pairs of frames, one and a few apart.
fn pairs(num_frames: usize, most: usize) -> Vec<(usize, usize)> {
    let apart = [1, (num_frames / 6).max(2)];
    let all = apart
        .iter()
        .flat_map(|k| (*k..num_frames).map(move |b| (b - k, b)));
    let all: Vec<_> = all.collect();
    let step = all.len().div_ceil(most).max(1);
    all.into_iter().step_by(step).collect()
}

fn fit_warp(scene: &Scene, fit: &Fit, most_pairs: usize) -> Option<WarpFit> {
    let (mut count, mut sums, mut shifts) = (0, Moved::default(), Vec::new());
    for (a, b) in pairs(scene.frames.len(), most_pairs) {
        if let Some(moved) = moved(scene, fit, a, b, &mut shifts) {
            count += 1;
            sums.add(&moved);
        }
    }
    let mut sources = pairs(scene.frames.len(), most_pairs).into_iter();
    if count == 0 && sources.any(|(a, _)| num_known(scene, fit, a) >= MIN_POINTS) {
        return Some(WarpFit {
            pairs: 0,
            ratio: NOT_AT_ALL,
            moving: None,
            shift_px: f64::INFINITY,
        });
    }
    let ratio = sums.ratio().filter(|_| count > 0)?;
    let still = mean(sums.still);
    let moves = sums.moving[0] >= MIN_POINTS as f64 && still > 0.0;
    Some(WarpFit {
        pairs: count,
        ratio,
        moving: moves.then(|| mean(sums.moving) / still),
        shift_px: median(&shifts),
    })
}

/// Differences of a frame's pixels to the places of another where depth and poses have them: how many, and their sum.
#[derive(Clone, Debug, Default)]
pub(super) struct Moved {
    /// Where the mask says that things stand still.
    still: [f64; 2],
    /// The same pixels, to their own places in the other frame.
    unmoved: [f64; 2],
    /// Where it says that they move.
    moving: [f64; 2],
}

impl Moved {
    fn add(&mut self, other: &Self) {
        for (own, others) in [
            (&mut self.still, other.still),
            (&mut self.unmoved, other.unmoved),
            (&mut self.moving, other.moving),
        ] {
            *own = [own[0] + others[0], own[1] + others[1]];
        }
    }

    /// Difference to the other frame, as a share of that of the unmoved frame; `None` where there is too little to tell.
    pub(super) fn ratio(&self) -> Option<f64> {
        let tells = self.still[0] >= MIN_POINTS as f64 && mean(self.unmoved) > 0.0;
        tells.then(|| mean(self.still) / mean(self.unmoved))
    }
}

fn mean([count, sum]: [f64; 2]) -> f64 {
    sum / count
}

/// Of every so manieth row and column pixels are looked up.
fn step(camera: &Camera) -> usize {
    camera.num_pixels().div_ceil(LOOKED_UP).isqrt().max(1)
}

/// How many of a frame's pixels that are looked up have depth.
pub(super) fn num_known(scene: &Scene, fit: &Fit, frame: usize) -> usize {
    let camera = &scene.frames[frame].view.camera;
    let pixels = every(camera, step(camera));
    pixels.filter(|i| fit.depth(scene, frame, *i) > 0.0).count()
}

/// Moves a frame to another by depth and pose, and adds how far pixels go, px, to `shifts`; `None` where the other has hardly
/// anything of it in its picture.
pub(super) fn moved(
    scene: &Scene,
    fit: &Fit,
    a: usize,
    b: usize,
    shifts: &mut Vec<f64>,
) -> Option<Moved> {
    let (from, to) = (&scene.frames[a], &scene.frames[b]);
    let step = step(&from.view.camera);
    let other_from_camera = fit.pose(scene, b) * fit.pose(scene, a).inverse();
    let depth = |i: usize| fit.depth(scene, a, i);
    let (camera, other) = (&from.view.camera, &to.view.camera);
    let seen: Vec<_> = seen_in(camera, depth, other, other_from_camera, step).collect();
    if seen.len() as f64 <= LEAST_SHARED * num_known(scene, fit, a) as f64 {
        return None;
    }
    let mut sums = Moved::default();
    for seen in seen {
        let own = pixel_color(from, seen.pixel);
        let warped = difference(own, sample_color(to, seen.at));
        if fit.reading.moves(from, seen.pixel) {
            sums.moving = [sums.moving[0] + 1.0, sums.moving[1] + warped];
            continue;
        }
        let unwarped = difference(own, sample_color(to, seen.center));
        sums.still = [sums.still[0] + 1.0, sums.still[1] + warped];
        sums.unmoved = [sums.unmoved[0] + 1.0, sums.unmoved[1] + unwarped];
        shifts.push(seen.at.distance(seen.center));
    }
    Some(sums)
}
