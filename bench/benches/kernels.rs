//! The kernels by themselves, on slices and tensors of fixed sizes: `cargo xtask bench`.

#![allow(
    missing_docs,
    reason = "the macros of criterion write public functions"
)]

use std::hint::black_box;

use bpnet::{BlurField, BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
use burn::tensor::{DType, Device, Tensor, TensorData};
use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use glam::DAffine3;
use limpid_bench::workload::{Blur, Workload};
use splat_core::cpu::{BackwardOptions, Forward, View, backward, project, rasterize};
use trainer::adam::{AdamOptions, AdamState, LearningRate, adam_step};
use trainer::losses::ssim;

/// As in the program: large buffers are kept for the next iteration.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const SIZES: [(usize, usize, usize); 2] = [(256, 144, 20_000), (512, 288, 100_000)];

fn workload((width, height, gaussians): (usize, usize, usize)) -> Workload {
    Workload {
        width,
        height,
        gaussians,
        blur: Blur::Off,
        kernel_size: 9,
    }
}

/// Values without a pattern, in [0, 1).
fn values(count: usize, seed: usize) -> Vec<f32> {
    (0..count)
        .map(|i| ((i * 7919 + seed * 104_729) % 10_007) as f32 / 10_007.0)
        .collect()
}

fn picture(width: usize, height: usize, channels: usize, device: &Device) -> Tensor<3> {
    let values = values(width * height * channels, channels);
    let data = TensorData::new(values, [height, width, channels]);
    Tensor::from_data(data, (device, DType::F32))
}

fn splatting(c: &mut Criterion) {
    for size in SIZES {
        let workload = workload(size);
        let g = workload.gaussians();
        let splats = g.slices();
        let view = View::new(&workload.camera(), &DAffine3::IDENTITY, 3);
        let v_output: Vec<f32> = values(size.0 * size.1 * 5, 3)
            .iter()
            .map(|v| v - 0.5)
            .collect();
        let projection = project(&splats, &view).expect("good Gaussians");
        let raster = rasterize(&projection, &[], 0).expect("good Gaussians");
        let name = format!("{}x{}, {} Gaussians", size.0, size.1, size.2);
        let mut group = c.benchmark_group("splatting");
        group.bench_function(BenchmarkId::new("project", &name), |b| {
            b.iter(|| project(black_box(&splats), &view));
        });
        group.bench_function(BenchmarkId::new("rasterize", &name), |b| {
            b.iter(|| rasterize(black_box(&projection), &[], 0));
        });
        group.bench_function(BenchmarkId::new("backward", &name), |b| {
            b.iter(|| {
                let forward = Forward {
                    splats: black_box(&splats),
                    projection: &projection,
                    features: &[],
                    state: &raster.state,
                };
                backward(&forward, &v_output, BackwardOptions::default())
            });
        });
        group.bench_function(BenchmarkId::new("all", &name), |b| {
            b.iter(|| {
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
        });
        group.finish();
    }
}

fn blur(c: &mut Criterion) {
    let (width, height, k) = (256, 144, 9);
    let device = Device::flex().autodiff();
    let config = BpNetConfig {
        kernel_size: k,
        num_frames: 24,
        shortcut: true,
        downscale: 1,
        head: HeadInit::Mild,
        seed: 1,
    };
    let net = BpNet::new(&config, &device, DType::F32).expect("a good configuration");
    let inputs = BlurInputs {
        color: picture(width, height, 3, &device),
        disparity: picture(width, height, 1, &device).squeeze_dim(2),
        mask: picture(width, height, 1, &device).squeeze_dim(2),
    };
    let image = picture(width, height, 3, &device).require_grad();
    let field = net
        .forward(1, &inputs, Extractor::Trained)
        .expect("good inputs");
    let kernel = field.kernel().detach().require_grad();
    let intensity = field.intensity().detach().require_grad();
    let mut group = c.benchmark_group("blur, 256x144, K = 9");
    group.sample_size(20);
    for (name, extractor) in [
        ("trained", Extractor::Trained),
        ("frozen", Extractor::Frozen),
    ] {
        group.bench_function(BenchmarkId::new("extractor, BP-Net and blur", name), |b| {
            b.iter(|| {
                let field = net.forward(1, &inputs, extractor).expect("good inputs");
                let blurred = composite(image.clone(), &field).expect("good inputs");
                blurred.picture().sum().backward()
            });
        });
    }
    group.bench_function("blur alone", |b| {
        b.iter(|| {
            let field = BlurField::new(kernel.clone(), intensity.clone()).expect("they fit");
            let blurred = composite(image.clone(), &field).expect("good inputs");
            blurred.picture().sum().backward()
        });
    });
    group.finish();
}

fn rest(c: &mut Criterion) {
    let device = Device::flex();
    let (a, b) = (
        picture(256, 144, 3, &device.clone().autodiff()).require_grad(),
        picture(256, 144, 3, &device).autodiff(),
    );
    c.bench_function("SSIM and its gradient, 256x144", |bench| {
        bench.iter(|| ssim(a.clone(), &b).backward());
    });
    let mut parameter = picture(48, 20_000, 1, &device).squeeze_dim::<2>(2);
    let gradient = parameter.clone();
    let mut state = AdamState::new(&parameter);
    let rate = LearningRate::Uniform(1e-3);
    c.bench_function("Adam, 960,000 values", |bench| {
        bench.iter(|| {
            let options = AdamOptions::default();
            adam_step(
                &mut parameter,
                gradient.clone(),
                &mut state,
                &rate,
                &options,
            );
        });
    });
}

criterion_group!(benches, splatting, blur, rest);
criterion_main!(benches);
