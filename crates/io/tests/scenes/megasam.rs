//! MegaSaM's archive, with a sample written as its `cvd_opt.py` writes it.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use glam::{DMat3, DVec3};
use io::{IoError, Scene};
use tempfile::TempDir;

use crate::make::{self, FRAMES, HEIGHT, WIDTH, array, npy};

/// Camera i stands at (0.1 i, 0.2, -1) and is turned by 0.1 i about y.
fn rotation(frame: usize) -> DMat3 {
    DMat3::from_rotation_y(0.1 * frame as f64)
}

fn arrays() -> Vec<(&'static str, Vec<u8>)> {
    let pixels = (0..FRAMES).flat_map(|f| {
        (0..WIDTH * HEIGHT).flat_map(move |i| [(i % WIDTH) as u8, (i / WIDTH) as u8, 100 + f as u8])
    });
    // 2.0 and 2.5 as half floats.
    let depths = (0..FRAMES * WIDTH * HEIGHT).flat_map(|i| match i % WIDTH {
        0 => 0x4100u16.to_le_bytes(),
        _ => 0x4000u16.to_le_bytes(),
    });
    let poses: Vec<f32> = (0..FRAMES)
        .flat_map(|f| {
            let r = rotation(f).transpose().to_cols_array_2d();
            let t = [0.1 * f as f64, 0.2, -1.0];
            let rows = (0..3).flat_map(move |i| [r[i][0], r[i][1], r[i][2], t[i]]);
            rows.chain([0.0, 0.0, 0.0, 1.0]).map(|v| v as f32)
        })
        .collect();
    let intrinsic = [20.0f32, 0.0, 8.0, 0.0, 21.0, 6.0, 0.0, 0.0, 1.0];
    vec![
        (
            "images",
            array(
                "|u1",
                &[FRAMES, HEIGHT, WIDTH, 3],
                &pixels.collect::<Vec<_>>(),
            ),
        ),
        (
            "depths",
            array("<f2", &[FRAMES, HEIGHT, WIDTH], &depths.collect::<Vec<_>>()),
        ),
        ("intrinsic", npy(&[3, 3], &intrinsic)),
        ("cam_c2w", npy(&[FRAMES, 4, 4], &poses)),
    ]
}

fn write(root: &Path, name: &str, arrays: &[(&str, Vec<u8>)]) {
    let file = fs::File::create(root.join(name)).unwrap();
    let mut archive = zip::ZipWriter::new(file);
    for (name, data) in arrays {
        let options = zip::write::FileOptions::default();
        archive.start_file(format!("{name}.npy"), options).unwrap();
        archive.write_all(data).unwrap();
    }
    archive.finish().unwrap();
}

fn sample() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "swing_sgd_cvd_hr.npz", &arrays());
    folder
}

#[test]
fn an_archive_of_megasam_is_a_scene() {
    let folder = sample();
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!((scene.layout, scene.frames.len()), ("MegaSaM", FRAMES));
    assert!(scene.test.is_empty() && scene.points.is_empty() && scene.tracks.is_none());
    let view = &scene.frames[2].view;
    assert_eq!((view.name.as_str(), view.time), ("00002", 2.0));
    let c = &view.camera;
    assert_eq!(
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy),
        (WIDTH, HEIGHT, 20.0, 21.0, 8.0, 6.0)
    );
    let at = 3 * (5 * WIDTH + 7);
    assert_eq!(
        view.image.pixels[at..at + 3],
        [7.0 / 255.0, 5.0 / 255.0, 102.0 / 255.0]
    );
    let depth = scene.frames[1].depth.as_ref().unwrap();
    assert_eq!(depth.values[..2], [2.5, 2.0], "z-depth, not disparity");

    let center = DVec3::new(0.2, 0.2, -1.0);
    let ahead = center + rotation(2) * DVec3::Z;
    let pose = view.cam_from_world;
    assert!(pose.transform_point3(center).length() < 1e-6);
    assert!(
        (pose.transform_point3(ahead) - DVec3::Z).length() < 1e-6,
        "OpenCV axes"
    );
}

