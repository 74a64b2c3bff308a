//! Depth edges: pixels where a picture's depth jumps from one surface to another.
//!
//! Depth and colour of such pixels are mixed from both sides, and belong to neither.
//!
//! A plane that a pinhole sees has a *disparity* 1/z that is affine in the pixel: along a row or a column
//! it changes by the same step from each pixel to the next, however slanted the plane is and however large
//! the pixels are. So a step between neighbours is a jump only as far as the steps beside it are not like it:
//!
//! > jump: |step| - slope > edge · min(the neighbours' disparities).
//!
//! The slope is what the steps around share. A *run* is five steps in line, the one in question among them;
//! its slope is the second least of the other four, counted in that one's direction; and the largest slope
//! of all runs counts, or 0. Without a slope the rule reads |z - z'| > edge · min(z, z'): the relative
//! difference of the two depths.
//!
//! - A run may lie to either side of its step. So a step over a crease, where two planes meet, is explained:
//!   it lies between the two planes' own, and the steeper plane's run bounds it.
//! - The least steps of a run bound its slope, because estimated or shrunk depth smears an edge over some
//!   pixels, which looks like a slope but soon ends. Smeared over one or two pixels, it is found as by the
//!   relative difference alone.
//! - The second least and not the least, because one step of a run may lie on a crease, and because noise
//!   makes a plane's steps uneven.
//! - A surface less than five pixels across, along a row or column, is too narrow to show its slope. There
//!   the relative difference decides alone.
//!
//! Both pixels of a jump are on an edge, but for one case. A sharp edge that falls inside a pixel leaves one
//! mixed pixel: alone in line, it differs from both neighbours by more than `edge`, in one direction. Then it
//! is on the edge and they are not; they are of one surface each. (In pictures of 60 by 40 pixels this saves
//! a fifth to a third of those that would be lost.) With two mixed pixels or more the edge is a wide smear, of
//! which the neighbours have their share too.

/// Steps in line that make a run.
const RUN: usize = 5;

/// Which pixels of a picture lie on a depth edge, [H, W] row-major.
///
/// There is an edge between direct neighbours whose depths differ, relatively, by more than `edge` beyond
/// what their surface's slope explains. So a floor seen at a low angle has no edge, and neither has the crease
/// at its end. A surface shows its slope where it is five pixels or more across, along a row or a column;
/// elsewhere, as between surfaces that face the camera, the difference counts as it is:
/// |z - z'| > edge · min(z, z'). Both neighbours are on the edge; where it leaves a single mixed pixel between
/// two surfaces, only that one.
///
/// `depth` is z-depth, [H, W] row-major and `width` pixels wide, in any unit. What is not a positive finite
/// number is missing, and there is no edge between it and a neighbour. `edge` is 0 or more; with infinity
/// there are no edges. Nothing fails: a last row may be short.
#[must_use]
pub fn depth_edges(depth: &[f32], width: usize, edge: f64) -> Vec<bool> {
    // 0 where missing.
    let disparity: Vec<f64> = depth
        .iter()
        .map(|&z| {
            if has_depth(z) {
                f64::from(z).recip()
            } else {
                0.0
            }
        })
        .collect();
    let mut on_edge = vec![false; depth.len()];
    let mut mark = |line: Vec<usize>| {
        let line_disparity: Vec<f64> = line.iter().map(|&pixel| disparity[pixel]).collect();
        for at in edges_of_line(&line_disparity, edge) {
            on_edge[line[at]] = true;
        }
    };
    let width = width.clamp(1, depth.len().max(1));
    for start in (0..depth.len()).step_by(width) {
        mark((start..depth.len().min(start + width)).collect());
    }
    for start in 0..width {
        mark((start..depth.len()).step_by(width).collect());
    }
    on_edge
}

/// Whether a pixel has depth.
pub(crate) fn has_depth(z: f32) -> bool {
    z > 0.0 && z.is_finite()
}

/// The pixels of a row or column that lie on an edge for a neighbour in it, in any order, some of them twice.
fn edges_of_line(disparity: &[f64], edge: f64) -> Vec<usize> {
    // Between pixels i and i + 1. No step to or from missing depth: it neither jumps nor goes on with a slope.
    let steps: Vec<f64> = disparity
        .windows(2)
        .map(|pair| {
            if pair[0] > 0.0 && pair[1] > 0.0 {
                pair[1] - pair[0]
            } else {
                0.0
            }
        })
        .collect();
    let exceeds = |i: usize, part: f64| part > edge * disparity[i].min(disparity[i + 1]);
    let mut between = vec![false; disparity.len()];
    for at in 1..steps.len() {
        let (before, after) = (steps[at - 1], steps[at]);
        between[at] =
            before * after > 0.0 && exceeds(at - 1, before.abs()) && exceeds(at, after.abs());
    }
    // The first and the last pixel are never between two others.
    let mixed = |at: usize| between[at] && !between[at - 1] && !between[at + 1];
    let mut found = Vec::new();
    for (i, step) in steps.iter().enumerate() {
        if exceeds(i, step.abs() - slope(&steps, i)) {
            found.extend((!mixed(i + 1)).then_some(i));
            found.extend((!mixed(i)).then_some(i + 1));
        }
    }
    found
}

/// How much of step i is its surface's slope: see the head of this file.
fn slope(steps: &[f64], i: usize) -> f64 {
    let direction = steps[i].signum();
    let of_run = |first: usize| {
        let run = steps.get(first..first + RUN)?;
        let (mut least, mut second) = (f64::INFINITY, f64::INFINITY);
        for (_, step) in (first..).zip(run).filter(|&(at, _)| at != i) {
            let step = direction * step;
            second = second.min(step.max(least));
            least = least.min(step);
        }
        Some(second)
    };
    (i.saturating_sub(RUN - 1)..=i)
        .filter_map(of_run)
        .fold(0.0, f64::max)
}

#[cfg(test)]
mod tests;
