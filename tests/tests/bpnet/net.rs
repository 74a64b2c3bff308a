//! The blur model on every backend: the whole net's gradients against central differences in f64, its
//! start, what it refuses, and its bits on one and two threads.

use bpnet::{
    BlurInputs, BpNet, BpNetConfig, BpNetError, Extractor, HeadInit, blur, cell_means, composite,
    kernel_center_loss,
};
use burn::tensor::{DType, Device, Tensor};
use limpid_tests::{devices, devices_in, in_pool, tensor, unit_noise, values};

fn config(kernel_size: usize, head: HeadInit) -> BpNetConfig {
    BpNetConfig {
        kernel_size,
        num_frames: 3,
        shortcut: true,
        downscale: 1,
        head,
        seed: 7,
    }
}

fn inputs(height: usize, width: usize, device: &Device, dtype: DType) -> BlurInputs {
    BlurInputs {
        color: tensor(
            &unit_noise(height * width * 3, 1),
            [height, width, 3],
            device,
            dtype,
        ),
        disparity: tensor(
            &unit_noise(height * width, 2),
            [height, width],
            device,
            dtype,
        ),
        mask: tensor(
            &unit_noise(height * width, 3),
            [height, width],
            device,
            dtype,
        ),
    }
}

#[test]
fn a_constant_image_stays_constant_up_to_the_border() {
    for (name, device) in devices() {
        let net = BpNet::new(&config(9, HeadInit::Framework), &device, DType::F32)
            .expect("the configuration is valid");
        let mut inputs = inputs(7, 11, &device, DType::F32);
        inputs.color = Tensor::full([7, 11, 3], 0.7, (&device, DType::F32));
        let field = net
            .forward(0, &inputs, Extractor::Trained)
            .expect("the shapes fit");
        let output = composite(inputs.color, &field).expect("the shapes fit");
        for value in values(output.picture()) {
            assert!((value - 0.7).abs() < 1e-6, "{name}: {value}");
        }
        for sum in values(field.kernel().sum_dim(2)) {
            assert!((sum - 1.0).abs() < 1e-6, "{name}: a kernel sums to {sum}");
        }
    }
}

/// Whether a parameter belongs to the scene feature extractor.
fn is_extractor(name: &str) -> bool {
    name.starts_with("extractor.")
}

#[test]
fn the_parameters_are_as_many_as_counted_by_hand() {
    for (_, device) in devices() {
        let count = |config: &BpNetConfig, extractor: bool| -> usize {
            BpNet::new(config, &device, DType::F32)
                .expect("the configuration is valid")
                .parameters()
                .iter()
                .filter(|(name, _)| is_extractor(name) == extractor)
                .map(|(_, tensor)| tensor.dims().iter().product::<usize>())
                .sum()
        };
        let mut config = config(9, HeadInit::Mild);
        config.num_frames = 24;
        // 5x5: 125 * 64 + 64, 1600 * 64 + 64; 3x3: 576 * 32 + 32.
        assert_eq!(count(&config, true), 128_992);
        // Embedding 24 * 32; 80 -> 64, 96 -> 64 twice, 64 -> 81, 64 -> 1, each with biases.
        let base = (80 * 64 + 64) + 2 * (96 * 64 + 64);
        assert_eq!(
            count(&config, false),
            768 + base + (64 * 81 + 81) + (64 + 1)
        );
        config.shortcut = false;
        let base = (80 * 64 + 64) + 2 * (64 * 64 + 64);
        assert_eq!(
            count(&config, false),
            768 + base + (64 * 81 + 81) + (64 + 1)
        );
    }
}

#[test]
fn names_are_the_same_for_reading_and_replacing() {
    for (_, device) in devices() {
        let mut net = BpNet::new(&config(3, HeadInit::Mild), &device, DType::F32)
            .expect("the configuration is valid");
        let read: Vec<_> = net
            .parameters()
            .into_iter()
            .map(|(n, t)| (n, t.dims()))
            .collect();
        let write: Vec<_> = net
            .parameters_mut()
            .into_iter()
            .map(|(name, tensor)| {
                *tensor = tensor.clone() * 0.0;
                (name, tensor.dims())
            })
            .collect();
        assert_eq!(read, write);
        for (name, tensor) in net.parameters() {
            assert!(
                values(tensor).iter().all(|&v| v == 0.0),
                "{name} was not replaced"
            );
        }
    }
}

