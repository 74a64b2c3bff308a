//! Warps a picture with depth to a camera half-way to the next one, and to one beside the path.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use glam::{DAffine3, DVec3};
use splat_core::Camera;
use unseen_views::{Source, WarpError, WarpOptions, parallel_pose, perpendicular_pose, warp};

fn main() -> Result<(), WarpError> {
    let (width, height) = (64, 48);
    let camera = Camera::pinhole([width, height], [60.0, 60.0], [32.0, 24.0]);
    // A checkered wall 4 units away.
    let square = |i: usize| ((i % width / 8 + i / width / 8) % 2) as f32;
    let color: Vec<f32> = (0..width * height).flat_map(|i| [square(i); 3]).collect();
    let here = DAffine3::IDENTITY;
    let next = DAffine3::from_translation(DVec3::new(-0.4, 0.0, 0.0));
    let source = Source {
        camera: &camera,
        cam_from_world: &here,
        color: &color,
        depth: &vec![4.0; width * height],
        mask: None,
    };
    let between = parallel_pose(&here, &next).expect("the cameras look the same way");
    let beside = perpendicular_pose(&here, &next, 0.2);
    for (name, pose) in [("between", between), ("beside", beside)] {
        let view = warp(&source, &camera, &pose, &WarpOptions::default())?;
        let share = 100.0 * view.valid_fraction();
        println!("{name}: {share:.0} % of the pixels are seen in the picture");
        assert!(share > 90.0, "a small step shows little that is new");
    }
    Ok(())
}
