//! Frames that are taken anew, and what their truth says, against each other.

use crate::copies::{NONE, Outcome, array, differing, files, scenes, whole_copy};
use glam::{DAffine3, DMat3, DVec2, DVec3};
use image::RgbImage;
use limpid_lab::{Perturb, Scenes};
use npyz::WriterBuilder as _;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

const W: usize = 160;
const H: usize = 90;
const FOCAL: f64 = 160.0 * 213.333 / 256.0;
/// Of the upper part and the lower, which is larger.
const DEPTHS: [f32; 2] = [10.0, 4.0];

fn depth_at(y: usize) -> f64 {
    f64::from(DEPTHS[usize::from(y >= 40)])
}

/// The repository's scene with a true depth that we make up.
fn scene(folder: &Path) -> Result<(Scenes, PathBuf), Box<dyn std::error::Error>> {
    let scene = whole_copy(folder)?;
    let mut bytes: Vec<u8> = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype();
    let options = options.shape(&[H as u64, W as u64]);
    let mut writer = options.writer(&mut bytes).begin_nd()?;
    writer.extend((0..W * H).map(|i| depth_at(i / W) as f32))?;
    writer.finish()?;
    let depth = scene.join("truth/depth");
    fs::create_dir_all(&depth)?;
    for frame in 0..16 {
        fs::write(depth.join(format!("{frame:05}.npy")), &bytes)?;
    }
    Ok((scenes(scene.clone(), &folder.join("links")), scene))
}

/// The cameras from which a frame's light came.
fn cameras(copy: &Path, frame: usize) -> Result<Vec<DAffine3>, Box<dyn std::error::Error>> {
    let rows = array(&fs::read(
        copy.join(format!("truth/exposure/{frame:05}.npy")),
    )?)?;
    let row = |r: &[f32]| DVec3::new(r[0].into(), r[1].into(), r[2].into());
    let cameras = rows.chunks_exact(12).map(|r| DAffine3 {
        matrix3: DMat3::from_cols(row(r), row(&r[4..]), row(&r[8..])).transpose(),
        translation: DVec3::new(r[3].into(), r[7].into(), r[11].into()),
    });
    Ok(cameras.collect())
}

/// From where in the middle's picture each camera's light at a place comes, where what is seen is so far away.
fn places(cameras: &[DAffine3], at: DVec2, depth: f64) -> Vec<DVec2> {
    let middle = 0.5 * DVec2::new(W as f64, H as f64);
    let point = ((at - middle) / FOCAL).extend(1.0) * depth;
    let project = |camera: &DAffine3| {
        let seen = camera.inverse().transform_point3(point);
        FOCAL * seen.truncate() / seen.z + middle
    };
    cameras.iter().map(project).collect()
}

fn by(shake_px: f64, disc_px: f64) -> Perturb {
    Perturb {
        shake_px,
        disc_px,
        ..NONE
    }
}

#[test]
fn frames_and_their_truth_change_and_nothing_else() -> Outcome {
    let (one, two) = (tempfile::tempdir()?, tempfile::tempdir()?);
    let ((here, scene), (there, _)) = (scene(one.path())?, scene(two.path())?);
    let before = files(&scene)?;
    let copy = here.find("demo", 1, &[], &by(6.0, 3.0))?;
    let changed: BTreeSet<PathBuf> = (0..16)
        .flat_map(|k| {
            let frame = PathBuf::from(format!("images/{k:05}.png"));
            [frame, format!("truth/exposure/{k:05}.npy").into()]
        })
        .collect();
    assert_eq!(differing(&scene, &copy)?, changed);
    let again = there.find("demo", 1, &[], &by(6.0, 3.0))?;
    assert_eq!(files(&copy)?, files(&again)?, "the same for a seed");
    let other = here.find("demo", 2, &[], &by(6.0, 3.0))?;
    assert_eq!(differing(&copy, &other)?, changed, "another draw");
    assert_eq!(files(&scene)?, before, "the scene is as it was");
    Ok(())
}

