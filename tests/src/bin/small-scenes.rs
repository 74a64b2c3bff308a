//! Writes small scenes of the rasteriser's own as folders: `cargo run --package limpid-tests --bin small-scenes -- DIR`.
//!
//! One, two and three balls that each go their own way and a rod that bends, each blurred and sharp, with test views beside the
//! frames: what the study `small` trains (`cargo xtask lab small --scenes DIR`).

use burn::tensor::Device;
use limpid_tests::bodies::{Bodies, scene, views_beside};
use limpid_tests::folder;
use std::error::Error;
use std::path::PathBuf;

/// From the training frames to the views that are scored, scene units; movers are shifted by five pixels.
const ASIDE: f64 = 0.1;
/// Turn of the camera in a frame, rad.
const SHAKES: [(f64, &str); 2] = [(0.12, ""), (0.0, "-sharp")];
const BODIES: [(Bodies, &str); 4] = [
    (Bodies::Balls(1), "one-ball"),
    (Bodies::Balls(2), "two-balls"),
    (Bodies::Balls(3), "three-balls"),
    (Bodies::Rod, "rod"),
];

fn main() -> Result<(), Box<dyn Error + Send + Sync>> {
    let argument = std::env::args_os().nth(1);
    let root = PathBuf::from(argument.ok_or("which folder are the scenes to be written to?")?);
    let device = Device::flex();
    for (shake, blur) in SHAKES {
        for (bodies, name) in BODIES {
            let mut scene = scene(bodies, shake, &device);
            scene.test = views_beside(bodies, shake, ASIDE, &device);
            folder::write(&scene, &root.join(format!("{name}{blur}")))?;
        }
    }
    Ok(())
}
