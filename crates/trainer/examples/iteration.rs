//! Time of one training iteration at 256x144 with 20,000 Gaussians, blur off: median of 50 after 10.
//!
//! The Gaussians: z uniform in [2, 8]; x and y uniform over 1.1 times the view at that depth; a size of
//! 1.3 px times exp(0.4 n), per axis times exp(0.3 n); random rotations; opacity sigmoid(2 n); SH degree 3;
//! focal 30/36 of the width; n standard normal. Optimiser step and both image losses included.
//!
//!     cargo run -p trainer --example iteration

use glam::DAffine3;
use io::{Frame, Image, Scene, SceneFormat, SparsePoint, View};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use splat_core::{Camera, Gaussians};
use std::time::Instant;
use trainer::{Device, Settings, Trainer};

const WIDTH: usize = 256;
const HEIGHT: usize = 144;
const COUNT: usize = 20_000;

fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (f64::from(rng.next_u32()) + 0.5) / (f64::from(u32::MAX) + 1.0)
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (-2.0 * uniform(rng).ln()).sqrt() * (std::f64::consts::TAU * uniform(rng)).cos()
}

fn gaussians(rng: &mut ChaCha8Rng, focal: f64) -> Gaussians {
    let mut g = Gaussians {
        sh_degree: 3,
        ..Gaussians::default()
    };
    for _ in 0..COUNT {
        let z = 2.0 + 6.0 * uniform(rng);
        let x = (uniform(rng) - 0.5) * 1.1 * WIDTH as f64 * z / focal;
        let y = (uniform(rng) - 0.5) * 1.1 * HEIGHT as f64 * z / focal;
        let size = 1.3 * z / focal * (0.4 * normal(rng)).exp();
        g.means.push([x, y, z].map(|v| v as f32));
        g.log_scales.push(std::array::from_fn(|_| {
            (size.ln() + 0.3 * normal(rng)) as f32
        }));
        g.quats.push(std::array::from_fn(|_| normal(rng) as f32));
        g.opacity_logits.push(2.0 * normal(rng) as f32);
        g.sh.extend((0..48).map(|k| (normal(rng) * if k < 3 { 0.5 } else { 0.05 }) as f32));
    }
    g
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let focal = WIDTH as f64 * 30.0 / 36.0;
    let camera = Camera::pinhole(
        WIDTH,
        HEIGHT,
        focal,
        focal,
        WIDTH as f64 / 2.0,
        HEIGHT as f64 / 2.0,
    );
    let pixels = (0..WIDTH * HEIGHT * 3)
        .map(|_| uniform(&mut rng) as f32)
        .collect();
    let frame = Frame {
        view: View {
            name: "noise".to_owned(),
            camera,
            cam_from_world: DAffine3::IDENTITY,
            time: 0.0,
            image: Image {
                width: WIDTH,
                height: HEIGHT,
                pixels,
            },
        },
        depth: None,
        mask: None,
    };
    let scene = Scene {
        root: std::env::temp_dir(),
        name: "bench".to_owned(),
        format: SceneFormat::ShapeOfMotion,
        downscale: 1,
        frames: vec![frame],
        test: Vec::new(),
        points: vec![SparsePoint {
            position: glam::DVec3::Z * 5.0,
            color: [0.5; 3],
        }],
        tracks: None,
        notes: Vec::new(),
    };
    // All SH degrees from the first iteration on, density control and blur off: the same work every time.
    let mut settings = Settings {
        iterations: 200,
        ..Settings::default()
    };
    settings.blur.enabled = false;
    settings.gaussians.sh_degree_every = 1;
    settings.gaussians.control_from = 40_000;
    let mut trainer = Trainer::new(scene, settings, &Device::flex())?;
    trainer.start_from(&gaussians(&mut rng, focal))?;
    let mut times = Vec::new();
    for _ in 0..60 {
        let started = Instant::now();
        trainer.step()?;
        times.push(started.elapsed().as_secs_f64() * 1e3);
    }
    let mut counted = times.split_off(10);
    counted.sort_by(f64::total_cmp);
    eprintln!(
        "iteration at {WIDTH}x{HEIGHT}, {COUNT} Gaussians, blur off: median {:.1} ms, fastest {:.1}, slowest {:.1} ({} threads)",
        counted[counted.len() / 2],
        counted[0],
        counted[counted.len() - 1],
        rayon::current_num_threads()
    );
    Ok(())
}
