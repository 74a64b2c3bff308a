//! Poses, projected without the code that moves them.

use crate::copies::{DEPTH, IMAGES, NONE, Outcome, array, copy, demo, scenes, whole_copy};
use limpid_lab::Perturb;
use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

/// A pose as matrix and centre: camera from world is `rotation (x - centre)`.
#[derive(Clone, Debug, PartialEq)]
struct Seen {
    rotation: [[f64; 3]; 3],
    centre: [f64; 3],
    bytes: Vec<u8>,
}

fn seen([w, x, y, z, t @ ..]: [f64; 7], bytes: &[u8]) -> Seen {
    let n = w * w + x * x + y * y + z * z;
    assert!((n - 1.0).abs() < 1e-6, "{n}");
    let rotation = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    let centre = std::array::from_fn(|k| -(0..3).map(|i| rotation[i][k] * t[i]).sum::<f64>());
    Seen {
        rotation,
        centre,
        bytes: bytes.to_owned(),
    }
}

/// The poses of a binary model, by the images' names; the demo's have no points.
fn poses(path: &Path) -> Result<BTreeMap<String, Seen>, Box<dyn Error>> {
    let bytes = fs::read(path)?;
    let f64_at = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let (mut at, mut poses) = (8, BTreeMap::new());
    for _ in 0..u64_at(0) {
        let numbers = std::array::from_fn(|k| f64_at(at + 4 + 8 * k));
        let pose = seen(numbers, &bytes[at + 4..at + 60]);
        let name: Vec<u8> = bytes[at + 64..]
            .iter()
            .copied()
            .take_while(|b| *b != 0)
            .collect();
        let points = at + 64 + name.len() + 1;
        at = points + 8 + 24 * usize::try_from(u64_at(points))?;
        poses.insert(String::from_utf8(name)?, pose);
    }
    Ok(poses)
}

fn is_training(name: &str) -> bool {
    let number: u32 = name.trim_end_matches(".png").parse().expect("a number");
    number.is_multiple_of(2)
}

/// Root mean square of how far the pixels' points at a depth are seen from where they were, px.
fn moved_px(before: &Seen, after: &Seen, depth: f64) -> f64 {
    // `cameras.bin` of the demo.
    let (width, height, focal) = (160, 90, 160.0 / 1.2);
    let (mut sum, mut count) = (0.0, 0.0);
    for v in 0..height {
        for u in 0..width {
            let (x, y) = (f64::from(u) + 0.5 - 80.0, f64::from(v) + 0.5 - 45.0);
            let p = [x / focal * depth, y / focal * depth, depth];
            let world: [f64; 3] = std::array::from_fn(|k| {
                before.centre[k] + (0..3).map(|i| before.rotation[i][k] * p[i]).sum::<f64>()
            });
            let q: [f64; 3] = std::array::from_fn(|i| {
                (0..3)
                    .map(|k| after.rotation[i][k] * (world[k] - after.centre[k]))
                    .sum()
            });
            sum += (focal * q[0] / q[2] - x).powi(2) + (focal * q[1] / q[2] - y).powi(2);
            count += 1.0;
        }
    }
    f64::sqrt(sum / count)
}

fn median_depth() -> Result<f64, Box<dyn Error>> {
    let mut all = Vec::new();
    for entry in fs::read_dir(demo().join(DEPTH))? {
        all.extend(array(&fs::read(entry?.path())?)?);
    }
    all.sort_by(f32::total_cmp);
    Ok(1.0 / f64::from(all[all.len() / 2]))
}

#[test]
fn training_poses_are_off_by_so_many_px_and_test_poses_are_not() -> Outcome {
    let folder = tempfile::tempdir()?;
    let before = poses(&demo().join(IMAGES))?;
    let depth = median_depth()?;
    for px in [0.5, 2.0] {
        let worse = copy(
            Perturb {
                poses_px: px,
                ..NONE
            },
            1,
            folder.path(),
        )?;
        let after = poses(&worse.join(IMAGES))?;
        assert_eq!(before.len(), after.len());
        let (mut squares, mut frames) = (0.0, 0.0);
        let (mut shift, mut turn) = ([0.0; 3], [0.0; 3]);
        let (mut shifted, mut turned) = (0.0, 0.0);
        for (name, before) in &before {
            let after = &after[name];
            if !is_training(name) {
                assert_eq!(before, after, "{name}");
                continue;
            }
            squares += moved_px(before, after, depth).powi(2);
            frames += 1.0;
            // How the camera turned, in the world's axes: what is askew of the change of the rotation.
            let (a, b) = (&before.rotation, &after.rotation);
            let change = |r: usize, c: usize| (0..3).map(|k| b[k][r] * a[k][c]).sum::<f64>();
            let by = [(2, 1), (0, 2), (1, 0)].map(|(r, c)| 0.5 * (change(r, c) - change(c, r)));
            for k in 0..3 {
                let moved = (after.centre[k] - before.centre[k]) / depth;
                shift[k] += moved;
                turn[k] += by[k];
                shifted += moved * moved;
                turned += by[k] * by[k];
            }
        }
        let rms = f64::sqrt(squares / frames);
        assert!((rms / px - 1.0).abs() < 0.03, "{rms} px, not {px}");
        let (shifted, turned) = (f64::sqrt(shifted / frames), f64::sqrt(turned / frames));
        for k in 0..3 {
            assert!(
                (shift[k] / frames).abs() < 1e-6 * shifted,
                "no shift of all"
            );
            assert!((turn[k] / frames).abs() < 1e-3 * turned, "no turn of all");
        }
        assert!(
            (0.5..2.0).contains(&(shifted / turned)),
            "{shifted} and {turned}"
        );
    }
    Ok(())
}

