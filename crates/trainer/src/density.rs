//! Density control of 3D Gaussian Splatting (Kerbl et al., 2023, section 5): which Gaussians are cloned,
//! split and removed. Decisions are made on slices; a [`RowEdit`] then carries every parameter and its moments.
//!
//! Dynamic Gaussians are rows [0, F), static ones follow; an edit keeps it so.

mod rows;
mod split;

pub use rows::{RowEdit, RowKind, add_to_rows, gather_rows};
pub use split::{SplitOffsets, split_offsets};

use crate::tensors::leaf;
use burn::tensor::{DType, Device, Tensor};
use rows::Builder;
use std::ops::Range;

/// Children of a split Gaussian.
const SPLIT_CHILDREN: u32 = 2;

/// A child's scale is its parent's divided by this.
const SPLIT_SHRINK: f64 = 1.6;

/// Screen-space gradients gathered since the last density control; they stay on the device.
#[derive(Clone, Debug)]
pub struct DensityStats {
    /// Sum of the norms of the screen-space gradient (NDC units), `[N]`.
    pub grad_sum: Tensor<1>,
    /// Number of iterations in which the Gaussian was drawn, `[N]`. Far below 2^24, where f32 is exact.
    pub count: Tensor<1>,
}

impl DensityStats {
    /// Nothing seen yet of `rows` Gaussians.
    #[must_use]
    pub fn new(rows: usize, device: &Device) -> Self {
        let zeros = Tensor::zeros([rows], (&device.clone().inner(), DType::F32));
        Self {
            grad_sum: zeros.clone(),
            count: zeros,
        }
    }

    /// Adds one iteration: the norms of the screen-space gradient `[N]` of the Gaussians whose radius in
    /// pixels `[N]` is above zero.
    ///
    /// # Panics
    /// Panics if a length is not N.
    pub fn accumulate(&mut self, screen_grad: Tensor<1>, radii: Tensor<1>) {
        let rows = self.count.dims();
        assert_eq!(screen_grad.dims(), rows, "one gradient norm per Gaussian");
        assert_eq!(radii.dims(), rows, "one radius per Gaussian");
        let hidden = radii.inner().lower_equal_elem(0.0);
        let drawn = self.count.ones_like().mask_fill(hidden.clone(), 0.0);
        let norms = screen_grad.inner().mask_fill(hidden, 0.0);
        self.grad_sum = self.grad_sum.clone() + norms;
        self.count = self.count.clone() + drawn;
    }

    /// The mean gradient norm of every Gaussian, `[N]`; zero for one that was never drawn.
    #[must_use]
    pub fn average(&self) -> Tensor<1> {
        self.grad_sum.clone() / self.count.clone().clamp_min(1.0)
    }
}

/// Limits of density control.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DensityOptions {
    /// Gaussians with at least this mean screen-space gradient (NDC units) are cloned or split.
    pub grad_threshold: f32,
    /// The largest scale (scene units) up to which one is cloned rather than split: 0.01 S.
    pub split_scale: f32,
    /// The largest scale (scene units) that is kept, 0.1 S; `None` while the schedule does not ask for it.
    pub prune_scale: Option<f32>,
    /// Gaussians with an opacity below this are removed: 0.005.
    pub prune_opacity: f32,
    /// Densification does not bring the number of Gaussians above this.
    pub max_gaussians: usize,
}

/// The Gaussians that density control judges, the dynamic ones first.
#[derive(Clone, Copy, Debug)]
pub struct DensityRows<'a> {
    /// Their mean screen-space gradients, [`DensityStats::average`], `[N]`.
    pub average: &'a [f32],
    /// [N, 3].
    pub log_scales: &'a [f32],
    /// `[N]`.
    pub opacity_logits: &'a [f32],
    /// How many are dynamic.
    pub num_dynamic: usize,
}

/// What happens to one old row.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fate {
    Stay,
    Clone,
    Split,
    Remove,
}

