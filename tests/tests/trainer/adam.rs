//! Adam and density control on tensors, on every backend that is compiled in.

use burn::tensor::{DType, Tensor};
use limpid_tests::{computes, devices, devices_in, noise, property, tensor, unit_noise, values};
use trainer::adam::{AdamState, AdamStep, LearningRate, Steps, adam_step, finite_gradient};
use trainer::density::{
    DensityOptions, DensityRows, RowEdit, RowKind, add_to_rows, gather_rows, plan_density,
    reset_opacity,
};

/// An edit with every kind: of five rows, 3 goes, 1 is cloned, 4 is split.
fn edit() -> RowEdit {
    use RowKind::{Clone, Kept, SplitChild};
    RowEdit {
        source: vec![0, 1, 1, 2, 4, 4],
        kind: vec![Kept, Kept, Clone, Kept, SplitChild, SplitChild],
        num_dynamic: 3,
    }
}

fn together(rate: &LearningRate) -> AdamStep<'_> {
    AdamStep { rate, drawn: &[] }
}

#[test]
fn adam_leaves_a_leaf_and_follows_its_definition() {
    for (name, device) in devices() {
        for (dtype, tolerance) in [(DType::F64, 1e-12), (DType::F32, 1e-5)] {
            if !computes(name, &device, dtype) {
                continue;
            }
            for autodiff in [false, true] {
                let on = if autodiff {
                    device.clone().autodiff()
                } else {
                    device.clone()
                };
                let mut param = tensor(&unit_noise(12, 1), [4, 3], &on, dtype);
                let mut state = AdamState::new(&param);
                let rate = LearningRate::first_and_rest(0.1, 1, 0.01, 3);
                let (mut expected, mut m, mut v) = (unit_noise(12, 1), [0.0; 12], [0.0; 12]);
                for step in 1..=50 {
                    let grad: Vec<f64> = unit_noise(12, step as usize)
                        .iter()
                        .map(|n| n - 0.4)
                        .collect();
                    adam_step(
                        &mut param,
                        tensor(&grad, [4, 3], &device, dtype),
                        &mut state,
                        &together(&rate),
                    );
                    for k in 0..12 {
                        m[k] = 0.9 * m[k] + 0.1 * grad[k];
                        v[k] = 0.999 * v[k] + 0.001 * grad[k] * grad[k];
                        let root = (v[k] / (1.0 - 0.999_f64.powi(step))).sqrt() + 1e-15;
                        let rate = if k % 3 == 0 { 0.1 } else { 0.01 };
                        expected[k] -= rate * m[k] / (1.0 - 0.9_f64.powi(step)) / root;
                    }
                }
                assert_eq!(state.steps, Steps::Together(50));
                assert_eq!(param.is_require_grad(), autodiff, "{name}");
                assert_eq!(param.dtype(), dtype, "{name}");
                for (value, expected) in values(param.clone()).iter().zip(&expected) {
                    assert!((value - expected).abs() < tolerance, "{name} {dtype:?}");
                }
                if autodiff {
                    let grads = (param.clone() * 2.0).sum().backward();
                    let grad = param.grad(&grads).expect("a leaf");
                    assert_eq!(values(grad.clone()), [2.0; 12], "{name}");
                }
            }
        }
    }
}

/// The bits of one row of each: f64 holds what f32 computes.
fn row_of(tensors: [&Tensor<2>; 3], row: usize) -> Vec<u64> {
    let row = |t: &Tensor<2>| values(t.clone().inner().narrow(0, row, 1));
    tensors
        .into_iter()
        .flat_map(row)
        .map(f64::to_bits)
        .collect()
}