/// A copy of the demo in `folder` with its COLMAP model as text, with a comment; and the text of its images.
fn with_text_model(folder: &Path) -> Result<(PathBuf, String), Box<dyn Error>> {
    let scene = whole_copy(folder)?;
    let bytes = fs::read(scene.join(IMAGES))?;
    let mut text = String::from("# images\n");
    for (id, (name, pose)) in poses(&scene.join(IMAGES))?.iter().enumerate() {
        let numbers = pose.bytes.chunks_exact(8);
        let numbers = numbers.map(|n| f64::from_le_bytes(n.try_into().expect("eight")).to_string());
        let numbers: Vec<String> = numbers.collect();
        text += &format!("{} {} 1 {name}\n", id + 1, numbers.join(" "));
        text += if id % 2 == 0 { "\n" } else { "1.5 2.5 -1\n" };
    }
    assert_eq!(bytes[..8], 32_u64.to_le_bytes(), "sixteen pairs");
    let model = scene.join(IMAGES);
    fs::remove_file(&model)?;
    fs::write(model.with_extension("txt"), &text)?;
    let cameras = fs::read(model.with_file_name("cameras.bin"))?;
    let f64_at = |at: usize| f64::from_le_bytes(cameras[at..at + 8].try_into().expect("eight"));
    let numbers: Vec<String> = (0..4).map(|k| f64_at(32 + 8 * k).to_string()).collect();
    let line = format!("# cameras\n1 PINHOLE 160 90 {}\n", numbers.join(" "));
    fs::write(model.with_file_name("cameras.txt"), line)?;
    Ok((scene, text))
}

#[test]
fn a_model_of_text_is_perturbed_as_a_binary_one() -> Outcome {
    let folder = tempfile::tempdir()?;
    let (scene, before) = with_text_model(folder.path())?;
    let by = Perturb {
        poses_px: 2.0,
        ..NONE
    };
    let worse = scenes(scene, folder.path()).find("demo", 1, &[], &by)?;
    let after = fs::read_to_string(worse.join(IMAGES).with_extension("txt"))?;
    let binary = copy(by, 1, folder.path().join("binary").as_path())?;
    let binary = poses(&binary.join(IMAGES))?;
    assert_eq!(before.lines().count(), after.lines().count());
    let mut moved = 0;
    for (before, after) in before.lines().zip(after.lines()) {
        let fields: Vec<&str> = after.split(' ').collect();
        let is_moved = fields.len() == 10 && is_training(fields[9]);
        assert_eq!(before != after, is_moved, "{before} is {after}");
        if is_moved {
            let mut numbers = [0.0; 7];
            for (number, field) in numbers.iter_mut().zip(&fields[1..8]) {
                *number = field.parse()?;
            }
            assert_eq!(
                binary[fields[9]].bytes,
                numbers.map(f64::to_le_bytes).concat()
            );
            moved += 1;
        }
    }
    assert_eq!(moved, 16, "the training frames");
    Ok(())
}

#[test]
fn where_the_model_has_training_frames_alone_all_are_moved() -> Outcome {
    let folder = tempfile::tempdir()?;
    let (scene, text) = with_text_model(folder.path())?;
    let mut alone = String::new();
    let lines: Vec<&str> = text.lines().skip(1).collect();
    for pair in lines.chunks_exact(2) {
        let (head, name) = pair[0].rsplit_once(' ').expect("fields");
        if is_training(name) {
            let number: u32 = name.trim_end_matches(".png").parse()?;
            alone += &format!("{head} {:05}.png\n\n", number / 2);
        }
    }
    fs::write(scene.join(IMAGES).with_extension("txt"), &alone)?;
    let by = Perturb {
        poses_px: 2.0,
        ..NONE
    };
    let worse = scenes(scene, folder.path()).find("demo", 1, &[], &by)?;
    let after = fs::read_to_string(worse.join(IMAGES).with_extension("txt"))?;
    let moved = alone.lines().zip(after.lines()).filter(|(a, b)| a != b);
    assert_eq!(moved.count(), 16);
    Ok(())
}