/// Decides who is cloned, split and removed.
///
/// A Gaussian whose mean gradient reaches the threshold is cloned if its largest scale is at most
/// `split_scale`, otherwise replaced by two children of 1/1.6 its size. Of the result, what is too transparent or (with
/// `prune_scale`) too large is removed, children judged by their own size. Where `max_gaussians` leaves no room
/// for all, the largest gradients win, at equal gradients the lower rows. The most opaque dynamic and the most opaque static
/// Gaussian are never removed, so that neither kind dies out. Within a kind the order is: rows that stay, clones,
/// children, each by old row.
///
/// # Panics
/// Panics if the lengths do not agree or `num_dynamic` exceeds N.
#[must_use]
pub fn plan_density(gaussians: &DensityRows<'_>, options: &DensityOptions) -> RowEdit {
    let &DensityRows {
        average,
        log_scales,
        opacity_logits,
        num_dynamic,
    } = gaussians;
    let rows = opacity_logits.len();
    assert_eq!(average.len(), rows, "one mean gradient per Gaussian");
    assert_eq!(log_scales.len(), 3 * rows, "three log-scales per Gaussian");
    assert!(num_dynamic <= rows, "dynamic rows are rows");
    let scale = |row: usize| {
        let s = &log_scales[3 * row..3 * row + 3];
        f64::from(s[0].max(s[1]).max(s[2])).exp()
    };
    let limit = logit(f64::from(options.prune_opacity));
    let faint = |row: usize| f64::from(opacity_logits[row]) < limit;
    let too_large = |scale: f64| {
        options
            .prune_scale
            .is_some_and(|limit| scale > f64::from(limit))
    };

    let mut fate: Vec<Fate> = (0..rows)
        .map(|row| {
            if faint(row) || too_large(scale(row)) {
                Fate::Remove
            } else {
                Fate::Stay
            }
        })
        .collect();
    for part in [0..num_dynamic, num_dynamic..rows] {
        // The first of the most opaque ones.
        let opaque = part.reduce(|best, row| {
            if opacity_logits[row] > opacity_logits[best] {
                row
            } else {
                best
            }
        });
        if let Some(row) = opaque {
            fate[row] = Fate::Stay;
        }
    }

    let mut wanted: Vec<usize> = (0..rows)
        .filter(|row| average[*row] >= options.grad_threshold)
        .collect();
    wanted.sort_by(|a, b| average[*b].total_cmp(&average[*a]).then(a.cmp(b)));
    let mut total = fate.iter().filter(|fate| **fate == Fate::Stay).count();
    for row in wanted {
        let size = scale(row);
        let (next, becomes, offspring) = if size <= f64::from(options.split_scale) {
            (Fate::Clone, 2, size)
        } else {
            (Fate::Split, SPLIT_CHILDREN as usize, size / SPLIT_SHRINK)
        };
        if faint(row) || too_large(offspring) {
            continue;
        }
        let stays = usize::from(fate[row] == Fate::Stay);
        if total - stays + becomes > options.max_gaussians {
            break;
        }
        total = total - stays + becomes;
        fate[row] = next;
    }

    let mut edit = Builder::default();
    let mut emit = |part: Range<usize>| {
        let with = |wanted: &'static [Fate]| {
            let fate = &fate;
            part.clone().filter(move |row| wanted.contains(&fate[*row]))
        };
        for row in with(&[Fate::Stay, Fate::Clone]) {
            edit.push(row, RowKind::Kept);
        }
        for row in with(&[Fate::Clone]) {
            edit.push(row, RowKind::Clone);
        }
        for row in with(&[Fate::Split]) {
            for _ in 0..SPLIT_CHILDREN {
                edit.push(row, RowKind::SplitChild);
            }
        }
        edit.len()
    };
    let dynamic = emit(0..num_dynamic);
    emit(num_dynamic..rows);
    edit.finish(dynamic)
}

/// Opacity logits [N, 1] with no opacity above `ceiling` (0.01 in the paper): a new leaf that requires its gradient if
/// `logits` is on an autodiff device. The caller clears Adam's moments of the opacities.
#[must_use]
pub fn reset_opacity(logits: &Tensor<2>, ceiling: f64) -> Tensor<2> {
    let autodiff = logits.is_autodiff();
    leaf(logits.clone().inner().clamp_max(logit(ceiling)), autodiff)
}

fn logit(opacity: f64) -> f64 {
    (opacity / (1.0 - opacity)).ln()
}

#[cfg(test)]
mod tests;