#[test]
fn masks_and_tracks_lie_beside_it_under_the_frames_numbers() {
    let folder = sample();
    for query in 0..FRAMES {
        let path = folder.path().join(format!("masks/{query:05}.png"));
        make::picture(&path, (WIDTH, HEIGHT), |x, _| 255 * u8::from(x < 5));
        for target in 0..FRAMES {
            let name = format!("flow3d_preprocessed/2d_tracks/{query:05}_{target:05}.npy");
            make::write(
                &folder.path().join(name),
                npy(&[1, 4], &[1.0, 2.0, -5.0, -5.0]),
            );
        }
    }
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!(scene.layout, "MegaSaM");
    assert_eq!(scene.tracks.unwrap().num_tracks(), FRAMES);
    assert!(scene.frames.iter().all(|f| f.mask.is_some()));

    // Masks that are all named otherwise are no absence of masks.
    for query in 0..FRAMES {
        let masks = folder.path().join("masks");
        let to = masks.join(format!("{query:04}.png"));
        fs::rename(masks.join(format!("{query:05}.png")), to).unwrap();
    }
    let said = Scene::open(folder.path()).unwrap_err().to_string();
    assert!(said.contains("00000, not 0000"), "{said}");
}

#[test]
fn what_is_wrong_with_an_archive_is_named() {
    let replaced = |name: &str, data: Vec<u8>| {
        let mut arrays = arrays();
        arrays.iter_mut().find(|a| a.0 == name).unwrap().1 = data;
        arrays
    };
    let pose = |first: f32| {
        let mut values = [0.0f32; 16 * FRAMES];
        for at in 0..4 * FRAMES {
            values[16 * (at / 4) + 5 * (at % 4)] = 1.0;
        }
        values[0] = first;
        npy(&[FRAMES, 4, 4], &values)
    };
    let cases = [
        (
            replaced(
                "depths",
                npy(&[FRAMES, WIDTH, HEIGHT], &[1.0; FRAMES * WIDTH * HEIGHT]),
            ),
            "depths has shape",
        ),
        (
            replaced("images", npy(&[FRAMES, 2, 2], &[1.0; FRAMES * 4])),
            "images has shape",
        ),
        (
            replaced(
                "images",
                npy(
                    &[FRAMES, HEIGHT, WIDTH, 3],
                    &[0.5; FRAMES * WIDTH * HEIGHT * 3],
                ),
            ),
            "0 to 255",
        ),
        (
            replaced("images", npy(&[0, HEIGHT, WIDTH, 3], &[])),
            "images has shape",
        ),
        (replaced("cam_c2w", pose(2.0)), "cam_c2w of frame 0"),
        (replaced("cam_c2w", pose(f32::NAN)), "cam_c2w of frame 0"),
        (
            replaced("intrinsic", npy(&[3, 3], &[0.0; 9])),
            "focal length 0",
        ),
        (arrays().into_iter().skip(1).collect(), "missing images"),
    ];
    for (arrays, told) in cases {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "swing_sgd_cvd_hr.npz", &arrays);
        let error = Scene::open(folder.path()).unwrap_err().to_string();
        for part in [told, "swing_sgd_cvd_hr.npz"] {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
    let folder = sample();
    write(folder.path(), "other_sgd_cvd_hr.npz", &arrays());
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(matches!(error, IoError::Names { .. }), "{error}");
    for part in [
        "other_sgd_cvd_hr.npz",
        "swing_sgd_cvd_hr.npz",
        "a folder of its own",
    ] {
        assert!(error.to_string().contains(part), "{part}: {error}");
    }
    let path = folder.path().join("other_sgd_cvd_hr.npz");
    fs::remove_file(&path).unwrap();
    let path = folder.path().join("swing_sgd_cvd_hr.npz");
    let whole = fs::read(&path).unwrap();
    for cut in (0..whole.len()).step_by(701) {
        fs::write(&path, &whole[..cut]).unwrap();
        let error = Scene::open(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("swing_sgd_cvd_hr.npz"),
            "cut at {cut}: {error}"
        );
    }
}
