//! Key frames of a camera's path, as a page or a script exports them.
//!
//! ```json
//! { "keyframes": [
//!     { "second": 0.0, "time": 0.0, "fov": 50.0,
//!       "cam_from_world": [1, 0, 0, 0,  0, 1, 0, 0,  0, 0, 1, 0] },
//!     { "second": 4.0, "time": 11.5, "fov": 40.0,
//!       "cam_from_world": [1, 0, 0, 0.5,  0, 1, 0, 0,  0, 0, 1, 0] }
//! ] }
//! ```
//!
//! `second` is when the camera is there, from the beginning of the clip, and later in each key frame than in the one before.
//! `time` is what moment of the scene it sees, in units of training frames; it may stand still, or go backwards.
//! `cam_from_world` are the rows of [R | t], row-major, with OpenCV's camera axes (x right, y down, z forward).
//! `fov` is the vertical angle of view in degrees; without it, the training camera's.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};
use serde::Deserialize;

use crate::IoError;
use crate::json::read_json;
use crate::rotation::nearest_rotation;

/// A place of the camera on its path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyFrame {
    /// When it is there, seconds from the beginning.
    pub second: f64,
    /// The moment of the scene that it sees, training frames.
    pub time: f64,
    /// Its pose, OpenCV axes.
    pub cam_from_world: DAffine3,
    /// Vertical angle of view, degrees; `None` for the training camera's.
    pub fov: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    keyframes: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    second: f64,
    time: f64,
    cam_from_world: [f64; 12],
    fov: Option<f64>,
}

/// Reads the key frames of a path: one or more, in order.
///
/// # Errors
/// [`IoError::Access`], [`IoError::Json`]; [`IoError::Malformed`] for seconds that do not increase, a pose that is no rotation and
/// translation, and an angle of view that no camera has.
pub fn read_key_frames(path: &Path) -> Result<Vec<KeyFrame>, IoError> {
    let File { keyframes } = read_json(path)?;
    if keyframes.is_empty() {
        return Err(IoError::malformed(path, "there is no key frame"));
    }
    let mut frames: Vec<KeyFrame> = Vec::with_capacity(keyframes.len());
    for (index, entry) in keyframes.into_iter().enumerate() {
        let wrong = |what: &str| {
            Err(IoError::malformed(
                path,
                format!("key frame {index} {what}"),
            ))
        };
        if frames
            .last()
            .is_some_and(|last| entry.second <= last.second)
        {
            return wrong("is not later (`second`) than the one before it");
        }
        if entry.fov.is_some_and(|fov| !(1e-3..179.9).contains(&fov)) {
            return wrong("has an angle of view (`fov`) that is not from 0.001 to 179.9 degrees");
        }
        let Some(cam_from_world) = pose(&entry.cam_from_world) else {
            return wrong("has no pose: `cam_from_world` is [R | t] with a rotation R");
        };
        frames.push(KeyFrame {
            second: entry.second,
            time: entry.time,
            cam_from_world,
            fov: entry.fov,
        });
    }
    Ok(frames)
}

/// The pose with these rows; `None` where they are none. Rounded numbers become the nearest rotation.
fn pose(rows: &[f64; 12]) -> Option<DAffine3> {
    let column = |c: usize| DVec3::new(rows[c], rows[4 + c], rows[8 + c]);
    let rotation = nearest_rotation(DMat3::from_cols(column(0), column(1), column(2)))?;
    let translation = column(3);
    translation
        .is_finite()
        .then(|| DAffine3::from_mat3_translation(rotation, translation))
}

#[cfg(test)]
mod tests {
    use super::*;

    const POSE: &str = "[1, 0, 0, 2,  0, 0, -1, 3,  0, 1, 0, 4]";

    fn read(text: &str) -> Result<Vec<KeyFrame>, IoError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("path.json");
        std::fs::write(&path, text).unwrap();
        read_key_frames(&path)
    }

    #[test]
    fn key_frames_are_read_as_they_are_documented() {
        let text = format!(
            r#"{{ "keyframes": [
                {{ "second": 0, "time": 1.5, "fov": 50, "cam_from_world": {POSE} }},
                {{ "second": 2, "time": 1.5, "cam_from_world": {POSE} }} ] }}"#
        );
        let frames = read(&text).unwrap();
        assert_eq!(frames.len(), 2);
        assert_eq!((frames[0].time, frames[0].fov), (1.5, Some(50.0)));
        assert_eq!((frames[1].second, frames[1].fov), (2.0, None));
        // A point ahead on y is ahead on z for this camera.
        let seen = frames[0].cam_from_world.transform_point3(DVec3::Y);
        assert!(seen.abs_diff_eq(DVec3::new(2.0, 3.0, 5.0), 1e-12), "{seen}");
    }

    #[test]
    fn what_is_no_path_is_refused_by_name() {
        let frame = |second: &str, pose: &str, fov: &str| {
            format!(
                r#"{{ "second": {second}, "time": 0, "cam_from_world": {pose}, "fov": {fov} }}"#
            )
        };
        let good = frame("0", POSE, "50");
        let cases = [
            ("no key frame", String::new()),
            ("key frame 1 is not later", format!("{good}, {good}")),
            ("`fov`", frame("0", POSE, "180")),
            ("`fov`", frame("0", POSE, "-1")),
            (
                "`cam_from_world`",
                frame("0", "[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]", "50"),
            ),
            (
                "`cam_from_world`",
                frame("0", "[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]", "50"),
            ),
            (
                "`cam_from_world`",
                frame("0", "[1, 0, 0, 1e999, 0, 1, 0, 0, 0, 0, 1, 0]", "50"),
            ),
            ("keyframes[0]", frame("0", "[1, 2]", "50")),
            ("keyframes[0]", frame("\"soon\"", POSE, "50")),
        ];
        for (what, frames) in cases {
            let error = read(&format!(r#"{{ "keyframes": [{frames}] }}"#)).expect_err(what);
            let text = error.to_string();
            let known = text.contains(what) || text.contains("number out of range");
            assert!(known, "{what}: {text}");
        }
    }
}
