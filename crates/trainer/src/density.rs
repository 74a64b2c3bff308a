//! Density control of 3D Gaussian Splatting (Kerbl et al., 2023, section 5): which Gaussians are cloned,
//! split and removed. Decisions are made on slices; a [`RowEdit`] then carries every parameter and its moments.
//!
//! Dynamic Gaussians are rows [0, F), static ones follow; an edit keeps it so.

use crate::real::leaf;
use burn::tensor::{Int, Tensor, TensorData};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Children of a split Gaussian.
const SPLIT_CHILDREN: u32 = 2;

/// A child's scale is its parent's divided by this.
const SPLIT_SHRINK: f64 = 1.6;

/// Screen-space gradients gathered since the last density control.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DensityStats {
    /// Sum of the norms of the screen-space gradient (NDC units), [N].
    pub grad_sum: Vec<f32>,
    /// Number of iterations in which the Gaussian was drawn, [N].
    pub count: Vec<u32>,
}

impl DensityStats {
    /// Nothing seen yet of `rows` Gaussians.
    #[must_use]
    pub fn new(rows: usize) -> Self {
        Self {
            grad_sum: vec![0.0; rows],
            count: vec![0; rows],
        }
    }

    /// Adds one iteration: the norms of the screen-space gradient [N] of the Gaussians whose radius in
    /// pixels [N] is above zero.
    ///
    /// # Panics
    /// Panics if a length is not N.
    pub fn accumulate(&mut self, screen_grad: &[f32], radii: &[f32]) {
        assert_eq!(
            screen_grad.len(),
            self.count.len(),
            "one gradient norm per Gaussian"
        );
        assert_eq!(radii.len(), self.count.len(), "one radius per Gaussian");
        for (row, (grad, radius)) in screen_grad.iter().zip(radii).enumerate() {
            if *radius > 0.0 {
                self.grad_sum[row] += *grad;
                self.count[row] += 1;
            }
        }
    }

    /// The mean gradient norm of every Gaussian, [N]; zero for one that was never drawn.
    #[must_use]
    pub fn average(&self) -> Vec<f32> {
        self.grad_sum
            .iter()
            .zip(&self.count)
            .map(|(sum, count)| {
                if *count == 0 {
                    0.0
                } else {
                    *sum / *count as f32
                }
            })
            .collect()
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

/// Where a row of the edited set comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowKind {
    /// An old row that stays: it keeps its moments.
    Kept,
    /// A copy of an old row that stays too.
    Clone,
    /// One of the children of an old row that goes.
    SplitChild,
}

/// A change of the set of rows. New row i is made from old row `source[i]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowEdit {
    /// Old row of each new one, [N'].
    pub source: Vec<u32>,
    /// What became of it, [N'].
    pub kind: Vec<RowKind>,
    /// Dynamic Gaussians afterwards: rows [0, `num_dynamic`).
    pub num_dynamic: usize,
}

impl RowEdit {
    /// Number of rows afterwards.
    #[must_use]
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Whether no row is left.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }

    /// Whether the edit leaves `rows` rows as they were.
    #[must_use]
    pub fn is_identity(&self, rows: usize) -> bool {
        self.len() == rows
            && self.kind.iter().all(|kind| *kind == RowKind::Kept)
            && self
                .source
                .iter()
                .enumerate()
                .all(|(new, old)| new == *old as usize)
    }

    /// The edit of what only dynamic Gaussians have (their motion coefficients).
    #[must_use]
    pub fn dynamic(&self) -> Self {
        Self {
            source: self.source[..self.num_dynamic].to_vec(),
            kind: self.kind[..self.num_dynamic].to_vec(),
            num_dynamic: self.num_dynamic,
        }
    }

    /// All of `rows` rows stay, and copies of the dynamic rows `sources` come behind the last dynamic one.
    ///
    /// # Panics
    /// Panics if a source is not a dynamic row, or if there are more dynamic rows than rows.
    #[must_use]
    pub fn append_dynamic(rows: usize, num_dynamic: usize, sources: &[u32]) -> Self {
        assert!(num_dynamic <= rows, "dynamic rows are rows");
        assert!(
            sources
                .iter()
                .all(|source| (*source as usize) < num_dynamic),
            "a dynamic row is copied from a dynamic one"
        );
        let mut edit = Builder::default();
        for row in 0..num_dynamic {
            edit.push(row, RowKind::Kept);
        }
        for source in sources {
            edit.push(*source as usize, RowKind::Clone);
        }
        let dynamic = edit.source.len();
        for row in num_dynamic..rows {
            edit.push(row, RowKind::Kept);
        }
        edit.finish(dynamic)
    }
}

#[derive(Default)]
struct Builder {
    source: Vec<u32>,
    kind: Vec<RowKind>,
}

impl Builder {
    fn push(&mut self, row: usize, kind: RowKind) {
        self.source
            .push(u32::try_from(row).expect("fewer than 2^32 Gaussians"));
        self.kind.push(kind);
    }

