//! The demo scene of this repository, and the shared scenes and files where they are there.

use std::io::Write as _;
use std::path::{Path, PathBuf};

use glam::DVec2;
use io::{LoadOptions, Map, Scene, View, read_ply, write_ply};
use splat_core::camera_center;

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// Those of the shared files and folders that are there. What is missing is told in one line, past the
/// test harness, which would keep it: the test run counts these lines.
fn shared(test: &str, names: &[&str]) -> Vec<PathBuf> {
    let shared = repository().join("../shared");
    let (found, missing): (Vec<&str>, Vec<&str>) = names
        .iter()
        .copied()
        .partition(|name| shared.join(name).exists());
    if !missing.is_empty() {
        let missing = missing.join(", ");
        let line = format!("skipped: {test}: {} lacks {missing}\n", shared.display());
        std::io::stderr().write_all(line.as_bytes()).ok();
    }
    found.into_iter().map(|name| shared.join(name)).collect()
}

fn half(path: &Path) -> Scene {
    let options = LoadOptions {
        downscale: 2,
        ..LoadOptions::default()
    };
    Scene::open_with(path, &options).unwrap()
}

fn value_at(map: &Map, pixel: DVec2) -> Option<f32> {
    let inside = pixel.x >= 0.0 && pixel.y >= 0.0;
    let (x, y) = (pixel.x as usize, pixel.y as usize);
    (inside && x < map.width && y < map.height).then(|| map.values[y * map.width + x])
}

fn median(mut values: Vec<f64>) -> f64 {
    assert!(values.len() > 50, "only {} values", values.len());
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Median relative difference between sparse points and the depth maps they are seen in.
fn points_against_depth(scene: &Scene) -> f64 {
    let mut errors = Vec::new();
    for frame in &scene.frames {
        for point in &scene.points {
            let in_cam = frame.view.cam_from_world.transform_point3(point.position);
            let pixel = frame.view.camera.project(in_cam);
            let depth = frame.depth.as_ref().and_then(|d| value_at(d, pixel));
            if let Some(z) = depth.filter(|&z| z > 0.0 && in_cam.z > 0.0) {
                errors.push((f64::from(z) / in_cam.z - 1.0).abs());
            }
        }
    }
    median(errors)
}

/// Share of visible track points that lie in the mask of their frame.
fn tracks_in_masks(scene: &Scene) -> f64 {
    let tracks = scene.tracks.as_ref().unwrap();
    let (mut inside, mut visible) = (0.0, 0.0);
    for query in &tracks.queries {
        for (at, sample) in query.samples.iter().enumerate() {
            if sample.occlusion < -1.0 && sample.expected_distance < -1.0 {
                let mask = scene.frames[at % tracks.num_frames].mask.as_ref().unwrap();
                let pixel = DVec2::new(f64::from(sample.x), f64::from(sample.y));
                visible += 1.0;
                inside += f64::from(u8::from(value_at(mask, pixel).is_some_and(|m| m > 0.5)));
            }
        }
    }
    assert!(visible > 1000.0, "only {visible} visible track points");
    inside / visible
}

fn check_rendered(scene: &Scene, num_frames: usize, moving: bool) {
    assert_eq!(
        (scene.frames.len(), scene.test.len()),
        (num_frames, num_frames),
        "training frames and test views"
    );
    for (i, (frame, view)) in scene.frames.iter().zip(&scene.test).enumerate() {
        assert_eq!(
            (frame.view.time, view.time),
            (i as f32, i as f32),
            "times of pair {i}"
        );
        let right = frame
            .view
            .cam_from_world
            .transform_point3(camera_center(&view.cam_from_world));
        assert!(
            (right.x - 0.3).abs() < 1e-6 && right.y.abs() < 1e-6,
            "{right}"
        );
        assert_eq!(frame.mask.is_some(), moving, "mask of frame {i}");
    }
    let error = points_against_depth(scene);
    assert!(error < 0.03, "points and depth differ by {error}");
    assert_eq!(scene.tracks.is_some(), moving, "tracks");
    if moving {
        let share = tracks_in_masks(scene);
        // These tracks have outliers and wrong visibility, and the masks are off by a pixel or two.
        assert!(
            share > 0.8,
            "{share} of the visible track points are in the masks"
        );
    }
    let truth = scene.truth().unwrap();
    assert_eq!(
        truth.sharp.map(|s| s.len()),
        Some(num_frames),
        "sharp frames"
    );
    let covisible = truth.covisible.unwrap();
    let seen = covisible.iter().flat_map(|m| &m.values).sum::<f32>();
    let share = seen / (num_frames * covisible[0].values.len()) as f32;
    assert!(share > 0.9 && share < 1.0, "co-visible share {share}");
    assert_eq!(
        truth.masks_test.map(|m| m.len()),
        Some(num_frames),
        "test masks"
    );
}

#[test]
fn demo_opens_and_fits_together() {
    let scene = Scene::open(&repository().join("demo")).unwrap();
    assert_eq!(scene.name, "demo");
    assert_eq!(
        (
            scene.frames[0].view.image.width,
            scene.frames[0].view.image.height
        ),
        (160, 90)
    );
    check_rendered(&scene, 16, true);
    check_rendered(&half(&repository().join("demo")), 16, true);
    for original in shared("demo_opens_and_fits_together", &["scenes/demo"]) {
        assert_eq!(
            Scene::open(&original).unwrap().tracks,
            scene.tracks,
            "packed without loss"
        );
    }
}

#[test]
fn rendered_scenes() {
    let scenes = [
        "scenes/motion-a",
        "scenes/defocus-a",
        "scenes/both-a",
        "scenes/sharp-a",
        "scenes/static-a",
    ];
    for path in shared("rendered_scenes", &scenes) {
        check_rendered(&half(&path), 24, !path.ends_with("static-a"));
    }
}

#[test]
fn toycar() {
    let [path] = &shared("toycar", &["scenes/toycar"])[..] else {
        return;
    };
    let scene = Scene::open(path).unwrap();
    assert_eq!((scene.frames.len(), scene.test.len()), (24, 24));
    let error = points_against_depth(&scene);
    assert!(error < 0.05, "points and depth differ by {error}");
    let share = tracks_in_masks(&scene);
    assert!(
        share > 0.99,
        "{share} of the visible track points are in the masks"
    );
    let truth = scene.truth().unwrap();
    assert!(truth.sharp.is_none() && truth.covisible.is_none() && truth.masks_test.is_some());
}

/// Depth of one view, moved into another, against that one's depth: median relative difference.
fn depth_between(scene: &Scene, from: usize, to: usize) -> f64 {
    let (a, b) = (&scene.frames[from], &scene.frames[to]);
    let (view, other): (&View, &View) = (&a.view, &b.view);
    let (depth, target) = (a.depth.as_ref().unwrap(), b.depth.as_ref().unwrap());
    let b_from_a = other.cam_from_world * view.cam_from_world.inverse();
    let mut errors = Vec::new();
    for (at, &z) in depth.values.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let pixel = DVec2::new(
            (at % depth.width) as f64 + 0.5,
            (at / depth.width) as f64 + 0.5,
        );
        let in_b = b_from_a.transform_point3(view.camera.unproject(pixel, f64::from(z)));
        if let Some(w) = value_at(target, other.camera.project(in_b)).filter(|&w| w > 0.0) {
            errors.push((f64::from(w) / in_b.z - 1.0).abs());
        }
    }
    median(errors)
}

