//! Copies of the repository's scene with worse inputs, measured without the code that makes them.

mod copies;
mod poses;
mod retake;

use copies::{
    DEPTH, IMAGES, NONE, Outcome, TRACKS, archive, array, copy, demo, differing, files, scenes,
    whole_copy,
};
use limpid_lab::Perturb;
use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

#[test]
fn only_the_named_part_changes_and_by_the_same_on_every_machine() -> Outcome {
    let (here, there) = (tempfile::tempdir()?, tempfile::tempdir()?);
    let before = files(&demo())?;
    for (perturb, part) in [
        (Perturb { depth: 0.2, ..NONE }, DEPTH),
        (
            Perturb {
                tracks_px: 9.0,
                ..NONE
            },
            TRACKS,
        ),
        (
            Perturb {
                mask_squares: 5,
                ..NONE
            },
            "masks",
        ),
        (
            Perturb {
                poses_px: 1.0,
                ..NONE
            },
            IMAGES,
        ),
    ] {
        let one = copy(perturb, 1, here.path())?;
        let named: BTreeSet<PathBuf> = before
            .keys()
            .filter(|f| f.starts_with(part))
            .cloned()
            .collect();
        assert_eq!(differing(&demo(), &one)?, named, "{perturb:?}");
        assert_eq!(copy(perturb, 1, here.path())?, one, "it is there");
        let two = copy(perturb, 1, there.path())?;
        assert_ne!(one, two, "in another folder");
        assert_eq!(files(&one)?, files(&two)?, "{perturb:?}");
        let other = copy(perturb, 2, here.path())?;
        assert_eq!(
            differing(&one, &other)?,
            named,
            "another seed, another draw"
        );
    }
    let all = Perturb {
        depth: 0.2,
        tracks_px: 9.0,
        mask_squares: 5,
        poses_px: 1.0,
        ..NONE
    };
    let all = files(&copy(all, 1, here.path())?)?;
    let single = files(&copy(
        Perturb {
            tracks_px: 9.0,
            ..NONE
        },
        1,
        here.path(),
    )?)?;
    let tracks = Path::new(TRACKS);
    assert_eq!(all[tracks], single[tracks], "whatever else is perturbed");
    assert_eq!(files(&demo())?, before, "the scene is as it was");
    Ok(())
}

#[test]
fn nothing_perturbed_is_the_scene_itself() -> Outcome {
    let folder = tempfile::tempdir()?;
    assert_eq!(copy(NONE, 1, folder.path())?, fs::canonicalize(demo())?);
    Ok(())
}

/// The scale and the shift between two frames' depths by least squares, the shift in the first one's medians, and what they leave.
fn line(before: &[f32], after: &[f32]) -> (f64, f64, f64) {
    let depths = |d: &[f32]| -> Vec<f64> { d.iter().map(|d| 1.0 / f64::from(*d)).collect() };
    let (x, y) = (depths(before), depths(after));
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mx, my) = (mean(&x), mean(&y));
    let pairs = || x.iter().zip(&y);
    let slope = pairs().map(|(x, y)| (x - mx) * (y - my)).sum::<f64>()
        / x.iter().map(|x| (x - mx).powi(2)).sum::<f64>();
    let shift = my - slope * mx;
    let most = pairs().map(|(x, y)| (slope * x + shift - y).abs());
    let most = most.fold(0.0, f64::max);
    let mut sorted = x.clone();
    sorted.sort_by(f64::total_cmp);
    (slope, shift / sorted[x.len() / 2], most)
}

#[test]
fn a_frames_depth_is_scaled_and_shifted_as_far_as_was_said() -> Outcome {
    let folder = tempfile::tempdir()?;
    let by = |depth| copy(Perturb { depth, ..NONE }, 1, folder.path());
    let copies = [by(0.1)?, by(0.2)?];
    let (mut scales, mut shifts) = (Vec::new(), Vec::new());
    for entry in fs::read_dir(demo().join(DEPTH))? {
        let file = Path::new(DEPTH).join(entry?.file_name());
        let before = array(&fs::read(demo().join(&file))?)?;
        let [small, large] = [&copies[0], &copies[1]].map(|copy| {
            let after = array(&fs::read(copy.join(&file)).expect("a frame")).expect("an array");
            line(&before, &after)
        });
        for ((scale, shift, left), by) in [(small, 0.1), (large, 0.2)] {
            assert!(left < 1e-4, "{left} is left of depths of about 7");
            assert!((scale - 1.0).abs() <= by, "{scale}");
            assert!(shift.abs() <= 0.5 * by + 1e-5, "{shift}");
        }
        assert!(
            (large.0 - 1.0 - 2.0 * (small.0 - 1.0)).abs() < 1e-4,
            "a step further"
        );
        assert!((large.1 - 2.0 * small.1).abs() < 1e-4, "a step further");
        scales.push(large.0 - 1.0);
        shifts.push(large.1);
    }
    for (drawn, most) in [(scales, 0.2), (shifts, 0.1)] {
        // Sixteen numbers, evenly drawn: their root mean square is most / sqrt(3), give or take a ninth.
        let rms = (drawn.iter().map(|x| x * x).sum::<f64>() / drawn.len() as f64).sqrt();
        let times = rms / (most / 3.0_f64.sqrt());
        assert!((0.6..1.4).contains(&times), "{drawn:?}");
        assert!(
            drawn.iter().any(|x| *x > 0.0) && drawn.iter().any(|x| *x < 0.0),
            "{drawn:?}"
        );
    }
    Ok(())
}

