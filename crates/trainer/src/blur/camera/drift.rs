//! Drift: what the means of the paths do slowly over the video. The mean of a path follows the hand, which turns round from frame to
//! frame; where means swing slowly, the scene has gone with them, and paths explain its place and no blur (RESULTS.md, "A real scene
//! that drifts").

use crate::columns::Columns;
use burn::tensor::Tensor;

/// Frames to a half wave of the quickest drift.
const FRAMES: usize = 8;

/// What changes slowly from frame to frame in the paths' mean motions [N, 6], which have no mean over the frames: their cosines of
/// up to a half wave for every eight frames.
pub(super) fn drift(motions: Tensor<2>) -> Tensor<2> {
    let [n, _] = motions.dims();
    if n < FRAMES {
        return motions.zeros_like();
    }
    let half_wave = std::f64::consts::PI / n as f64;
    let wave = |k: usize| {
        let frames = (0..n).map(|i| (half_wave * k as f64 * (i as f64 + 0.5)).cos());
        frames.collect()
    };
    let waves = (1..=n / FRAMES).map(wave).collect();
    let waves = Columns::spanning(waves, (&motions.device(), motions.dtype()));
    Tensor::from_inner(waves.part_of(motions.inner()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tensors::{host, tensor};
    use burn::tensor::Device;

    /// What drifts among motions that are `of` each of so many frames.
    fn drifting(frames: usize, of: impl Fn(f64) -> f64) -> Vec<f32> {
        let motions = (0..frames).flat_map(|i| [of(i as f64) as f32; 6]);
        let motions = tensor(motions.collect(), [frames, 6], &Device::flex());
        let each = host(drift(motions));
        assert!(each.chunks(6).all(|six| six == [six[0]; 6]), "all alike");
        each.into_iter().step_by(6).collect()
    }

    #[test]
    fn a_slow_swing_is_a_drift_and_a_hand_that_turns_round_is_none() {
        let n = 24;
        let swing =
            |waves: f64| move |i: f64| (std::f64::consts::PI * waves * (i + 0.5) / n as f64).cos();
        for waves in [1.0, 2.0, 3.0] {
            for (i, found) in drifting(n, swing(waves)).iter().enumerate() {
                let expected = swing(waves)(i as f64) as f32;
                assert!(
                    (found - expected).abs() < 1e-6,
                    "{waves}: {found} {expected}"
                );
            }
        }
        for waves in [4.0, 11.0, 23.0] {
            let found = drifting(n, swing(waves));
            assert!(found.iter().all(|v| v.abs() < 1e-6), "{waves}: {found:?}");
        }
    }

    /// Of so few frames nothing says which of their means are slow.
    #[test]
    fn a_handful_of_frames_does_not_drift() {
        assert_eq!(drifting(7, |i| i - 3.0), [0.0; 7]);
    }
}
