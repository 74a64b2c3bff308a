//! One whole training loss: the gradient of every parameter group against f64 differences.

use burn::tensor::{DType, Tensor};
use glam::DVec3;
use io::SparsePoint;
use limpid_tests::{
    GradLimits, devices_in, directional_report, noise, tensor as tensor_of, tiny, values,
};
use trainer::settings::BlurKind;
use trainer::{Model, Trainer};

/// A model with its parameters in f64, moved by `step` where the name is `moved`.
fn in_f64(model: &Model, moved: &str, step: &[f64]) -> Model {
    let mut model = model.clone();
    for (parameter, tensor) in model.parameters_mut() {
        let mut entries = values(tensor.clone());
        if parameter.name == moved {
            entries.iter_mut().zip(step).for_each(|(v, s)| *v += s);
        }
        let device = tensor.device();
        *tensor = tensor_of(&entries, tensor.dims(), &device, DType::F64).require_grad();
    }
    model
}

/// The model with a second basis beside its first, and a blend of both for each Gaussian. (The scene needs but one.)
fn with_two_bases(model: &Model) -> Model {
    let mut model = model.clone();
    let motion = model.world.motion.as_mut().expect("the scene moves");
    let beside = |bases: &Tensor<2>, seed| {
        let first = bases.clone().inner().narrow(0, 0, 1);
        let change = noise(first.dims()[1], seed);
        let change = tensor_of(&change, first.dims(), &first.device(), first.dtype());
        Tensor::from_inner(Tensor::cat(vec![first.clone(), first + change * 0.05], 0))
    };
    motion.bases.rots = beside(&motion.bases.rots, 1);
    motion.bases.transls = beside(&motion.bases.transls, 2);
    let (device, shape) = (motion.coefficients.device(), [model.world.num_dynamic, 2]);
    motion.coefficients = tensor_of(&noise(2 * shape[0], 3), shape, &device, DType::F32);
    model
}

/// The same with parts of the camera that a trial has left out.
fn with_a_whole_camera(mut model: Model) -> Model {
    for (parameter, tensor) in model.parameters_mut() {
        let left_out = || values(tensor.clone()).iter().all(|v| *v == 0.0);
        if parameter.name.starts_with("camera.") && left_out() {
            let some = noise(tensor.dims().iter().product(), 4);
            let some = tensor_of(&some, tensor.dims(), &tensor.device(), DType::F32);
            *tensor = some * 0.01;
        }
    }
    model
}

#[test]
fn every_parameter_group_has_the_gradient_of_the_whole_loss() {
    check(
        BlurKind::Kernels,
        &["downsample", "gauge", "intensity", "kernel_center"],
        110,
    );
}

#[test]
fn so_has_every_parameter_group_of_the_camera() {
    // Before its first trial, which may leave parts out.
    check(BlurKind::Camera, &[], 70);
}

#[test]
fn so_has_every_parameter_group_of_both() {
    // Kernels come in after the camera's last trial.
    check(
        BlurKind::Both,
        &["downsample", "gauge", "intensity", "kernel_center"],
        195,
    );
}

/// The gradients of a whole loss with a blur model after so many iterations, at which every term is on and until which each
/// part has left its start; `own_terms` are the model's.
fn check(model: BlurKind, own_terms: &[&str], iteration: usize) {
    let mut scene = tiny::scene();
    // Without relief the estimator's scale and shift are not fitted: the fit is data to the gradient, but not to a difference.
    for frame in &mut scene.frames {
        let depth = frame.depth.as_mut().expect("the scene has depth");
        depth.values.fill(tiny::WALL as f32);
    }
    let grid = (0..48).map(|k| [f64::from(k % 8) - 3.5, f64::from(k / 8) - 2.5]);
    let on_wall = grid.map(|[x, y]| DVec3::new(0.4 * x, 0.4 * y, tiny::WALL));
    let points = on_wall.map(|position| SparsePoint {
        position,
        color: [0.5; 3],
    });
    scene.points = points.collect();
    let mut settings = tiny::settings();
    settings.blur.model = model;
    settings.loss.downsample = 0.1;
    settings.gaussians.initial_static_per_pixel = 0.3;
    // Kernels on top of the camera start from hardly any blur: so has all that makes them.
    let slight: &[&str] = if model == BlurKind::Both {
        &["blur.", "camera.focus"]
    } else {
        &["blur.embedding", "blur.base", "blur.head", "camera.focus"]
    };
    for (name, device) in devices_in(DType::F64) {
        let mut trainer =
            Trainer::new(scene.clone(), settings.clone(), &device).expect("a trainer");
        for _ in 0..iteration {
            trainer.step().expect("a step");
        }
        let model = with_a_whole_camera(with_two_bases(trainer.model()));
        let start = in_f64(&model, "", &[]);
        let frame = 2;
        let loss = |model: &Model| -> Vec<(&'static str, Tensor<1>)> {
            trainer
                .loss_terms(model, &start, iteration, frame)
                .expect("the terms")
        };
        let terms = loss(&start);
        let mut found: Vec<&str> = terms.iter().map(|(term, _)| *term).collect();
        found.sort_unstable();
        let shared = [
            "along_ray",
            "bases_acceleration",
            "depth",
            "depth_shift",
            "detail",
            "image",
            "mask",
            "means_acceleration",
            "offset_shift",
        ];
        let mut expected = [&shared, own_terms].concat();
        expected.sort_unstable();
        assert_eq!(found, expected, "{name}");
        let sum = |terms: Vec<(&str, Tensor<1>)>| {
            let values = terms.into_iter().map(|(_, value)| value).collect();
            Tensor::cat(values, 0).sum()
        };
        let grads = sum(terms).backward();
        for (seed, (parameter, tensor)) in start.parameters().into_iter().enumerate() {
            let group = parameter.name;
            let gradient = values(
                tensor
                    .grad(&grads)
                    .unwrap_or_else(|| panic!("{name}: {group} has a gradient")),
            );
            // Thousands of pixels have thresholds and kinks, and what moves Gaussians or features takes a step so small that
            // hardly any is met. The limits leave room for one, and for rounding: single ops are held to a thousandth of
            // them, and what is wrong between ops is wrong by far more.
            // What hardly has a gradient (`slight`) takes a larger one, for rounding.
            let slight = slight.iter().any(|name| group.starts_with(name));
            let limits = GradLimits {
                element: 2e-3,
                l2: 2e-3,
                angle: 4e-6,
                bias: 2e-3,
                step: if slight {
                    1e-6
                } else if ["camera.", "frames.", "motion.transls"]
                    .iter()
                    .any(|name| group.starts_with(name))
                {
                    // Moves every Gaussian, or every mover, in the picture at once.
                    1e-8
                } else {
                    1e-7
                },
            };
            // A threshold that a step does meet spoils its difference, and rounding that of a slight gradient; a wrong gradient
            // is wrong with any step.
            let other = if slight { 10.0 } else { 0.01 };
            let holds = [limits.step, other * limits.step].into_iter().any(|step| {
                let report = directional_report(&gradient, 4, step, seed as u64, |moved| {
                    values(sum(loss(&in_f64(&start, &group, moved))))[0]
                });
                eprintln!("{name}: {group}, step {step:e}: {report}");
                report.within(&limits)
            });
            assert!(holds, "{name}: {group}: the gradient is wrong, see above");
        }
    }
}
