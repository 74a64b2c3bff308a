//! The blur model's kernels on each device in f32 against f64 in main memory, forward and back, over sizes that are no multiple
//! of anything. Errors are measured against the largest value of a tensor.

use bpnet::{BlurField, BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{assert_close, devices, noise, rounded, tensor, values};

/// A result: its name and its values.
type Named = (String, Vec<f64>);

/// Compares results by name.
fn check(what: &str, results: &[Named], expected: &[Named], limit: f64) {
    assert_eq!(results.len(), expected.len(), "{what}: as many results");
    for ((name, result), (_, expected)) in results.iter().zip(expected) {
        assert_close(&format!("{what}: {name}"), result, expected, limit);
    }
}

struct Blur {
    size: [usize; 3],
    image: Vec<f64>,
    kernel: Vec<f64>,
    intensity: Vec<f64>,
}

fn blurred(case: &Blur, device: &Device, dtype: DType) -> Vec<Named> {
    let [height, width, k] = case.size;
    let device = device.clone().autodiff();
    let leaf = |values: &[f64], channels: usize| {
        tensor::<3>(values, [height, width, channels], &device, dtype).require_grad()
    };
    let image = leaf(&case.image, 3);
    let kernel = leaf(&case.kernel, k * k);
    let intensity = leaf(&case.intensity, 1);
    let field = BlurField::new(kernel.clone(), intensity.clone().squeeze_dim::<2>(2))
        .expect("the shapes fit");
    let seen = composite(image.clone(), &field).expect("the shapes fit");
    let weighted = |part: Tensor<3>, seed: u64| {
        let dims = part.dims();
        let weights = rounded(&noise(dims.iter().product(), seed));
        (part * tensor::<3>(&weights, dims, &device, dtype)).sum()
    };
    let parts = [
        ("picture", seen.picture()),
        ("centroid", seen.centroid()),
        ("centre weight", seen.center_weight().unsqueeze_dim::<3>(2)),
        ("intensity", seen.intensity().unsqueeze_dim::<3>(2)),
    ];
    let mut results = Vec::new();
    let mut loss = Tensor::<1>::zeros([1], (&device, dtype));
    for (seed, (name, part)) in (11..).zip(parts) {
        results.push((name.to_owned(), values(part.clone())));
        loss = loss + weighted(part, seed);
    }
    let grads = loss.backward();
    for (name, leaf) in [
        ("image", image),
        ("kernel", kernel),
        ("intensity", intensity),
    ] {
        let gradient = leaf.grad(&grads).expect("it reaches every input");
        results.push((format!("gradient of {name}"), values(gradient)));
    }
    results
}

#[test]
fn composites_are_those_of_f64() {
    for (name, device) in devices() {
        for (seed, [height, width, k]) in (1..).zip([
            [1, 1, 1],
            [1, 1, 5],
            [4, 9, 7],
            [13, 7, 3],
            [3, 4, 9],
            [2, 3, 15],
            [1, 300, 3],
            [37, 29, 9],
        ]) {
            let pixels = height * width;
            let mut case = Blur {
                size: [height, width, k],
                image: rounded(&noise(pixels * 3, seed)),
                // Not normalised.
                kernel: rounded(&noise(pixels * k * k, seed + 20))
                    .iter()
                    .map(|v| (v.abs() + 0.05) as f32 as f64)
                    .collect(),
                intensity: rounded(&noise(pixels, seed + 40))
                    .iter()
                    .map(|v| v.abs())
                    .collect(),
            };
            // The two ends, and kernels that weigh nothing.
            for i in (0..pixels).step_by(5) {
                case.intensity[i] = [0.0, 1.0, 0.5][i % 3];
            }
            for i in (3..pixels).step_by(7) {
                case.kernel[i * k * k..(i + 1) * k * k].fill(0.0);
            }
            let what = format!("{name}: composite {height} x {width}, K = {k}");
            let expected = blurred(&case, &Device::flex(), DType::F64);
            let results = blurred(&case, &device, DType::F32);
            check(&what, &results, &expected, 2e-6);
            assert!(
                results == blurred(&case, &device, DType::F32),
                "{what}: the same bits again"
            );
        }
    }
}

#[test]
fn a_picture_without_pixels_is_none() {
    for (name, device) in devices() {
        let none = |channels: usize| tensor::<3>(&[], [0, 5, channels], &device, DType::F32);
        let field = BlurField::new(none(9), none(1).squeeze_dim::<2>(2)).expect("the shapes fit");
        let seen = composite(none(3), &field).expect("the shapes fit");
        assert_eq!(seen.picture().dims(), [0, 5, 3], "{name}");
        assert!(values(seen.centroid()).is_empty(), "{name}");
    }
}

struct Net {
    config: BpNetConfig,
    size: [usize; 2],
    /// What the heads' weights are multiplied with.
    head_scale: f64,
    color: Vec<f64>,
}

/// Field and gradients of all parameters.
fn predicted(case: &Net, device: &Device, dtype: DType) -> Vec<Named> {
    let [height, width] = case.size;
    let device = device.clone().autodiff();
    let mut net = BpNet::new(&case.config, &device, dtype).expect("the configuration is valid");
    for (name, parameter) in net.parameters_mut() {
        let mut values = rounded(&values(parameter.clone()));
        if name.starts_with("head.") {
            values.iter_mut().for_each(|v| *v *= case.head_scale);
        }
        *parameter =
            tensor::<2>(&rounded(&values), parameter.dims(), &device, dtype).require_grad();
    }
    let map = |seed: u64| {
        let values = rounded(&noise(height * width, seed));
        tensor::<2>(&values, [height, width], &device, dtype)
    };
    let inputs = BlurInputs {
        color: tensor(&case.color, [height, width, 3], &device, dtype),
        disparity: map(5),
        mask: map(6),
    };
    let field = net
        .forward(1, &inputs, Extractor::Trained)
        .expect("the shapes fit");
    let (kernel, intensity) = (field.kernel(), field.intensity());
    let mut results = vec![
        ("kernel".to_owned(), values(kernel.clone())),
        ("intensity".to_owned(), values(intensity.clone())),
    ];
    let entries = kernel.dims()[2];
    let weights = |count: usize, seed: u64| rounded(&noise(count, seed));
    let of_kernel = weights(height * width * entries, 7);
    let of_intensity = weights(height * width, 8);
    let loss = (kernel * tensor(&of_kernel, [height, width, entries], &device, dtype)).sum()
        + (intensity * tensor(&of_intensity, [height, width], &device, dtype)).sum();
    let grads = loss.backward();
    for (name, parameter) in net.parameters() {
        let gradient = parameter.grad(&grads).expect("every parameter is trained");
        results.push((format!("gradient of {name}"), values(gradient)));
    }
    results
}

#[test]
fn predictions_are_those_of_f64() {
    for (name, device) in devices() {
        for (seed, (kernel_size, [height, width], downscale, shortcut, head_scale, limit)) in (1..)
            .zip([
                (3, [1, 1], 1, true, 1.0, 5e-6),
                // Where instance norm is over few pixels, it magnifies what f32 rounded.
                (1, [2, 3], 1, false, 1.0, 1e-4),
                (9, [13, 21], 1, true, 1.0, 2e-5),
                (5, [10, 7], 2, false, 1.0, 2e-5),
                (15, [9, 31], 4, true, 1.0, 4e-5),
                // Softmax and sigmoid at their ends.
                (7, [11, 17], 3, true, 300.0, 1e-4),
                (9, [61, 47], 1, true, 1.0, 2e-5),
            ])
        {
            let case = Net {
                config: BpNetConfig {
                    kernel_size,
                    num_frames: 2,
                    shortcut,
                    downscale,
                    head: HeadInit::Framework,
                    seed,
                },
                size: [height, width],
                head_scale,
                color: rounded(&noise(height * width * 3, seed + 60)),
            };
            let what = format!("{name}: net {height} x {width} / {downscale}, K = {kernel_size}");
            let expected = predicted(&case, &Device::flex(), DType::F64);
            let results = predicted(&case, &device, DType::F32);
            check(&what, &results, &expected, limit);
            assert!(
                results == predicted(&case, &device, DType::F32),
                "{what}: the same bits again"
            );
        }
    }
}