#[test]
fn rows_step_only_when_drawn_and_then_as_if_they_were_alone() {
    property("rows of frames", 20, |u| {
        let (rows, columns) = (u.int_in_range(1..=6_usize)?, u.int_in_range(1..=9_usize)?);
        let draws: Vec<Vec<usize>> = (0..u.int_in_range(1..=12)?)
            .map(|_| {
                (0..rows)
                    .filter_map(|row| u.ratio(1, 3_u8).map(|yes| yes.then_some(row)).transpose())
                    .collect()
            })
            .collect::<Result<_, _>>()?;
        let dtype = *u.choose(&[DType::F32, DType::F64])?;
        for (name, device) in devices_in(dtype) {
            let rate = LearningRate::first_and_rest(0.1, 1, 0.02, columns);
            let shape = [rows, columns];
            let of = |seed: u64| tensor(&noise(rows * columns, seed), shape, &device, dtype);
            let (mut parameter, start) = (of(1), of(1));
            let mut state = AdamState::per_row(&parameter);
            // Each row by itself, in a plain Adam that is stepped when the row is drawn.
            let alone = |t: &Tensor<2>, row| t.clone().narrow(0, row, 1);
            let mut single: Vec<(Tensor<2>, AdamState)> = (0..rows)
                .map(|row| (alone(&start, row), AdamState::new(&alone(&start, row))))
                .collect();
            let mut counts = vec![0; rows];
            for (k, drawn) in draws.iter().enumerate() {
                let gradient = of(2 + k as u64);
                let step = AdamStep { rate: &rate, drawn };
                let before: Vec<_> = (0..rows)
                    .map(|row| row_of([&parameter, &state.moment1, &state.moment2], row))
                    .collect();
                adam_step(&mut parameter, gradient.clone(), &mut state, &step);
                for row in 0..rows {
                    let now = row_of([&parameter, &state.moment1, &state.moment2], row);
                    let (single, plain) = &mut single[row];
                    if drawn.contains(&row) {
                        counts[row] += 1;
                        adam_step(single, alone(&gradient, row), plain, &together(&rate));
                    } else {
                        assert_eq!(now, before[row], "{name}: row {row} was not drawn");
                    }
                    let expected = row_of([single, &plain.moment1, &plain.moment2], 0);
                    assert_eq!(
                        now, expected,
                        "{name}: row {row}, drawn {} times",
                        counts[row]
                    );
                }
                assert_eq!(state.steps, Steps::PerRow(counts.clone()), "{name}");
            }
        }
        Ok(())
    });
}

#[test]
fn first_rows_step_at_their_own_rates() {
    property("first rows", 40, |u| {
        let rows = u.int_in_range(1..=9_usize)?;
        let columns = u.int_in_range(2..=7_usize)?;
        let first = u.int_in_range(0..=rows)?;
        let lead = LearningRate::Uniform(0.3);
        let rest = LearningRate::first_and_rest(0.1, 1, 0.02, columns);
        let rate = lead.then(first, &rest, columns);
        for (name, device) in devices() {
            let of = |seed: u64| {
                tensor(
                    &noise(rows * columns, seed),
                    [rows, columns],
                    &device,
                    DType::F32,
                )
            };
            let mut parameter = of(1);
            let mut state = AdamState::new(&parameter);
            // Both parts by themselves, as parameters of their own.
            let parts = [(0, first, &lead), (first, rows - first, &rest)];
            let mut parts: Vec<_> = parts
                .into_iter()
                .filter(|(_, count, _)| *count > 0)
                .map(|(from, count, rate)| {
                    let part = of(1).narrow(0, from, count);
                    let state = AdamState::new(&part);
                    (from, count, rate, part, state)
                })
                .collect();
            for k in 0..3 {
                adam_step(&mut parameter, of(2 + k), &mut state, &together(&rate));
                for (from, count, rate, part, state) in &mut parts {
                    let gradient = of(2 + k).narrow(0, *from, *count);
                    adam_step(part, gradient, state, &together(rate));
                }
            }
            for (from, count, _, part, _) in parts {
                let found = values(parameter.clone().narrow(0, from, count));
                assert_eq!(
                    found,
                    values(part),
                    "{name}: {count} rows from {from} of {rows}"
                );
            }
        }
        Ok(())
    });
}