#[test]
fn kitchen() {
    let [path] = &shared("kitchen", &["scenes/kitchen"])[..] else {
        return;
    };
    for scene in [Scene::open(path).unwrap(), half(path)] {
        assert_eq!(scene.layout, "nerfstudio", "transforms.json wins");
        assert_eq!((scene.frames.len(), scene.test.len()), (36, 8));
        assert!(scene.tracks.is_none() && scene.frames.iter().all(|f| f.mask.is_none()));
        let valid = |m: &Map| m.values.iter().filter(|&&z| z > 0.0).count() as f64;
        let depth = scene.frames[0].depth.as_ref().unwrap();
        let share = valid(depth) / depth.values.len() as f64;
        assert!(share > 0.4 && share < 0.95, "holes stay holes: {share}");
        // Ten frames apart the camera has moved; wrong axes would not fit.
        let error = depth_between(&scene, 0, 10);
        assert!(
            error < 0.02,
            "depth moved from view to view differs by {error}"
        );
    }
}

/// Written again, a file of another program is the same.
#[test]
fn a_file_of_another_program() {
    let file = "reference/splat_ply/test-splat.3-points-from-train.ply";
    let [path] = &shared("a_file_of_another_program", &[file])[..] else {
        return;
    };
    let read = read_ply(path).unwrap();
    assert_eq!((read.len(), read.sh_degree), (3, 3));
    // The .splat file beside it has the same points: position, scale (f32), colour and opacity,
    // rotation (u8), 32 bytes each.
    let splat = std::fs::read(path.with_extension("splat")).unwrap();
    for i in 0..3 {
        let row = &splat[32 * i..32 * (i + 1)];
        let float = |at: usize| f32::from_le_bytes(row[4 * at..4 * at + 4].try_into().unwrap());
        for axis in 0..3 {
            assert!((read.means[i][axis] - float(axis)).abs() < 1e-5);
            assert!((read.log_scales[i][axis].exp() / float(3 + axis) - 1.0).abs() < 1e-4);
            let color = 0.5 + 0.282_094_8 * read.sh[i * 48 + axis];
            assert!((color.clamp(0.0, 1.0) * 255.0 - f32::from(row[24 + axis])).abs() <= 1.0);
        }
        let opacity = 1.0 / (1.0 + (-read.opacity_logits[i]).exp());
        assert!((opacity * 255.0 - f32::from(row[27])).abs() <= 1.0);
        let quat = read.quats[i];
        let norm = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
        for (q, &byte) in quat.iter().zip(&row[28..]) {
            assert!((q / norm * 128.0 + 128.0 - f32::from(byte)).abs() <= 1.5);
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let again = folder.path().join("again.ply");
    write_ply(&again, &read).unwrap();
    // Byte for byte the same but for the normals, which nobody reads: that program writes (0, 0, 1).
    let (ours, mut theirs) = (std::fs::read(&again).unwrap(), std::fs::read(path).unwrap());
    let rows = theirs.len() - 3 * 62 * 4;
    for i in 0..3 {
        let normal = rows + (i * 62 + 3) * 4;
        theirs[normal..normal + 12].fill(0);
    }
    assert!(ours == theirs, "our writer gives another file");
}