#[test]
fn a_head_starts_near_a_gaussian_of_one_pixel_and_its_intensity() {
    for (name, device) in devices() {
        for (head, intensity, within) in
            [(HeadInit::Mild, 0.5, 0.05), (HeadInit::Slight, 0.05, 0.01)]
        {
            let net = BpNet::new(&config(9, head), &device, DType::F32)
                .expect("the configuration is valid");
            let inputs = inputs(12, 16, &device, DType::F32);
            let field = net
                .forward(1, &inputs, Extractor::Trained)
                .expect("the shapes fit");
            let blurred = composite(inputs.color, &field).expect("the shapes fit");
            for m in values(field.intensity()) {
                assert!(
                    (m - intensity).abs() < within,
                    "{name}, {head:?}: m starts at {m}"
                );
            }
            for kernel in values(field.kernel()).chunks_exact(81) {
                let variance: f64 = (0..81)
                    .map(|j| kernel[j] * (j as f64 % 9.0 - 4.0).powi(2))
                    .sum();
                assert!(
                    (variance - 1.0).abs() < 0.2,
                    "{name}, {head:?}: variance {variance}"
                );
            }
            for shift in values(blurred.centroid()) {
                assert!(
                    shift.abs() < 0.1,
                    "{name}, {head:?}: the blur starts off centre by {shift} px"
                );
            }
        }
    }
}

/// A loss whose gradient reaches every parameter.
fn loss(net: &BpNet, inputs: &BlurInputs, extractor: Extractor) -> Tensor<1> {
    let field = net.forward(1, inputs, extractor).expect("the shapes fit");
    let blurred = composite(inputs.color.clone(), &field).expect("the shapes fit");
    let output = blurred.picture();
    let target = (output.clone().detach() + 1.3).sin();
    let cells = cell_means(blurred.centroid(), 2, 3);
    (output - target).powi_scalar(2).mean()
        + kernel_center_loss(blurred.center_weight(), blurred.intensity()) * 0.3
        + (cells.clone() * cells).mean() * 10.0
}

#[test]
fn kernel_and_intensity_learn_from_the_first_step() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let net = BpNet::new(&config(9, HeadInit::Mild), &device, DType::F32)
            .expect("the configuration is valid");
        let inputs = inputs(12, 16, &device, DType::F32);
        let field = net
            .forward(1, &inputs, Extractor::Trained)
            .expect("the shapes fit");
        // The photometric term alone: nothing else may be needed to leave the start.
        let output = composite(inputs.color.clone(), &field)
            .expect("the shapes fit")
            .picture();
        let target = tensor::<3>(
            &unit_noise(12 * 16 * 3, 9),
            [12, 16, 3],
            &device,
            DType::F32,
        );
        let grads = (output - target).abs().mean().backward();
        for (parameter, tensor) in net.parameters() {
            let gradient = tensor.grad(&grads).expect("every parameter is trained");
            let norm = values(gradient).iter().map(|g| g * g).sum::<f64>().sqrt();
            assert!(
                norm.is_finite(),
                "{name}: gradient of {parameter} is {norm}"
            );
            let least = if parameter.starts_with("head.") {
                1e-5
            } else {
                1e-8
            };
            assert!(
                norm > least,
                "{name}: gradient of {parameter} is only {norm:e}"
            );
        }
    }
}

#[test]
fn a_frozen_extractor_gets_no_gradient() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let net = BpNet::new(&config(5, HeadInit::Mild), &device, DType::F32)
            .expect("the configuration is valid");
        let inputs = inputs(8, 9, &device, DType::F32);
        let trained = values(loss(&net, &inputs, Extractor::Trained));
        let frozen = loss(&net, &inputs, Extractor::Frozen);
        assert_eq!(
            values(frozen.clone()),
            trained,
            "{name}: the values are the same"
        );
        let grads = frozen.backward();
        for (parameter, tensor) in net.parameters() {
            assert_eq!(
                tensor.grad(&grads).is_none(),
                is_extractor(parameter),
                "{name}: {parameter}"
            );
        }
    }
}