#[test]
fn steps_of_rows_follow_edits_and_files() {
    for (name, device) in devices() {
        let parameter = tensor(&noise(10, 3), [5, 2], &device, DType::F32);
        let mut state = AdamState::per_row(&parameter);
        state.steps = Steps::PerRow(vec![5, 6, 7, 8, 9]);
        assert!(state.fits([5, 2]) && !state.fits([4, 2]), "{name}");
        state.gather(&edit());
        assert_eq!(state.steps, Steps::PerRow(vec![5, 6, 0, 7, 0, 0]), "{name}");
        state.steps = Steps::PerRow(vec![1]);
        assert!(!state.fits([6, 2]), "{name}: a count for every row");
    }
    for steps in [Steps::Together(3), Steps::PerRow(vec![2, 0, 5])] {
        let text = serde_json::to_string(&steps).expect("it can be written");
        let read: Steps = serde_json::from_str(&text).expect("it can be read");
        assert_eq!(read, steps, "{text}");
    }
}

#[test]
fn a_gradient_that_is_not_a_number_is_named() {
    for (name, device) in devices() {
        for dtype in [DType::F32, DType::F64] {
            if !computes(name, &device, dtype) {
                continue;
            }
            for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut grad = vec![1.0; 6];
                let check = |grad: &[f64]| {
                    finite_gradient(tensor(grad, [3, 2], &device, dtype)).map(values)
                };
                assert_eq!(
                    check(&grad),
                    Ok(grad.clone()),
                    "{name}: it comes back as it was"
                );
                grad[3] = bad;
                let error = check(&grad).expect_err("not finite");
                assert_eq!((error.row, error.column), (1, 1), "{name}: {error}");
            }
        }
    }
}

#[test]
fn moments_follow_clone_split_and_prune() {
    for (name, device) in devices() {
        let param = tensor(
            &unit_noise(10, 2),
            [5, 2],
            &device.clone().autodiff(),
            DType::F32,
        );
        let mut param = param.require_grad();
        let mut state = AdamState::new(&param);
        adam_step(
            &mut param,
            tensor(&unit_noise(10, 9), [5, 2], &device, DType::F32),
            &mut state,
            &together(&LearningRate::Uniform(0.1)),
        );
        let old = [&param, &state.moment1, &state.moment2].map(|t| values(t.clone()));
        state.gather(&edit());
        let new = gather_rows(&param, &edit());
        assert!(new.is_require_grad(), "{name}: a leaf again");
        let new = [&new, &state.moment1, &state.moment2].map(|t| values(t.clone()));
        for (row, (source, kind)) in edit().source.iter().zip(&edit().kind).enumerate() {
            for column in 0..2 {
                let from = 2 * *source as usize + column;
                let to = 2 * row + column;
                assert_eq!(new[0][to], old[0][from], "{name}: the parameter");
                for moment in [1, 2] {
                    let expected = if *kind == RowKind::Kept {
                        old[moment][from]
                    } else {
                        0.0
                    };
                    assert_eq!(new[moment][to], expected, "{name}: moment {moment}");
                }
            }
        }
        assert_eq!(
            state.steps,
            Steps::Together(1),
            "{name}: the count is shared"
        );
        state.zero_moments();
        assert_eq!(values(state.moment1.clone()), [0.0; 12], "{name}");
        assert_eq!(state.moment2.dims(), [6, 2], "{name}");
    }
}

#[test]
fn row_changes_give_leaves() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let logits = tensor(&[-9.0, 0.0, 9.0], [3, 1], &device, DType::F32).require_grad();
        let reset = reset_opacity(&logits, 0.01);
        assert!(reset.is_require_grad(), "{name}");
        let opacity = values(burn::tensor::activation::sigmoid(reset));
        assert!(
            (opacity[0] - 1.234e-4).abs() < 1e-6,
            "{name}: the lower stays"
        );
        assert!(
            opacity[1..].iter().all(|o| (o - 0.01).abs() < 1e-6),
            "{name}"
        );
        let moved = add_to_rows(&logits, vec![1.0, 2.0, 3.0]);
        assert!(moved.is_require_grad(), "{name}");
        assert_eq!(values(moved), [-8.0, 2.0, 12.0], "{name}");
    }
}