#[test]
fn frames_are_what_the_cameras_of_their_truth_collect_of_the_sharp_ones() -> Outcome {
    let folder = tempfile::tempdir()?;
    let (scenes, scene) = scene(folder.path())?;
    let copy = scenes.find("demo", 1, &[], &by(8.0, 4.0))?;
    let open = |path: PathBuf| image::open(path).map(image::DynamicImage::into_rgb8);
    let light = |v: u8| match f64::from(v) / 255.0 {
        v if v <= 0.04045 => v / 12.92,
        v => ((v + 0.055) / 1.055).powf(2.4),
    };
    for frame in [0, 7] {
        let name = format!("{frame:05}.png");
        let sharp: RgbImage = open(scene.join("truth/images_sharp").join(&name))?;
        let blurry = open(copy.join("images").join(&name))?;
        let cameras = cameras(&copy, frame)?;
        let (mut left, mut blur) = (0.0, 0.0);
        for (x, y) in (12..W - 12).step_by(3).flat_map(|x| [(x, 20), (x, 70)]) {
            let at = DVec2::new(x as f64, y as f64) + 0.5;
            let mut sum = 0.0;
            for place in places(&cameras, at, depth_at(y)) {
                // Bilinear, as weights of the four pixels around the place.
                let (corner, part) = ((place - 0.5).floor(), (place - 0.5).fract_gl());
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let weight = |d: u32, part: f64| if d == 1 { part } else { 1.0 - part };
                    let pixel = sharp.get_pixel(corner.x as u32 + dx, corner.y as u32 + dy);
                    sum += weight(dx, part.x) * weight(dy, part.y) * light(pixel.0[1]);
                }
            }
            let made = sum / cameras.len() as f64;
            let found = light(blurry.get_pixel(x as u32, y as u32).0[1]);
            left = f64::max(left, (made - found).abs());
            blur += (light(sharp.get_pixel(x as u32, y as u32).0[1]) - found).powi(2);
        }
        // Half a step of 8 bit, where the curve is steepest.
        assert!(left < 0.6 * 2.3 / 255.0, "frame {frame}: {left}");
        assert!(blur > 1e-3, "frame {frame}: {blur}");
    }
    Ok(())
}

#[test]
fn paths_are_as_long_and_discs_as_wide_as_was_said() -> Outcome {
    let folder = tempfile::tempdir()?;
    let (scenes, _) = scene(folder.path())?;
    let (shaken, focused) = (
        scenes.find("demo", 1, &[], &by(8.0, 0.0))?,
        scenes.find("demo", 1, &[], &by(0.0, 5.0))?,
    );
    let at = DVec2::new(70.5, 40.5);
    let (mut lengths, mut discs) = (Vec::new(), [Vec::new(), Vec::new()]);
    for frame in 0..16 {
        // Most of the pixels are as near as the lower part, and so is the median.
        let path = places(&cameras(&shaken, frame)?, at, f64::from(DEPTHS[1]));
        let length: f64 = path.windows(2).map(|w| w[0].distance(w[1])).sum();
        lengths.push(length);
        let middle = 0.5 * (path[63] + path[64]);
        assert!(middle.distance(at) < 0.01, "the middle is the frame's pose");

        let cameras = cameras(&focused, frame)?;
        for (depth, discs) in DEPTHS.iter().zip(&mut discs) {
            let disc = places(&cameras, at, f64::from(*depth));
            let radii = disc.iter().map(|place| place.distance(at));
            discs.push(2.0 * radii.fold(0.0, f64::max));
        }
    }
    assert!(lengths.iter().all(|px| *px < 1.5 * 8.0), "{lengths:?}");
    let longest = lengths.iter().copied().fold(0.0, f64::max);
    let calmest = lengths.iter().copied().fold(f64::MAX, f64::min);
    assert!(longest > 4.0 && calmest < 0.5 * longest, "{lengths:?}");
    // What one depth's disc lacks to 5 px, the other's has: focus lies between them.
    for (far, near) in discs[0].iter().zip(&discs[1]) {
        assert!((far + near - 5.0).abs() < 0.15, "{far} {near}");
    }
    assert!(discs[0].iter().any(|d| *d > 3.0) && discs[1].iter().any(|d| *d > 3.0));
    Ok(())
}