    fn finish(self, num_dynamic: usize) -> RowEdit {
        RowEdit {
            source: self.source,
            kind: self.kind,
            num_dynamic,
        }
    }
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
/// `average` [N] is [`DensityStats::average`], `log_scales` [N, 3], `opacity_logits` [N].
///
/// # Panics
/// Panics if the lengths do not agree or `num_dynamic` exceeds N.
#[must_use]
pub fn plan_density(
    average: &[f32],
    log_scales: &[f32],
    opacity_logits: &[f32],
    num_dynamic: usize,
    options: &DensityOptions,
) -> RowEdit {
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
    let mut dynamic = 0;
    for part in [0..num_dynamic, num_dynamic..rows] {
        for row in part.clone() {
            if matches!(fate[row], Fate::Stay | Fate::Clone) {
                edit.push(row, RowKind::Kept);
            }
        }
        for row in part.clone() {
            if fate[row] == Fate::Clone {
                edit.push(row, RowKind::Clone);
            }
        }
        for row in part.clone() {
            if fate[row] == Fate::Split {
                for _ in 0..SPLIT_CHILDREN {
                    edit.push(row, RowKind::SplitChild);
                }
            }
        }
        if part.start == 0 {
            dynamic = edit.source.len();
        }
    }
    edit.finish(dynamic)
}

/// The new rows of a parameter [N, C], [N', C]: a new leaf that requires its gradient if `tensor` is on an autodiff device.
///
/// # Panics
/// Panics if the edit names a row that the tensor does not have.
#[must_use]
pub fn gather_rows(tensor: &Tensor<2>, edit: &RowEdit) -> Tensor<2> {
    let rows = tensor.dims()[0];
    assert!(
        edit.source.iter().all(|source| (*source as usize) < rows),
        "the edit was planned for as many rows as the tensor has"
    );
    let source: Vec<i64> = edit.source.iter().map(|row| i64::from(*row)).collect();
    let autodiff = tensor.is_autodiff();
    let inner = tensor.clone().inner();
    let source =
        Tensor::<1, Int>::from_data(TensorData::new(source, [edit.len()]), &inner.device());
    leaf(inner.select(0, source), autodiff)
}

/// `tensor` [N, C] plus `offsets`, row-major and as many: a new leaf that requires its gradient if `tensor` is on
/// an autodiff device.
///
/// # Panics
/// Panics if the number of offsets is not the tensor's.
#[must_use]
pub fn add_to_rows(tensor: &Tensor<2>, offsets: Vec<f32>) -> Tensor<2> {
    let autodiff = tensor.is_autodiff();
    let inner = tensor.clone().inner();
    let offsets = Tensor::from_data(
        TensorData::new(offsets, inner.dims()),
        (&inner.device(), inner.dtype()),
    );
    leaf(inner + offsets, autodiff)
}

/// What a split changes beside copying the parent's row; zero for other rows.
#[derive(Clone, Debug, PartialEq)]
pub struct SplitOffsets {
    /// To be added to the means, [N', 3], in scene units.
    pub means: Vec<f32>,
    /// To be added to the log-scales, [N', 3]: -ln 1.6.
    pub log_scales: Vec<f32>,
}

/// Draws where the children of split Gaussians lie: from the parent's own normal distribution, in its canonical rotation.
///
/// `log_scales` [N, 3] and `quats` [N, 4] (w, x, y, z; any length) are the old rows. Random numbers are drawn for
/// children only, in the order of the rows.
///
/// # Panics
/// Panics if the edit names a row that is not there.
#[must_use]
pub fn split_offsets(
    edit: &RowEdit,
    log_scales: &[f32],
    quats: &[f32],
    rng: &mut ChaCha8Rng,
) -> SplitOffsets {
    let mut means = vec![0.0; 3 * edit.len()];
    let mut shrink = vec![0.0; 3 * edit.len()];
    for (row, (source, kind)) in edit.source.iter().zip(&edit.kind).enumerate() {
        if *kind != RowKind::SplitChild {
            continue;
        }
        let source = *source as usize;
        let q = &quats[4 * source..4 * source + 4];
        let rotation = glam::DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into());
        // A zero quaternion turns nothing, as in the splatting op.
        let rotation = if rotation.length_squared() > 0.0 {
            rotation.normalize()
        } else {
            glam::DQuat::IDENTITY
        };
        let (x, y) = normal_pair(rng);
        let (z, _) = normal_pair(rng);
        let scale = |axis: usize| f64::from(log_scales[3 * source + axis]).exp();
        let offset = rotation * glam::DVec3::new(x * scale(0), y * scale(1), z * scale(2));
        for (axis, value) in offset.to_array().into_iter().enumerate() {
            means[3 * row + axis] = value as f32;
            shrink[3 * row + axis] = -SPLIT_SHRINK.ln() as f32;
        }
    }
    SplitOffsets {
        means,
        log_scales: shrink,
    }
}

/// Two independent standard normal numbers (Box and Muller, 1958).
fn normal_pair(rng: &mut ChaCha8Rng) -> (f64, f64) {
    // (0, 1]: the logarithm is finite.
    let mut unit = || (f64::from(rng.next_u32()) + 1.0) / (f64::from(u32::MAX) + 1.0);
    let radius = (-2.0 * unit().ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * unit()).sin_cos();
    (radius * cos, radius * sin)
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