#[test]
fn density_plans_keep_their_promises() {
    property("density plans", 200, |u| {
        let rows = u.int_in_range(0..=40_usize)?;
        let num_dynamic = u.int_in_range(0..=rows)?;
        let mut draw = |levels: &[f32]| -> arbtest::arbitrary::Result<Vec<f32>> {
            (0..rows).map(|_| u.choose(levels).copied()).collect()
        };
        let average = draw(&[0.0, 1e-4, 3e-4, 1.0, f32::NAN])?;
        let sizes = draw(&[1e-8, 0.004, 0.03, 0.12, 0.5, 1e4])?;
        let logits = draw(&[-40.0, -6.0, -5.0, 0.0, 40.0])?;
        let options = DensityOptions {
            grad_threshold: 2e-4,
            split_scale: 0.01,
            prune_scale: u.choose(&[None, Some(0.1)]).copied()?,
            prune_opacity: 0.005,
            max_gaussians: u.int_in_range(0..=60_usize)?,
        };
        let log_scales: Vec<f32> = sizes
            .iter()
            .flat_map(|s| [s.ln(), -20.0, s.ln() - 1.0])
            .collect();
        let plan = || {
            plan_density(
                &DensityRows {
                    average: &average,
                    log_scales: &log_scales,
                    opacity_logits: &logits,
                    num_dynamic,
                },
                &options,
            )
        };
        let edit = plan();
        assert_eq!(edit, plan(), "the same plan twice");
        assert_eq!(edit.source.len(), edit.kind.len());
        assert!(
            edit.len() <= options.max_gaussians.max(rows),
            "the budget holds"
        );
        for (new, source) in edit.source.iter().enumerate() {
            let dynamic = (*source as usize) < num_dynamic;
            assert_eq!(dynamic, new < edit.num_dynamic, "dynamic rows come first");
        }
        assert_eq!(
            edit.num_dynamic > 0,
            num_dynamic > 0,
            "movers do not die out"
        );
        assert_eq!(
            edit.len() > edit.num_dynamic,
            rows > num_dynamic,
            "nor does the rest"
        );

        let of = |row: usize, kind| {
            let same = |(s, k): (&u32, &RowKind)| *s as usize == row && *k == kind;
            edit.source
                .iter()
                .zip(&edit.kind)
                .filter(|(s, k)| same((s, k)))
                .count()
        };
        let mut left_out = f32::NEG_INFINITY;
        let mut densified = f32::INFINITY;
        for row in 0..rows {
            let counts = [RowKind::Kept, RowKind::Clone, RowKind::SplitChild].map(|k| of(row, k));
            assert!(
                [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 2]].contains(&counts),
                "row {row} became {counts:?}"
            );
            let small = sizes[row] <= options.split_scale;
            let faint = logits[row] < -5.5;
            let offspring = if small { sizes[row] } else { sizes[row] / 1.6 };
            let fits = options.prune_scale.is_none_or(|limit| offspring <= limit);
            if counts[1] + counts[2] > 0 {
                assert!(average[row] >= options.grad_threshold && !faint && fits);
                assert_eq!(
                    small,
                    counts[1] == 1,
                    "small ones are cloned, large ones split"
                );
                densified = densified.min(average[row]);
            } else if average[row] >= options.grad_threshold && !faint && fits {
                left_out = left_out.max(average[row]);
            }
        }
        assert!(left_out <= densified, "the largest gradients win");
        if left_out > 0.0 {
            assert!(
                edit.len() + 2 > options.max_gaussians,
                "left out only for want of room"
            );
        }
        Ok(())
    });
}
