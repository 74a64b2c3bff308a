//! Depth edges: pixels where a picture's depth jumps from one surface to another.
//!
//! Depth and colour of such pixels are mixed from both sides, and belong to neither.
//!
//! A plane that a pinhole sees has a *disparity* 1/z that is affine in the pixel: along a row or a column
//! it changes by the same step from each pixel to the next, however slanted the plane is and however large
//! the pixels are. So a step between neighbours is a jump only as far as the steps beside it are not like it.
//! Both pixels are on an edge if
//!
//! > |step| - slope > edge · min(their disparities),
//!
//! where the slope is what the steps around share. A *run* is five steps in line, the one in question among
//! them; its slope is the second least of the other four, counted in that one's direction; and the largest
//! slope of all runs counts, or 0. Without a slope the rule reads |z - z'| > edge · min(z, z'): the relative
//! difference of the two depths.
//!
//! - A run may lie to either side of its step. So a step over a crease, where two planes meet, is explained:
//!   it lies between the two planes' own, and the steeper plane's run bounds it.
//! - The least steps of a run bound its slope, because estimated or shrunk depth smears an edge over some
//!   pixels, which looks like a slope but soon ends. Smeared over one or two, it is found as by the relative
//!   difference alone.
//! - The second least and not the least, because one step of a run may lie on a crease, and because noise
//!   makes a plane's steps uneven.
//! - A surface less than five pixels across, along a row or column, is too narrow to show its slope. There
//!   the relative difference decides alone.

/// Steps in line that make a run.
const RUN: usize = 5;

/// Which pixels of a picture lie on a depth edge, [H, W] row-major: both of each pair of direct neighbours
/// whose depths differ, relatively, by more than `edge` beyond what their surface's slope explains.
///
/// So a floor seen at a low angle has no edge, and neither has the crease at its end. A surface shows its
/// slope where it is five pixels or more across, along a row or a column; elsewhere, as between surfaces that
/// face the camera, the difference of depths counts as it is: |z - z'| > edge · min(z, z').
///
/// `depth` is z-depth, [H, W] row-major and `width` pixels wide, in any unit. What is not a positive finite
/// number is missing; a pixel is on no edge for a neighbour without depth. `edge` is 0 or more; with infinity
/// there are no edges. Nothing fails: without edges is what is not a number.
#[must_use]
pub fn depth_edges(depth: &[f32], width: usize, edge: f64) -> Vec<bool> {
    // Missing depth has none of the others' values: a surface at infinity.
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
    let mut mark = |line: Vec<usize>| mark(&line, &disparity, edge, &mut on_edge);
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

/// Marks the pixels of a line, a row or a column, that lie on an edge.
fn mark(line: &[usize], disparity: &[f64], edge: f64, on_edge: &mut [bool]) {
    // No step to or from missing depth: it neither jumps nor goes on with a slope.
    let steps: Vec<f64> = line
        .windows(2)
        .map(|pair| {
            let (a, b) = (disparity[pair[0]], disparity[pair[1]]);
            if a > 0.0 && b > 0.0 { b - a } else { 0.0 }
        })
        .collect();
    let exceeds =
        |step: f64, i: usize| step > edge * disparity[line[i]].min(disparity[line[i + 1]]);
    let differs = |i: usize| exceeds(steps[i].abs(), i);
    let between = |at: usize| {
        (1..steps.len()).contains(&at)
            && steps[at - 1] * steps[at] > 0.0
            && differs(at - 1)
            && differs(at)
    };
    let mixed = |at: usize| between(at) && !(at > 0 && between(at - 1)) && !between(at + 1);
    for i in 0..steps.len() {
        if exceeds(steps[i].abs() - slope(&steps, i), i) {
            on_edge[line[i]] |= !mixed(i + 1);
            on_edge[line[i + 1]] |= !mixed(i);
        }
    }
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