#[test]
fn nothing_flows_back_into_the_inputs_of_the_net() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let net = BpNet::new(&config(5, HeadInit::Mild), &device, DType::F32)
            .expect("the configuration is valid");
        let mut inputs = inputs(8, 9, &device, DType::F32);
        inputs.color = inputs.color.require_grad();
        inputs.disparity = inputs.disparity.require_grad();
        inputs.mask = inputs.mask.require_grad();
        let field = net
            .forward(0, &inputs, Extractor::Trained)
            .expect("the shapes fit");
        let grads = (field.kernel().narrow(2, 3, 1).sum() + field.intensity().sum()).backward();
        assert!(inputs.color.grad(&grads).is_none(), "{name}: colour");
        assert!(inputs.disparity.grad(&grads).is_none(), "{name}: disparity");
        assert!(inputs.mask.grad(&grads).is_none(), "{name}: mask");
    }
}

#[test]
fn the_whole_net_has_its_gradients() {
    for (name, device) in devices_in(DType::F64) {
        let device = device.autodiff();
        for shortcut in [true, false] {
            let mut config = config(3, HeadInit::Framework);
            config.shortcut = shortcut;
            let net = BpNet::new(&config, &device, DType::F64).expect("the configuration is valid");
            let inputs = inputs(4, 5, &device, DType::F64);
            let grads = loss(&net, &inputs, Extractor::Trained).backward();
            for (index, (parameter, tensor)) in net.parameters().into_iter().enumerate() {
                let dims = tensor.dims();
                let gradient = values(tensor.grad(&grads).expect("every parameter is trained"));
                let start = values(tensor);
                for seed in [20, 21] {
                    let direction: Vec<f64> = unit_noise(start.len(), seed + index)
                        .iter()
                        .map(|v| v - 0.5)
                        .collect();
                    let expected: f64 = gradient.iter().zip(&direction).map(|(g, d)| g * d).sum();
                    let at = |step: f64| -> f64 {
                        let mut moved = net.clone();
                        let values = start
                            .iter()
                            .zip(&direction)
                            .map(|(v, d)| v + step * d)
                            .collect();
                        *moved.parameters_mut()[index].1 = tensor_like(values, dims, &device);
                        moved_loss(&moved, &inputs, &net)
                    };
                    // ReLU bends: a step that crosses none of its kinks is small.
                    let step = 1e-6;
                    let numeric = (at(step) - at(-step)) / (2.0 * step);
                    let scale = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
                    assert!(scale > 0.0, "{name}: {parameter} has no gradient");
                    assert!(
                        (numeric - expected).abs() < 2e-6 * scale.max(numeric.abs()) + 1e-9,
                        "{name}: {parameter}, shortcut {shortcut}: {expected:e}, numeric {numeric:e}"
                    );
                }
            }
        }
    }
}

fn tensor_like(values: Vec<f64>, dims: [usize; 2], device: &Device) -> Tensor<2> {
    tensor(&values, dims, device, DType::F64)
}

/// The loss at moved parameters, with what the loss holds constant taken at the old ones.
fn moved_loss(moved: &BpNet, inputs: &BlurInputs, fixed: &BpNet) -> f64 {
    let at = |net: &BpNet| {
        net.forward(1, inputs, Extractor::Frozen)
            .expect("the shapes fit")
    };
    let seen = |field| composite(inputs.color.clone(), &field).expect("the shapes fit");
    let (blurred, old) = (seen(at(moved)), seen(at(fixed)));
    let output = blurred.picture();
    let target = (old.picture() + 1.3).sin();
    let cells = cell_means(blurred.centroid(), 2, 3);
    let loss = (output - target).powi_scalar(2).mean()
        + kernel_center_loss(blurred.center_weight(), old.intensity()) * 0.3
        + (cells.clone() * cells).mean() * 10.0;
    values(loss)[0]
}

