//! Renders a PLY of Gaussians, or two of them where none is given, to a PNG beside it.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use io::{Image, read_ply, write_png};
use splat_core::cpu::{View, project, rasterize};
use splat_core::{Camera, glam::DAffine3, glam::DVec3};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut path = std::env::temp_dir().join("two_gaussians.ply");
    match std::env::args_os().nth(1) {
        Some(given) => path = given.into(),
        None => std::fs::write(&path, two_gaussians())?,
    }
    let gaussians = read_ply(&path)?;
    let camera = Camera::pinhole([320, 240], [250.0, 250.0], [160.0, 120.0]);
    let cam_from_world = DAffine3::from_translation(DVec3::Z * 4.0);
    let view = View::new(&camera, &cam_from_world, gaussians.sh_degree);
    let raster = rasterize(&project(&gaussians.slices(), &view)?, &[], 0)?;
    let image = Image {
        width: camera.width,
        height: camera.height,
        pixels: raster.color().flatten().collect(),
    };
    let png = path.with_extension("render.png");
    write_png(&png, &image)?;
    println!("{} Gaussians drawn into {}", gaussians.len(), png.display());
    Ok(())
}

/// A red one on the left of a blue one.
fn two_gaussians() -> String {
    let names =
        "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let properties = names.replace(' ', "\nproperty float ");
    format!(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float {properties}\nend_header\n\
         -0.5 0 0 1.5 -1.5 -1.5 3 -1.5 -1.5 -1.5 1 0 0 0\n0.5 0 0 -1.5 -1.5 1.5 3 -1.5 -1.5 -1.5 1 0 0 0\n"
    )
}
