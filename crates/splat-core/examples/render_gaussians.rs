//! Renders a ring of Gaussians on plain slices: `cargo run -p splat-core --example render_gaussians`.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use splat_core::cpu::{View, project, rasterize};
use splat_core::glam::{DAffine3, DVec3};
use splat_core::{Camera, Gaussians, SplatError};

fn main() -> Result<(), SplatError> {
    let count = 12;
    let around = |k: usize| (std::f32::consts::TAU * k as f32 / count as f32).sin_cos();
    let gaussians = Gaussians {
        means: (0..count)
            .map(|k| [around(k).1, around(k).0, 0.0])
            .collect(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        log_scales: vec![[0.2_f32.ln(); 3]; count],
        opacity_logits: vec![2.0; count],
        // Degree 0: colour = 0.5 + 0.282 times the coefficient.
        sh: (0..count)
            .flat_map(|k| [around(k).0, around(k).1, 1.5])
            .collect(),
        sh_degree: 0,
    }
    .checked()?;

    let camera = Camera::pinhole([320, 240], [250.0, 250.0], [160.0, 120.0]);
    let cam_from_world = DAffine3::from_translation(DVec3::new(0.0, 0.0, 4.0));
    let view = View::new(&camera, &cam_from_world, gaussians.sh_degree);
    let projection = project(&gaussians.slices(), &view)?;
    let image = rasterize(&projection, &[], 0)?;

    let covered = image.alpha().filter(|&alpha| alpha > 0.5).count();
    let share = 100.0 * covered as f64 / camera.num_pixels() as f64;
    println!(
        "{} of {count} Gaussians drawn, {share:.1} % of the image covered",
        projection.num_visible()
    );
    Ok(())
}
