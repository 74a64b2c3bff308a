//! Scenes taken through lenses with distortion, against a forward model of each lens that is written
//! here from COLMAP's and OpenCV's formulas and inverted by fixed points, in f64.

use std::f64::consts::TAU;
use std::path::Path;

use glam::DVec3;
use io::{IoError, LoadOptions, Scene};
use serde_json::json;

use crate::make::{self, colmap_binary, names, npy, pose};

const SIZE: (usize, usize) = (96, 72);
const COUNT: usize = 2;

/// A COLMAP camera: its number, its parameters, and where its lens puts a point of the plane z = 1.
#[derive(Clone, Copy)]
struct Lens {
    model: (i32, &'static [f64]),
    distort: fn(&[f64], f64, f64) -> (f64, f64),
}

fn opencv(k: &[f64], u: f64, v: f64) -> (f64, f64) {
    let (u2, uv, v2) = (u * u, u * v, v * v);
    let radial = k[0] * (u2 + v2) + k[1] * (u2 + v2).powi(2);
    (
        u + u * radial + 2.0 * k[2] * uv + k[3] * (3.0 * u2 + v2),
        v + v * radial + 2.0 * k[3] * uv + k[2] * (u2 + 3.0 * v2),
    )
}

fn fisheye(k: &[f64], u: f64, v: f64) -> (f64, f64) {
    let r = u.hypot(v).max(1e-12);
    let t = r.atan();
    let bent = t + k[0] * t.powi(3) + k[1] * t.powi(5) + k[2] * t.powi(7) + k[3] * t.powi(9);
    (u * bent / r, v * bent / r)
}

const LENSES: [Lens; 5] = [
    Lens {
        model: (2, &[80.0, 47.0, 37.0, -0.25]),
        distort: |k, u, v| opencv(&[k[0], 0.0, 0.0, 0.0], u, v),
    },
    Lens {
        model: (3, &[80.0, 48.0, 36.0, 0.12, 0.05]),
        distort: |k, u, v| opencv(&[k[0], k[1], 0.0, 0.0], u, v),
    },
    Lens {
        model: (4, &[80.0, 82.0, 48.5, 35.0, -0.2, 0.06, 2e-3, -3e-3]),
        distort: opencv,
    },
    Lens {
        model: (5, &[60.0, 61.0, 48.0, 36.0, 0.03, -0.01, 0.004, -0.001]),
        distort: fisheye,
    },
    Lens {
        model: (7, &[80.0, 80.0, 48.0, 36.0, 0.8]),
        distort: |k, u, v| {
            let r = u.hypot(v).max(1e-12);
            let bent = (2.0 * r * (k[0] / 2.0).tan()).atan() / k[0];
            (u * bent / r, v * bent / r)
        },
    },
];

impl Lens {
    /// Focal lengths, centre and coefficients.
    fn parts(&self) -> ([f64; 2], [f64; 2], &[f64]) {
        let p = self.model.1;
        if [4, 5, 7].contains(&self.model.0) {
            ([p[0], p[1]], [p[2], p[3]], &p[4..])
        } else {
            ([p[0], p[0]], [p[1], p[2]], &p[3..])
        }
    }

    fn pixel(&self, u: f64, v: f64) -> (f64, f64) {
        let (f, c, k) = self.parts();
        let (u, v) = (self.distort)(k, u, v);
        (f[0] * u + c[0], f[1] * v + c[1])
    }

