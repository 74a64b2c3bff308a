//! A copy of a scene whose training poses are wrong, to measure what refining them gives.

use std::ffi::CStr;
use std::fs;
use std::path::{Path, PathBuf, absolute};

use glam::{DQuat, DVec3};
use io::Scene;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};

type Failure = Box<dyn std::error::Error>;

/// Copies a scene in the layout of Shape-of-Motion to `out`, and turns the camera of every training frame (of an even number
/// as its name in the COLMAP model) at random, so that the picture's middle moves by `px` (root mean square, normally
/// distributed, zero on average over the frames).
///
/// # Errors
/// There is no such scene, it has no binary COLMAP model of numbered pairs, or `out` exists, lies in the scene or cannot be
/// written.
pub fn perturb(scene: &Path, out: &Path, px: f64, seed: u64) -> Result<(), Failure> {
    let sigma = px / focal_px(scene)? / 2.0_f64.sqrt();
    if out.exists() || absolute(out)?.starts_with(absolute(scene)?) {
        return Err("the copy goes to a new folder outside of the scene".into());
    }
    copy(scene, out)?;
    let path = images_file(out).ok_or("the scene has no images.bin")?;
    let mut bytes = fs::read(&path)?;
    let poses = training_poses(&bytes)?;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let turns: Vec<DVec3> = poses
        .iter()
        .map(|_| sigma * DVec3::new(normal(&mut random), normal(&mut random), 0.0))
        .collect();
    let mean = turns.iter().sum::<DVec3>() / turns.len().max(1) as f64;
    for (at, turn) in poses.into_iter().zip(turns) {
        turn_pose(&mut bytes, at, turn - mean)?;
    }
    Ok(fs::write(&path, bytes)?)
}

/// Where the file has the poses of the training frames.
fn training_poses(bytes: &[u8]) -> Result<Vec<usize>, Failure> {
    let (mut at, mut poses) = (8, Vec::new());
    for _ in 0..number(bytes, 0)? {
        let rest = bytes.get(at + 64..).ok_or("images.bin ends too early")?;
        let name = CStr::from_bytes_until_nul(rest)?;
        let stem = Path::new(name.to_str()?).file_stem();
        let index: usize = stem.unwrap_or_default().to_string_lossy().parse()?;
        if index.is_multiple_of(2) {
            poses.push(at + 4);
        }
        let points = at + 64 + name.to_bytes_with_nul().len();
        at = points + 8 + 24 * usize::try_from(number(bytes, points)?)?;
    }
    Ok(poses)
}

/// Turns the pose (quaternion w x y z, translation) at a place of the file in the camera's axes.
fn turn_pose(bytes: &mut [u8], at: usize, turn: DVec3) -> Result<(), Failure> {
    let mut pose = [0.0; 7];
    for (k, value) in pose.iter_mut().enumerate() {
        *value = f64::from_bits(number(bytes, at + 8 * k)?);
    }
    let [w, x, y, z, shift @ ..] = pose;
    let by = DQuat::from_scaled_axis(turn);
    let rotation = by * DQuat::from_xyzw(x, y, z, w);
    let shift = by * DVec3::from_array(shift);
    let turned = [
        rotation.w, rotation.x, rotation.y, rotation.z, shift.x, shift.y, shift.z,
    ];
    for (k, value) in turned.iter().enumerate() {
        bytes[at + 8 * k..at + 8 * k + 8].copy_from_slice(&value.to_le_bytes());
    }
    Ok(())
}

/// A number of the standard normal distribution (Box and Muller).
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let mut uniform = || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
    let radius = (-2.0 * (1.0 - uniform()).ln()).sqrt();
    radius * (std::f64::consts::TAU * uniform()).cos()
}

/// Eight bytes of the file as a little-endian number.
fn number(bytes: &[u8], at: usize) -> Result<u64, Failure> {
    let eight = bytes.get(at..at + 8).ok_or("images.bin ends too early")?;
    Ok(u64::from_le_bytes(eight.try_into()?))
}

/// Focal length of the first training frame, px.
fn focal_px(scene: &Path) -> Result<f64, Failure> {
    let scene = Scene::open(scene)?;
    let first = scene.frames.first().ok_or("the scene has no frame")?;
    Ok(first.view.camera.fx)
}

/// Where a scene has its COLMAP model's poses.
fn images_file(scene: &Path) -> Option<PathBuf> {
    let colmap = scene.join("flow3d_preprocessed/colmap");
    let folders = ["sparse/0", "sparse"].map(|folder| colmap.join(folder).join("images.bin"));
    folders.into_iter().find(|path| path.is_file())
}

/// Copies a folder with all that is in it.
fn copy(from: &Path, to: &Path) -> Result<(), Failure> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}
