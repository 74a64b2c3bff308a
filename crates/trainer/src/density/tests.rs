use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

const OPTIONS: DensityOptions = DensityOptions {
    grad_threshold: 2e-4,
    split_scale: 0.01,
    prune_scale: Some(0.1),
    prune_opacity: 0.005,
    max_gaussians: 100,
};

/// Isotropic log-scales [N, 3] from scales.
fn scales(values: &[f32]) -> Vec<f32> {
    values.iter().flat_map(|s| [s.ln(); 3]).collect()
}

fn logits(opacities: &[f64]) -> Vec<f32> {
    opacities.iter().map(|o| logit(*o) as f32).collect()
}

fn rows(edit: &RowEdit) -> Vec<(u32, RowKind)> {
    edit.source
        .iter()
        .copied()
        .zip(edit.kind.iter().copied())
        .collect()
}

#[test]
fn average_counts_only_what_was_drawn() {
    let device = Device::flex();
    let row = |values: [f32; 3]| Tensor::<1>::from_data(values, &device);
    let mut stats = DensityStats::new(3, &device);
    stats.accumulate(row([1.0, 2.0, 3.0]), row([1.0, 0.0, 2.0]));
    stats.accumulate(row([2.0, 5.0, 3.0]), row([4.0, 0.0, 0.0]));
    let average: Vec<f32> = stats.average().into_data().iter().collect();
    assert_eq!(average, [1.5, 0.0, 3.0]);
}

#[test]
fn small_is_cloned_large_is_split_faint_and_huge_are_removed() {
    use RowKind::{Clone, Kept, SplitChild};
    // dynamic: 0 split, 1 clone, 2 stays; static: 3 clone, 4 faint, 5 huge, 6 huge but split into what stays
    let edit = plan_density(
        &DensityRows {
            average: &[3e-4, 2e-4, 1.9e-4, 1.0, 1.0, 0.0, 1.0],
            log_scales: &scales(&[0.05, 0.005, 0.05, 0.001, 0.001, 0.2, 0.12]),
            opacity_logits: &logits(&[0.5, 0.5, 0.5, 0.5, 0.004, 0.4, 0.3]),
            num_dynamic: 3,
        },
        &OPTIONS,
    );
    assert_eq!(
        rows(&edit),
        [
            (1, Kept),
            (2, Kept),
            (1, Clone),
            (0, SplitChild),
            (0, SplitChild),
            (3, Kept),
            (3, Clone),
            (6, SplitChild),
            (6, SplitChild)
        ]
    );
    assert_eq!(edit.num_dynamic, 5);
    assert_eq!(edit.dynamic().source, [1, 2, 1, 0, 0]);
}

#[test]
fn scale_is_pruned_only_when_the_schedule_asks() {
    let (small, large) = (scales(&[0.01, 5.0]), logits(&[0.5, 0.5]));
    let plan = |prune_scale| {
        plan_density(
            &DensityRows {
                average: &[0.0; 2],
                log_scales: &small,
                opacity_logits: &large,
                num_dynamic: 0,
            },
            &DensityOptions {
                prune_scale,
                ..OPTIONS
            },
        )
    };
    assert_eq!(plan(None).source, [0, 1]);
    assert_eq!(plan(Some(0.1)).source, [0]);
}

#[test]
fn where_room_is_short_the_largest_gradients_win() {
    let edit = plan_density(
        &DensityRows {
            average: &[1.0, 3.0, 2.0, 3.0],
            log_scales: &scales(&[0.001; 4]),
            opacity_logits: &logits(&[0.5; 4]),
            num_dynamic: 0,
        },
        &DensityOptions {
            max_gaussians: 6,
            ..OPTIONS
        },
    );
    assert_eq!(edit.source, [0, 1, 2, 3, 1, 3]);
    let full = plan_density(
        &DensityRows {
            average: &[1.0; 4],
            log_scales: &scales(&[0.001; 4]),
            opacity_logits: &logits(&[0.5; 4]),
            num_dynamic: 0,
        },
        &DensityOptions {
            max_gaussians: 2,
            ..OPTIONS
        },
    );
    assert_eq!(full.source, [0, 1, 2, 3], "a full scene only prunes");
}

#[test]
fn neither_kind_dies_out() {
    let edit = plan_density(
        &DensityRows {
            average: &[1.0; 4],
            log_scales: &scales(&[0.001; 4]),
            opacity_logits: &logits(&[1e-3, 2e-3, 1e-4, 1e-4]),
            num_dynamic: 2,
        },
        &OPTIONS,
    );
    assert_eq!(edit.source, [1, 2]);
    assert_eq!(edit.num_dynamic, 1);
    let none = plan_density(
        &DensityRows {
            average: &[],
            log_scales: &[],
            opacity_logits: &[],
            num_dynamic: 0,
        },
        &OPTIONS,
    );
    assert!(none.is_empty(), "no Gaussian goes in, none comes out");
}

#[test]
fn appended_dynamic_rows_lie_behind_the_dynamic_ones() {
    let edit = RowEdit::append_dynamic(4, 2, &[1, 1, 0]);
    assert_eq!(edit.source, [0, 1, 1, 1, 0, 2, 3]);
    assert_eq!(edit.num_dynamic, 5);
    assert_eq!(edit.kind[4], RowKind::Clone);
    assert_eq!(edit.kind[5], RowKind::Kept);
}

#[test]
fn children_are_drawn_from_the_parents_distribution() {
    // A quarter turn about z takes the parent's x axis to the world's y axis.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let quats = [0.0, 0.0, 0.0, 0.0, 3.0 * half, 0.0, 0.0, 3.0 * half];
    let log_scales: Vec<f32> = [1.0_f32, 1.0, 1.0, 0.5, 0.1, 0.02]
        .iter()
        .map(|s| s.ln())
        .collect();
    let children = 20_000;
    let mut source = vec![0];
    source.extend(vec![1; children]);
    let mut kind = vec![RowKind::Kept];
    kind.extend(vec![RowKind::SplitChild; children]);
    let edit = RowEdit {
        source,
        kind,
        num_dynamic: 0,
    };
    let draw = || {
        split_offsets(
            &edit,
            &log_scales,
            &quats,
            &mut ChaCha8Rng::seed_from_u64(3),
        )
    };
    let offsets = draw();
    assert_eq!(offsets, draw(), "the same generator draws the same");
    assert_eq!(offsets.means[..3], [0.0; 3], "a kept row stays");
    assert_eq!(offsets.log_scales[..3], [0.0; 3]);
    assert!((offsets.log_scales[3] + 1.6_f32.ln()).abs() < 1e-6);
    let drawn: Vec<&[f32]> = offsets.means[3..].chunks_exact(3).collect();
    for (axis, sigma) in [0.1, 0.5, 0.02].into_iter().enumerate() {
        let mean = drawn.iter().map(|d| f64::from(d[axis])).sum::<f64>() / children as f64;
        let square = drawn
            .iter()
            .map(|d| f64::from(d[axis]).powi(2))
            .sum::<f64>()
            / children as f64;
        // Four standard errors.
        let error = 4.0 / (children as f64).sqrt();
        assert!(mean.abs() < error * sigma, "mean {mean} on axis {axis}");
        assert!(
            (square.sqrt() / sigma - 1.0).abs() < error,
            "spread {} on axis {axis}, not {sigma}",
            square.sqrt()
        );
    }
}