#[test]
fn missing_depth_stays_missing_and_none_comes_near_the_camera() -> Outcome {
    let folder = tempfile::tempdir()?;
    let scene = whole_copy(folder.path())?;
    let file = scene.join(DEPTH).join("00000.npy");
    let bytes = fs::read(&file)?;
    // The first pixel is missing, the second is right before the camera.
    let first = bytes.len() - 4 * array(&bytes)?.len();
    let mut changed = bytes.clone();
    changed[first..first + 4].copy_from_slice(&0.0_f32.to_le_bytes());
    changed[first + 4..first + 8].copy_from_slice(&1e3_f32.to_le_bytes());
    fs::write(&file, changed)?;
    let scenes = scenes(scene, folder.path());
    for seed in 0..8 {
        let worse = scenes.find("demo", seed, &[], &Perturb { depth: 0.9, ..NONE })?;
        let after = array(&fs::read(worse.join(DEPTH).join("00000.npy"))?)?;
        assert_eq!(after[0], 0.0, "seed {seed}");
        // At least half of a tenth of its depth.
        let near = after[1];
        assert!(
            near > 0.0 && near <= 20.0 * 1e3 * 1.001,
            "seed {seed}: {near}"
        );
    }
    Ok(())
}

#[test]
fn tracks_are_jittered_evenly_up_to_so_many_px() -> Outcome {
    let folder = tempfile::tempdir()?;
    let px = 9.0;
    let worse = copy(
        Perturb {
            tracks_px: px,
            ..NONE
        },
        1,
        folder.path(),
    )?;
    let (before, after) = (
        archive(&demo().join(TRACKS))?,
        archive(&worse.join(TRACKS))?,
    );
    let names = |a: &BTreeMap<String, Vec<f32>>| a.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&before), names(&after));
    let mut moved = [Vec::new(), Vec::new()];
    for (name, before) in &before {
        for (a, b) in before.chunks_exact(4).zip(after[name].chunks_exact(4)) {
            assert_eq!(a[2..], b[2..], "visibility and confidence");
            for k in 0..2 {
                moved[k].push(f64::from(b[k]) - f64::from(a[k]));
            }
        }
    }
    let mean = |v: &[f64], f: fn(f64) -> f64| v.iter().map(|x| f(*x)).sum::<f64>() / v.len() as f64;
    for moved in &moved {
        assert!(moved.len() > 10_000, "{}", moved.len());
        assert!(moved.iter().all(|x| x.abs() <= px + 1e-4), "no further");
        assert!(mean(moved, |x| x).abs() < 0.02 * px, "to no side");
        let rms = mean(moved, |x| x * x).sqrt();
        assert!((rms / (px / 3.0_f64.sqrt()) - 1.0).abs() < 0.02, "{rms}");
    }
    let both: Vec<f64> = moved[0].iter().zip(&moved[1]).map(|(x, y)| x * y).collect();
    assert!(
        mean(&both, |x| x).abs() < 0.02 * px * px,
        "x and y know nothing of each other"
    );
    Ok(())
}

#[test]
fn tracks_in_a_folder_are_jittered_as_those_in_an_archive() -> Outcome {
    let folder = tempfile::tempdir()?;
    let scene = whole_copy(folder.path())?;
    let mut zip = zip::ZipArchive::new(Cursor::new(fs::read(scene.join(TRACKS))?))?;
    let tracks = scene.join("flow3d_preprocessed/2d_tracks");
    zip.extract(&tracks)?;
    fs::remove_file(scene.join(TRACKS))?;
    let by = Perturb {
        tracks_px: 9.0,
        ..NONE
    };
    let worse = scenes(scene, folder.path()).find("demo", 1, &[], &by)?;
    let packed = archive(&copy(by, 1, folder.path().join("packed").as_path())?.join(TRACKS))?;
    assert!(packed.len() > 100, "one a pair of frames");
    for (name, packed) in packed {
        let path = worse.join("flow3d_preprocessed/2d_tracks").join(&name);
        assert_eq!(array(&fs::read(path)?)?, packed, "{name}");
    }
    Ok(())
}

