//! Where the children of a split Gaussian lie.

use super::{RowEdit, RowKind, SPLIT_SHRINK};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

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
