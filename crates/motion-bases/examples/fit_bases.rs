//! Fits motion bases to the tracks of a turning body, and asks where a point is between two frames.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::{DQuat, DVec3};
use motion_bases::{InitOptions, MotionBases, MotionError, Tracks3d, initialize};

/// Where a point of the body is at a time.
fn position(point: usize, time: f64) -> [f64; 3] {
    let arm = DVec3::new(point as f64, 1.0, 0.0).sin();
    (DQuat::from_rotation_y(0.1 * time) * arm + 5.0 * DVec3::Z).to_array()
}

fn main() -> Result<(), MotionError> {
    let (frames, points) = (12, 60);
    let track = |p| (0..frames).map(move |t| position(p, t as f64).into());
    let tracks = Tracks3d {
        num_frames: frames,
        positions: (0..points).flat_map(track).collect(),
        visible: vec![true; frames * points],
        confidence: vec![1.0; frames * points],
        colors: vec![[0.5; 3]; points],
    };
    let (num_bases, seed) = (4, 1);
    let init = initialize(&tracks, &InitOptions { num_bases, seed })?;
    println!("motion bases for {points} tracks: {}", init.num_bases);

    let device = Device::flex();
    let bases = MotionBases::from_init(&init, &device, DType::F32);
    let logits = TensorData::new(init.coefficients, [init.rows.len(), init.num_bases]);
    let logits = Tensor::<2>::from_data(logits, &device).narrow(0, 0, 1);
    let start = position(init.rows[0], init.canonical_frame as f64);
    let mean = Tensor::<2>::from_data([start], &device);
    let moved = bases.motion_at(&logits, 4.5).transform_means(&mean);
    println!("at frame 4.5: {}", moved.into_data());
    println!("in truth: {:?}", position(init.rows[0], 4.5));
    Ok(())
}