/// A mask's width, and which of its pixels differ from another's, of which each must be the opposite.
fn inverted(before: &Path, after: &Path) -> Result<(usize, Vec<bool>), Box<dyn Error>> {
    let open = |path| image::open(path).map(image::DynamicImage::into_luma8);
    let (before, after) = (open(before)?, open(after)?);
    assert_eq!(before.dimensions(), after.dimensions(), "its size");
    let pixels = before.pixels().zip(after.pixels());
    let differ = pixels.map(|(a, b)| {
        assert!(a == b || a.0[0] == 255 - b.0[0], "{a:?} became {b:?}");
        a != b
    });
    Ok((before.width() as usize, differ.collect()))
}

#[test]
fn squares_of_masks_become_their_opposite() -> Outcome {
    let folder = tempfile::tempdir()?;
    let by = |mask_squares| {
        copy(
            Perturb {
                mask_squares,
                ..NONE
            },
            1,
            folder.path(),
        )
    };
    let (one, five) = (by(1)?, by(5)?);
    let mut corners = BTreeSet::new();
    for entry in fs::read_dir(demo().join("masks"))? {
        let mask = Path::new("masks").join(entry?.file_name());
        let (width, changed) = inverted(&demo().join(&mask), &one.join(&mask))?;
        let side = (width as f64 / 512.0 * 25.0).round() as usize;
        let places: Vec<usize> = (0..changed.len()).filter(|i| changed[*i]).collect();
        let corner = places[0];
        let square: Vec<usize> = (0..side * side)
            .map(|i| corner + i / side * width + i % side)
            .collect();
        assert_eq!(places, square, "one square of {side} px");
        corners.insert(corner);

        let (_, changed) = inverted(&demo().join(&mask), &five.join(&mask))?;
        let count = changed.iter().filter(|c| **c).count();
        assert!((side * side..=5 * side * side).contains(&count), "{count}");
        assert!(
            places.iter().all(|i| changed[*i]),
            "the first is one of the five"
        );
        // Every pixel that changed lies in a whole square of such.
        let height = changed.len() / width;
        let mut covered = vec![false; changed.len()];
        for top in 0..=height - side {
            for left in 0..=width - side {
                let square =
                    || (0..side * side).map(|i| (top + i / side) * width + left + i % side);
                if square().all(|i| changed[i]) {
                    square().for_each(|i| covered[i] = true);
                }
            }
        }
        assert_eq!(covered, changed, "nothing but squares");
    }
    assert!(corners.len() > 8, "somewhere else in each frame");
    Ok(())
}

#[test]
fn what_is_half_made_is_made_anew() -> Outcome {
    let folder = tempfile::tempdir()?;
    let by = Perturb { depth: 0.2, ..NONE };
    let scene = whole_copy(folder.path())?;
    let last = scene.join(DEPTH).join("00015.npy");
    let good = fs::read(&last)?;
    fs::write(&last, &good[..good.len() / 2])?;
    let scenes = scenes(scene, &folder.path().join("links"));
    let find = || scenes.find("demo", 1, &[], &by);
    let said = find()
        .expect_err("an array that ends too early")
        .to_string();
    assert!(said.contains("00015.npy"), "{said}");
    fs::write(&last, good)?;
    let whole = find()?;
    let other = copy(by, 1, folder.path().join("other").as_path())?;
    assert_eq!(files(&whole)?, files(&other)?);
    Ok(())
}

#[test]
fn a_part_that_a_scene_lacks_is_named() -> Outcome {
    let folder = tempfile::tempdir()?;
    for (perturb, part) in [
        (Perturb { depth: 0.2, ..NONE }, "aligned_depth"),
        (
            Perturb {
                tracks_px: 9.0,
                ..NONE
            },
            "2d_tracks",
        ),
        (
            Perturb {
                mask_squares: 5,
                ..NONE
            },
            "masks",
        ),
        (
            Perturb {
                poses_px: 1.0,
                ..NONE
            },
            "colmap",
        ),
        (
            Perturb {
                shake_px: 1.0,
                ..NONE
            },
            "truth",
        ),
    ] {
        let scene = folder.path().join(part);
        fs::create_dir_all(&scene)?;
        let links = folder.path().join("links");
        let failed = scenes(scene, &links).find("demo", 1, &[], &perturb);
        let said = failed.expect_err("an empty scene").to_string();
        assert!(said.contains(part) && said.contains("except"), "{said}");
    }
    Ok(())
}
