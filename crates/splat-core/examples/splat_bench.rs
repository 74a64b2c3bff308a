//! Times the slice kernels on random Gaussians: `cargo run -p splat-core --example splat_bench [count [width height]]`.
//!
//! z is uniform in [2, 8], x and y over 1.1 times the view at that depth; sizes 1.3 px exp(0.4 n),
//! per axis exp(0.3 n); random rotations; opacity sigmoid(2 n), n standard normal; SH degree 3.

use std::time::Instant;

use glam::DAffine3;
use splat_core::Camera;
use splat_core::cpu::{BackwardOptions, SplatSlices, View, backward, project, rasterize};

/// SplitMix64.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Fastest and median, ms.
fn summary(mut times: Vec<f64>) -> [f64; 2] {
    times.sort_by(f64::total_cmp);
    [1e3 * times[0], 1e3 * times[times.len() / 2]]
}

#[allow(clippy::print_stdout, reason = "a program that reports times")]
fn main() {
    let args: Vec<usize> = std::env::args()
        .skip(1)
        .filter_map(|a| a.parse().ok())
        .collect();
    let count = args.first().copied().unwrap_or(20_000);
    let (width, height) = (
        args.get(1).copied().unwrap_or(256),
        args.get(2).copied().unwrap_or(144),
    );
    let (w, h) = (width as f64, height as f64);
    let focal = 30.0 / 36.0 * w;
    let camera = Camera::pinhole(width, height, focal, focal, 0.5 * w, 0.5 * h);
    let mut random = Random(1);
    let (mut means, mut quats, mut log_scales) = (Vec::new(), Vec::new(), Vec::new());
    let (mut opacity_logits, mut sh) = (Vec::new(), Vec::new());
    for _ in 0..count {
        let z = 2.0 + 6.0 * random.uniform();
        for side in [w, h] {
            means.push((1.1 * (random.uniform() - 0.5) * side / focal * z) as f32);
        }
        means.push(z as f32);
        quats.extend((0..4).map(|_| random.normal() as f32));
        let size = 1.3 * z / focal * (0.4 * random.normal()).exp();
        log_scales.extend((0..3).map(|_| (size.ln() + 0.3 * random.normal()) as f32));
        opacity_logits.push((2.0 * random.normal()) as f32);
        sh.extend((0..48).map(|_| (0.3 * random.normal()) as f32));
    }
    let splats = SplatSlices {
        means: &means,
        quats: &quats,
        left_rotations: &[],
        log_scales: &log_scales,
        opacity_logits: &opacity_logits,
        sh: &sh,
    };
    let view = View::new(&camera, &DAffine3::IDENTITY, 3);
    let v_output: Vec<f32> = (0..width * height * 5)
        .map(|_| random.normal() as f32)
        .collect();
    let (mut t_project, mut t_forward, mut t_backward) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..60 {
        let start = Instant::now();
        let projection = project(&splats, &view).expect("good input");
        let projected = start.elapsed().as_secs_f64();
        let raster = rasterize(&projection, &[], 0).expect("good input");
        let blended = start.elapsed().as_secs_f64();
        let gradients = backward(
            &splats,
            &projection,
            &[],
            &raster.state,
            &v_output,
            BackwardOptions::default(),
        )
        .expect("good input");
        let done = start.elapsed().as_secs_f64();
        t_project.push(projected);
        t_forward.push(blended - projected);
        t_backward.push(done - blended);
        if t_project.len() == 60 {
            println!(
                "{count} Gaussians, {width}x{height}: {} visible, {} slots, mean alpha {:.3}, |v_means| {:.6e}",
                projection.num_visible(),
                projection.num_slots(),
                raster.output.iter().skip(3).step_by(5).sum::<f32>() / (w * h) as f32,
                gradients
                    .means
                    .iter()
                    .map(|v| f64::from(v * v))
                    .sum::<f64>()
                    .sqrt(),
            );
        }
    }
    let [p, f, b] = [t_project, t_forward, t_backward].map(summary);
    for (name, k) in [("fastest", 0), ("median", 1)] {
        println!(
            "{name} of 60, {} threads: project {:.2} ms, forward {:.2} ms, backward {:.2} ms, together {:.2} ms",
            rayon::current_num_threads(),
            p[k],
            f[k],
            b[k],
            p[k] + f[k] + b[k],
        );
    }
}
