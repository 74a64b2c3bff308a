//! Poses of training frames made worse by so much.

use crate::arrays::Array;
use crate::colmap::{Lens, Model, Pose};
use crate::copies::{PICTURES, entries, has_ending, picture_size};
use crate::error::LabError;
use crate::perturb::{Draw, depths, median};
use glam::{DQuat, DVec2, DVec3};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// How a camera is moved, in the world's axes.
#[derive(Clone, Copy)]
struct Move {
    /// About its own place, rad.
    turn: DVec3,
    /// In units of the scene's median depth.
    shift: DVec3,
}

/// Turns and shifts the cameras of training frames in a COLMAP model's file of poses ([`crate::Perturb::poses_px`]). `disparity` is
/// the scene's folder of it, and `pictures` that of training frames.
pub(crate) fn poses(
    from: &Path,
    to: &Path,
    (disparity, pictures): (&Path, &Path),
    px: f64,
    draw: Draw<'_>,
) -> Result<(), LabError> {
    let model = Model::read(from)?;
    let stem = |path: &Path| path.file_stem().map(|s| s.to_string_lossy().into_owned());
    let files = |folder: &Path| -> Result<Vec<PathBuf>, LabError> {
        let all = entries(folder)?.into_iter();
        Ok(all.filter(|file| has_ending(file, PICTURES)).collect())
    };
    let frames = files(pictures)?;
    let stems: BTreeSet<String> = frames.iter().filter_map(|p| stem(p)).collect();
    let test_views = pictures.with_file_name("images_test");
    let has_test_views = test_views.is_dir() && !files(&test_views)?.is_empty();
    let training = model.training(&stems, has_test_views)?;
    let size = picture_size(frames.first().map_or(pictures, PathBuf::as_path))?;
    if training.len() < 2 {
        let what = "poses of a single training frame cannot be wrong against each other";
        return Err(LabError::content(from, what));
    }
    let depth = median_depth(disparity)?;
    let mut views = Vec::new();
    for &at in &training {
        let image = &model.images[at];
        let lens = model
            .lenses
            .get(&image.camera)
            .ok_or_else(|| LabError::content(from, format!("it has no camera {}", image.camera)))?;
        // COLMAP may have seen larger pictures.
        views.push((image.pose, lens.of_size(size)));
    }
    let moves: Vec<Move> = training
        .iter()
        .map(|&at| {
            let mut noise = draw.noise("poses", &model.images[at].stem);
            let mut vector = || DVec3::from_array(std::array::from_fn(|_| noise.either_way()));
            Move {
                turn: vector(),
                shift: vector(),
            }
        })
        .collect();
    let moves = of_length(px, &centred(&moves), &views);
    let moved = training.iter().zip(moves).zip(&views);
    let moved: BTreeMap<usize, Pose> = moved
        .map(|((&at, by), (pose, _))| (at, moved_by(by, depth, pose)))
        .collect();
    fs::write(to, model.with(&moved)).map_err(LabError::file(to))
}

/// Less their mean.
fn centred(moves: &[Move]) -> Vec<Move> {
    let count = moves.len().max(1) as f64;
    let turn = moves.iter().map(|m| m.turn).sum::<DVec3>() / count;
    let shift = moves.iter().map(|m| m.shift).sum::<DVec3>() / count;
    let less = |m: &Move| Move {
        turn: m.turn - turn,
        shift: m.shift - shift,
    };
    moves.iter().map(less).collect()
}

/// All by one factor smaller or larger, so that points at the median depth move by so many px: root mean square over the pictures.
fn of_length(px: f64, moves: &[Move], views: &[(Pose, Lens)]) -> Vec<Move> {
    /// Points to a side of a picture.
    const GRID: usize = 16;
    let (mut sum, mut count) = (0.0, 0.0);
    for (by, (pose, lens)) in moves.iter().zip(views) {
        for point in 0..GRID * GRID {
            let cell = DVec2::new((point % GRID) as f64, (point / GRID) as f64);
            let at = (cell + 0.5) / GRID as f64 * lens.size;
            sum += moved_px(by, pose, lens, at).length_squared();
            count += 1.0;
        }
    }
    let factor = px / f64::sqrt(sum / count);
    let scaled = |m: &Move| Move {
        turn: factor * m.turn,
        shift: factor * m.shift,
    };
    moves.iter().map(scaled).collect()
}

/// How far a small move of the camera moves a point at the median depth that is seen at a place of the picture, px.
fn moved_px(by: &Move, pose: &Pose, lens: &Lens, at: DVec2) -> DVec2 {
    let point = ((at - lens.center) / lens.focal).extend(1.0);
    let (turn, shift) = (pose.rotation * by.turn, pose.rotation * by.shift);
    let moved = -turn.cross(point) - shift;
    lens.focal * (moved.truncate() - moved.z * point.truncate())
}

/// The pose of a camera that was moved.
fn moved_by(by: Move, depth: f64, pose: &Pose) -> Pose {
    let center = -(pose.rotation.inverse() * pose.translation) + depth * by.shift;
    // Half the turn as it is, not its sine: for turns this small they are one, and square roots are the same on every machine.
    let half = 0.5 * by.turn;
    let turn = DQuat::from_xyzw(half.x, half.y, half.z, 1.0).normalize();
    let rotation = (pose.rotation * turn.inverse()).normalize();
    Pose {
        rotation,
        translation: -(rotation * center),
    }
}

/// Of all frames in a folder of disparity.
fn median_depth(disparity: &Path) -> Result<f64, LabError> {
    let mut all = Vec::new();
    let files = entries(disparity)?;
    for file in files.iter().filter(|file| has_ending(file, &["npy"])) {
        all.extend(depths(&Array::read(file)?));
    }
    median(all).ok_or_else(|| LabError::content(disparity, "there is no depth in it"))
}
