//! The kernels by themselves, on slices and tensors of fixed sizes: `cargo xtask bench`.

use std::hint::black_box;

use bpnet::{BlurField, BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
use burn::tensor::{DType, Device, Tensor, TensorData};
use divan::Bencher;
use glam::DAffine3;
use limpid_bench::workload::{Blur, Workload};
use splat_core::Gaussians;
use splat_core::cpu::{
    BackwardOptions, Exposure, Forward, Transfer, View, backward, expose, expose_backward, project,
    rasterize,
};
use trainer::adam::{AdamState, AdamStep, LearningRate, adam_step};
use trainer::losses::ssim;

/// As in the program: large buffers are kept for the next iteration.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Width and height of the picture, px, and the number of Gaussians.
const SIZES: [(usize, usize, usize); 2] = [(256, 144, 20_000), (512, 288, 100_000)];

fn main() {
    divan::main();
}

/// Gaussians, and a view of them.
fn workload((width, height, gaussians): (usize, usize, usize)) -> (Gaussians, View) {
    let workload = Workload {
        width,
        height,
        gaussians,
        blur: Blur::Off,
        kernel_size: 9,
    };
    let view = View::new(&workload.camera(), &DAffine3::IDENTITY, 3);
    (workload.gaussians(), view)
}

/// Values without a pattern, in [0, 1).
fn values(count: usize, seed: usize) -> Vec<f32> {
    (0..count)
        .map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f32 / 10_007.0)
        .collect()
}

/// A gradient of the output.
fn gradient((width, height, _): (usize, usize, usize)) -> Vec<f32> {
    let values = values(width * height * 5, 3);
    values.iter().map(|v| v - 0.5).collect()
}

fn picture(width: usize, height: usize, channels: usize, device: &Device) -> Tensor<3> {
    let values = values(width * height * channels, channels);
    let data = TensorData::new(values, [height, width, channels]);
    Tensor::from_data(data, (device, DType::F32))
}

mod splatting {
    use super::*;

    #[divan::bench(name = "project", args = SIZES)]
    fn time_project(bencher: Bencher<'_, '_>, size: (usize, usize, usize)) {
        let (gaussians, view) = workload(size);
        let splats = gaussians.slices();
        bencher.bench_local(|| project(black_box(&splats), &view));
    }

    #[divan::bench(name = "rasterize", args = SIZES)]
    fn time_rasterize(bencher: Bencher<'_, '_>, size: (usize, usize, usize)) {
        let (gaussians, view) = workload(size);
        let projection = project(&gaussians.slices(), &view).expect("good Gaussians");
        bencher.bench_local(|| rasterize(black_box(&projection), &[], 0));
    }

    #[divan::bench(name = "backward", args = SIZES)]
    fn time_backward(bencher: Bencher<'_, '_>, size: (usize, usize, usize)) {
        let (gaussians, view) = workload(size);
        let (splats, v_output) = (gaussians.slices(), gradient(size));
        let projection = project(&splats, &view).expect("good Gaussians");
        let raster = rasterize(&projection, &[], 0).expect("good Gaussians");
        let forward = Forward {
            splats: &splats,
            projection: &projection,
            features: &[],
            state: &raster.state,
        };
        bencher.bench_local(|| {
            let options = BackwardOptions::default();
            backward(black_box(&forward), &v_output, options)
        });
    }

    #[divan::bench(args = SIZES)]
    fn all(bencher: Bencher<'_, '_>, size: (usize, usize, usize)) {
        let (gaussians, view) = workload(size);
        let (splats, v_output) = (gaussians.slices(), gradient(size));
        bencher.bench_local(|| {
            let projection = project(black_box(&splats), &view).expect("good Gaussians");
            let raster = rasterize(&projection, &[], 0).expect("good Gaussians");
            let forward = Forward {
                splats: &splats,
                projection: &projection,
                features: &[],
                state: &raster.state,
            };
            backward(&forward, &v_output, BackwardOptions::default())
        });
    }