#[test]
fn single_precision_follows_double() {
    for (name, device) in devices_in(DType::F64) {
        let fields = [DType::F64, DType::F32].map(|dtype| {
            let net = BpNet::new(&config(9, HeadInit::Framework), &device, dtype)
                .expect("the configuration is valid");
            let field = net
                .forward(2, &inputs(20, 30, &device, dtype), Extractor::Trained)
                .expect("the shapes fit");
            (values(field.kernel()), values(field.intensity()))
        });
        let [(kernel, intensity), (single_kernel, single_intensity)] = fields;
        for (a, b) in kernel.iter().zip(single_kernel) {
            assert!(
                (a - b).abs() < 1e-5 * (a + 0.01),
                "{name}: kernel {a} and {b}"
            );
        }
        for (a, b) in intensity.iter().zip(single_intensity) {
            assert!((a - b).abs() < 1e-5, "{name}: intensity {a} and {b}");
        }
    }
}

#[test]
fn one_and_two_threads_give_the_same_bits() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let run = |threads: usize| -> Vec<Vec<f64>> {
            in_pool(threads, || {
                let net = BpNet::new(&config(9, HeadInit::Mild), &device, DType::F32)
                    .expect("the configuration is valid");
                let mut inputs = inputs(50, 67, &device, DType::F32);
                inputs.color = inputs.color.require_grad();
                let loss = loss(&net, &inputs, Extractor::Trained);
                let value = values(loss.clone());
                let grads = loss.backward();
                let mut all = vec![value];
                for (_, tensor) in net.parameters() {
                    all.push(values(
                        tensor.grad(&grads).expect("every parameter is trained"),
                    ));
                }
                all.push(values(
                    inputs.color.grad(&grads).expect("it reaches the picture"),
                ));
                all
            })
        };
        assert_eq!(run(1), run(2), "{name}");
    }
}

#[test]
fn what_cannot_be_blurred_is_refused() {
    for (_, device) in devices_in(DType::F64) {
        for kernel_size in [0, 2, 8, 17, 1 << 40] {
            let error = BpNet::new(&config(kernel_size, HeadInit::Mild), &device, DType::F32);
            assert_eq!(error.err(), Some(BpNetError::KernelSize { kernel_size }));
        }
        let mut without = config(3, HeadInit::Mild);
        without.num_frames = 0;
        let error = BpNet::new(&without, &device, DType::F32).err();
        assert_eq!(error, Some(BpNetError::NoFrames));
        let error = BpNet::new(&config(3, HeadInit::Mild), &device, DType::F16).err();
        assert!(matches!(error, Some(BpNetError::DType { .. })));

        let zeros = |shape| Tensor::<3>::zeros(shape, (&device, DType::F32));
        let even = blur(zeros([4, 4, 3]), zeros([4, 4, 16]));
        assert_eq!(even.err(), Some(BpNetError::KernelSize { kernel_size: 4 }));
        for (image, kernel) in [
            ([4, 4, 3], [4, 4, 10]),
            ([4, 4, 1], [4, 4, 9]),
            ([4, 5, 3], [4, 4, 9]),
        ] {
            let error = blur(zeros(image), zeros(kernel)).err();
            assert!(
                matches!(error, Some(BpNetError::Shape { .. })),
                "{image:?}, {kernel:?}"
            );
        }
        let wide = Tensor::<3>::zeros([4, 4, 9], (&device, DType::F64));
        let error = blur(zeros([4, 4, 3]), wide).err();
        assert!(matches!(error, Some(BpNetError::MixedDType { .. })));

        let net = BpNet::new(&config(3, HeadInit::Mild), &device, DType::F32)
            .expect("the configuration is valid");
        let good = inputs(3, 4, &device, DType::F32);
        let error = net.forward(3, &good, Extractor::Frozen).err();
        assert_eq!(
            error,
            Some(BpNetError::Frame {
                frame: 3,
                num_frames: 3
            })
        );
        let mut wrong = good.clone();
        wrong.mask = Tensor::zeros([4, 3], (&device, DType::F32));
        let error = net.forward(0, &wrong, Extractor::Frozen).err();
        assert!(matches!(
            error,
            Some(BpNetError::Shape { name: "mask", .. })
        ));
    }
}