    /// The ray (u, v, 1) of a pixel.
    fn ray(&self, x: f64, y: f64) -> (f64, f64) {
        let (f, c, _) = self.parts();
        let (mut u, mut v) = ((x - c[0]) / f[0], (y - c[1]) / f[1]);
        for _ in 0..500 {
            let (px, py) = self.pixel(u, v);
            u += 0.7 * (x - px) / f[0];
            v += 0.7 * (y - py) / f[1];
        }
        let (px, py) = self.pixel(u, v);
        assert!((px - x).hypot(py - y) < 1e-9, "{:?} at {x} {y}", self.model);
        (u, v)
    }
}

/// What is seen along a ray: waves of a tenth of the picture's width.
fn color(u: f64, v: f64) -> [f64; 3] {
    let wave = |t: f64| 0.5 + 0.4 * (TAU * t).sin();
    [wave(6.0 * u), wave(5.0 * v + 0.2), wave(4.0 * (u + v))]
}

/// z-depth of a slanted plane along a ray.
fn depth(u: f64, v: f64) -> f64 {
    2.0 / (1.0 + 0.2 * u - 0.4 * v)
}

/// Moves to the right of a slanted line.
fn moves(u: f64, v: f64) -> bool {
    u + 0.3 * v > 0.05
}

/// 3D points that are tracked, in the camera's own axes: the same ones in each frame.
const TRACKED: [(f64, f64); 4] = [(0.0, 0.0), (0.2, 0.1), (-0.3, 0.25), (0.35, -0.3)];

/// A scene in Shape-of-Motion's layout, taken by this lens. Depth and masks are `reduced` in size.
fn take(root: &Path, lens: &Lens, reduced: usize) {
    let pre = root.join("flow3d_preprocessed");
    let rays = |(w, h): (usize, usize), scale: f64| -> Vec<(f64, f64)> {
        let at = move |i: usize| ((i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
        let place = (0..w * h).map(at);
        place.map(|(x, y)| lens.ray(x * scale, y * scale)).collect()
    };
    let full = rays(SIZE, 1.0);
    let small_size = (SIZE.0 / reduced, SIZE.1 / reduced);
    let small = rays(small_size, reduced as f64);
    for name in names(COUNT) {
        for folder in ["images", "truth/images_sharp"] {
            let path = root.join(folder).join(&name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            image::RgbImage::from_fn(SIZE.0 as u32, SIZE.1 as u32, |x, y| {
                let (u, v) = full[y as usize * SIZE.0 + x as usize];
                image::Rgb(color(u, v).map(|c| (255.0 * c).round() as u8))
            })
            .save(&path)
            .unwrap();
        }
        make::picture(&root.join("masks").join(&name), small_size, |x, y| {
            let (u, v) = small[y * small_size.0 + x];
            255 * u8::from(moves(u, v))
        });
        let disparity = small.iter().map(|&(u, v)| (1.0 / depth(u, v)) as f32);
        let disparity: Vec<f32> = disparity.collect();
        let stem = name.trim_end_matches(".png");
        let array = npy(&[small_size.1, small_size.0], &disparity);
        let folder = pre.join("aligned_depth_anything_colmap");
        make::write(&folder.join(format!("{stem}.npy")), array);
        for target in names(COUNT) {
            let target = target.trim_end_matches(".png");
            let rows: Vec<f32> = TRACKED
                .iter()
                .flat_map(|&(u, v)| {
                    let (x, y) = lens.pixel(u, v);
                    [x as f32 - 0.5, y as f32 - 0.5, -5.0, -5.0]
                })
                .collect();
            let file = pre.join(format!("2d_tracks/{stem}_{target}.npy"));
            make::write(&file, npy(&[TRACKED.len(), 4], &rows));
        }
    }
    sized_model(&pre.join("colmap/sparse"), lens);
}

fn sized_model(folder: &Path, lens: &Lens) {
    colmap_binary(folder, &names(COUNT), lens.model);
    let cameras = folder.join("cameras.bin");
    let mut bytes = std::fs::read(&cameras).unwrap();
    bytes[16..24].copy_from_slice(&(SIZE.0 as u64).to_le_bytes());
    bytes[24..32].copy_from_slice(&(SIZE.1 as u64).to_le_bytes());
    std::fs::write(&cameras, bytes).unwrap();
}

/// The rays of a view's pixels by its pinhole.
fn pinhole_rays(camera: &splat_core::Camera) -> Vec<(f64, f64)> {
    let ray = |i: usize| {
        let (x, y) = ((i % camera.width) as f64, (i / camera.width) as f64);
        (
            (x + 0.5 - camera.cx) / camera.fx,
            (y + 0.5 - camera.cy) / camera.fy,
        )
    };
    (0..camera.num_pixels()).map(ray).collect()
}

#[test]
fn undistorted_scenes_are_those_of_a_pinhole() {
    for lens in &LENSES {
        let folder = tempfile::tempdir().unwrap();
        take(folder.path(), lens, 1);
        let scene = Scene::open(folder.path()).unwrap();
        let who = lens.model;
        let frame = &scene.frames[1];
        let camera = &frame.view.camera;
        assert_eq!((camera.width, camera.height), SIZE, "{who:?}");
        let (_, center, _) = lens.parts();
        assert_eq!([camera.cx, camera.cy], center, "{who:?}");

        let rays = pinhole_rays(camera);
        let inside = |&(u, v): &(f64, f64)| {
            let (x, y) = lens.pixel(u, v);
            (0.0..=SIZE.0 as f64).contains(&x) && (0.0..=SIZE.1 as f64).contains(&y)
        };
        assert!(rays.iter().all(inside), "{who:?}: pixels from nowhere");

        let pixels = frame.view.image.pixels.chunks_exact(3);
        let difference = |((u, v), pixel): (&(f64, f64), &[f32])| {
            let want = color(*u, *v);
            let off = pixel
                .iter()
                .zip(want)
                .map(|(a, b)| (f64::from(*a) - b).abs());
            off.fold(0.0, f64::max)
        };
        let differences: Vec<f64> = rays.iter().zip(pixels).map(difference).collect();
        let mean = differences.iter().sum::<f64>() / differences.len() as f64;
        let worst = differences.iter().copied().fold(0.0, f64::max);
        // Quantised to 1/255; at the border the cubic has pixels on one side alone.
        assert!(
            mean < 1.0 / 255.0 && worst < 0.04,
            "{who:?}: {mean} {worst}"
        );
        let truth = scene.truth().unwrap().sharp.unwrap();
        assert_eq!(
            truth[1], frame.view.image,
            "{who:?}: truth goes the same way"
        );

        let z = &frame.depth.as_ref().unwrap().values;
        for (&(u, v), &z) in rays.iter().zip(z) {
            let want = depth(u, v);
            assert!(
                (f64::from(z) / want - 1.0).abs() < 5e-3,
                "{who:?} {u} {v}: {z} {want}"
            );
        }
        let mask = &frame.mask.as_ref().unwrap().values;
        let wrong = rays
            .iter()
            .zip(mask)
            .filter(|((u, v), m)| moves(*u, *v) != (**m > 0.5));
        // The edge crosses the picture once and may be off by the half of a pixel.
        assert!(wrong.count() < SIZE.1, "{who:?}: masks");

        let tracks = scene.tracks.as_ref().unwrap();
        for (sample, (u, v)) in tracks.queries[0]
            .samples
            .chunks(COUNT)
            .zip(TRACKED)
            .flat_map(|(of_point, at)| of_point.iter().map(move |s| (s, at)))
        {
            let want = camera.project(DVec3::new(u, v, 1.0));
            let off = (f64::from(sample.x) - want.x).hypot(f64::from(sample.y) - want.y);
            assert!(
                off < 1e-3 && sample.occlusion == -5.0,
                "{who:?}: track off by {off}"
            );
        }
        let note = scene.notes.iter().find(|n| n.contains("lens distortion"));
        let note = note.unwrap_or_else(|| panic!("{who:?}: {:?}", scene.notes));
        assert!(
            note.contains("2 of 2 pictures") && note.contains("px"),
            "{note}"
        );
    }
}

#[test]
fn smaller_pictures_of_a_lens_are_undistorted_first() {
    let folder = tempfile::tempdir().unwrap();
    take(folder.path(), &LENSES[2], 1);
    let options = LoadOptions {
        downscale: 2,
        ..LoadOptions::default()
    };
    let full = Scene::open(folder.path()).unwrap();
    let half = Scene::open_with(folder.path(), &options).unwrap();
    let (full, half) = (&full.frames[0].view, &half.frames[0].view);
    let point = DVec3::new(0.2, -0.1, 1.5);
    let difference = full.camera.project(point) - 2.0 * half.camera.project(point);
    assert!(difference.length() < 1e-9);
    assert_eq!(io::shrink_image(full.image.clone(), 2), half.image);
}

#[test]
fn depth_and_masks_of_another_size_follow_their_picture_and_it_is_said() {
    let folder = tempfile::tempdir().unwrap();
    take(folder.path(), &LENSES[2], 2);
    let scene = Scene::open(folder.path()).unwrap();
    let frame = &scene.frames[0];
    let rays = pinhole_rays(&frame.view.camera);
    let (depths, masks) = (frame.depth.as_ref().unwrap(), frame.mask.as_ref().unwrap());
    assert_eq!((depths.width, depths.height), SIZE);
    assert_eq!((masks.width, masks.height), SIZE);
    for (&(u, v), &z) in rays.iter().zip(&depths.values) {
        let want = depth(u, v);
        assert!(
            (f64::from(z) / want - 1.0).abs() < 1e-2,
            "{u} {v}: {z} {want}"
        );
    }
    for what in [
        "depth was resized from 48x36 to 96x72",
        "mask was resized from 48x36",
    ] {
        let told = scene.notes.iter().filter(|n| n.starts_with(what)).count();
        assert_eq!(told, 1, "{what}: {:?}", scene.notes);
    }
}

#[test]
fn masks_of_numbers_are_undistorted_as_those_of_255() {
    let folder = tempfile::tempdir().unwrap();
    take(folder.path(), &LENSES[2], 1);
    let plain = Scene::open(folder.path()).unwrap();
    for name in names(COUNT) {
        let path = folder.path().join("masks").join(&name);
        let mut mask = image::open(&path).unwrap().to_luma8();
        for (x, y, pixel) in mask.enumerate_pixels_mut() {
            if pixel.0[0] > 0 {
                pixel.0[0] = 1 + ((x + y) % 3) as u8;
            }
        }
        mask.save(&path).unwrap();
    }
    let numbered = Scene::open(folder.path()).unwrap();
    for (found, expected) in numbered.frames.iter().zip(&plain.frames) {
        assert!(found.mask.is_some(), "there are masks");
        assert!(found.mask == expected.mask, "{}", found.view.name);
    }
}

#[test]
fn points_outside_of_what_a_lens_sees_are_hidden() {
    let folder = tempfile::tempdir().unwrap();
    take(folder.path(), &LENSES[0], 1);
    // r - 0.25 r³ is 0.77 at most: nothing is seen at 1000 pixels.
    let file = folder
        .path()
        .join("flow3d_preprocessed/2d_tracks/00000_00001.npy");
    let mut rows = [[10.0f32, 10.0, -5.0, -5.0]; TRACKED.len()];
    rows[2][0] = 1000.0;
    make::write(&file, npy(&[TRACKED.len(), 4], rows.as_flattened()));
    let tracks = Scene::open(folder.path()).unwrap().tracks.unwrap();
    let hidden: Vec<_> = tracks.queries[0]
        .samples
        .iter()
        .map(|s| s.occlusion > 0.0)
        .collect();
    assert_eq!(
        hidden,
        [false, false, false, false, false, true, false, false]
    );
    assert!(tracks.queries[0].samples.iter().all(|s| s.x.is_finite()));
}

#[test]
fn distortion_is_refused_where_it_is_to_be() {
    let folder = tempfile::tempdir().unwrap();
    take(folder.path(), &LENSES[2], 1);
    let options = LoadOptions {
        refuse_distortion: true,
        ..LoadOptions::default()
    };
    let error = Scene::open_with(folder.path(), &options).unwrap_err();
    assert!(matches!(error, IoError::Distortion { .. }), "{error}");
    for part in ["OPENCV", "px", "--distortion refuse"] {
        assert!(error.to_string().contains(part), "{error}");
    }
}

#[test]
fn lenses_that_fold_the_picture_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut lens = LENSES[0];
    take(folder.path(), &lens, 1);
    lens.model.1 = &[80.0, 48.0, 36.0, -9.0];
    sized_model(
        &folder.path().join("flow3d_preprocessed/colmap/sparse"),
        &lens,
    );
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(matches!(error, IoError::Malformed { .. }), "{error}");
    for part in ["SIMPLE_RADIAL", "folds", "cameras.bin"] {
        assert!(error.to_string().contains(part), "{error}");
    }
}

#[test]
fn the_same_lens_in_a_transforms_json_gives_the_same_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let lens = &LENSES[2];
    take(folder.path(), lens, 1);
    let from_colmap = Scene::open(folder.path()).unwrap();
    let ([fx, fy], [cx, cy], k) = lens.parts();
    let frames: Vec<_> = (0..COUNT)
        .map(|i| {
            let (quat, translation) = pose(i);
            let world_from_cam = glam::DAffine3::from_rotation_translation(quat, translation).inverse();
            let [x, y, z] = [0, 1, 2].map(|c| world_from_cam.matrix3.col(c));
            let t = world_from_cam.translation;
            let row = |i: usize| json!([x[i], -y[i], -z[i], t[i]]);
            let name = format!("images/{:05}.png", i);
            json!({ "file_path": name, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]] })
        })
        .collect();
    let all = json!({
        "w": SIZE.0, "h": SIZE.1, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        "k1": k[0], "k2": k[1], "p1": k[2], "p2": k[3], "frames": frames,
    });
    std::fs::write(folder.path().join("transforms.json"), all.to_string()).unwrap();
    let from_json = Scene::open(folder.path()).unwrap();
    assert_eq!(from_json.layout, "nerfstudio");
    for (a, b) in from_json.frames.iter().zip(&from_colmap.frames) {
        assert_eq!(
            (&a.view.camera, &a.view.image),
            (&b.view.camera, &b.view.image)
        );
    }
}