    /// Eight samples along a path of 3 px.
    #[divan::bench(args = SIZES)]
    fn expose_and_back(bencher: Bencher<'_, '_>, size: (usize, usize, usize)) {
        let (gaussians, view) = workload(size);
        let splats = gaussians.slices();
        let poses: Vec<f32> = (0..8)
            .flat_map(|i| {
                let mut pose = view.cam_from_world.map(|v| v as f32);
                pose[2] += (i as f32 - 3.5) * 3.0 / 8.0 / view.camera.fx as f32;
                pose
            })
            .collect();
        let exposure = Exposure {
            splats,
            middle: &view,
            poses: &poses,
            moving_means: &[],
            left_rotations: &[],
            transfer: Transfer::Srgb,
        };
        let v_color: Vec<f32> = gradient(size)[..size.0 * size.1 * 3].to_vec();
        bencher.bench_local(|| {
            let exposed = expose(black_box(&exposure)).expect("good Gaussians");
            expose_backward(&exposure, &exposed.state, &v_color, true)
        });
    }
}

/// Of a picture of 256 x 144 with kernels of 9 x 9.
mod blur {
    use super::*;

    struct Case {
        net: BpNet,
        inputs: BlurInputs,
        image: Tensor<3>,
    }

    fn case() -> Case {
        let (width, height) = (256, 144);
        let device = Device::flex().autodiff();
        let config = BpNetConfig {
            kernel_size: 9,
            num_frames: 24,
            shortcut: true,
            downscale: 1,
            head: HeadInit::Mild,
            seed: 1,
        };
        Case {
            net: BpNet::new(&config, &device, DType::F32).expect("a good configuration"),
            inputs: BlurInputs {
                color: picture(width, height, 3, &device),
                disparity: picture(width, height, 1, &device).squeeze_dim(2),
                mask: picture(width, height, 1, &device).squeeze_dim(2),
            },
            image: picture(width, height, 3, &device).require_grad(),
        }
    }

    #[divan::bench(sample_count = 20, args = [Extractor::Trained, Extractor::Frozen])]
    fn extractor_net_and_blur(bencher: Bencher<'_, '_>, extractor: Extractor) {
        let case = case();
        bencher.bench_local(|| {
            let field = case.net.forward(1, &case.inputs, extractor);
            let blurred = composite(case.image.clone(), &field.expect("good inputs"));
            blurred.expect("good inputs").picture().sum().backward()
        });
    }

    #[divan::bench(sample_count = 20)]
    fn blur_alone(bencher: Bencher<'_, '_>) {
        let case = case();
        let field = case.net.forward(1, &case.inputs, Extractor::Trained);
        let field = field.expect("good inputs");
        let kernel = field.kernel().detach().require_grad();
        let intensity = field.intensity().detach().require_grad();
        bencher.bench_local(|| {
            let field = BlurField::new(kernel.clone(), intensity.clone()).expect("they fit");
            let blurred = composite(case.image.clone(), &field).expect("good inputs");
            blurred.picture().sum().backward()
        });
    }
}

#[divan::bench]
fn ssim_and_gradient_256x144(bencher: Bencher<'_, '_>) {
    let device = Device::flex();
    let a = picture(256, 144, 3, &device.clone().autodiff()).require_grad();
    let b = picture(256, 144, 3, &device).autodiff();
    bencher.bench_local(|| ssim(a.clone(), &b).backward());
}

#[divan::bench]
fn adam_960_000_values(bencher: Bencher<'_, '_>) {
    let device = Device::flex();
    let mut parameter = picture(48, 20_000, 1, &device).squeeze_dim::<2>(2);
    let gradient = parameter.clone();
    let mut state = AdamState::new(&parameter);
    let rate = &LearningRate::Uniform(1e-3);
    bencher.bench_local(|| {
        let step = AdamStep { rate, drawn: &[] };
        adam_step(&mut parameter, gradient.clone(), &mut state, &step);
    });
}
