//! What ViPE writes, with samples written as its `save_artifacts` writes them.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use flate2::Compression;
use flate2::write::ZlibEncoder;
use half::f16;
use io::{IoError, Scene};
use tempfile::TempDir;

use crate::make::{self, FRAMES, HEIGHT, WIDTH, array, npy, pose, without_movers};

/// An EXR as OpenEXR's `OutputFile` writes it by default: rows of half floats in one channel, packed by
/// zlib sixteen at a time.
fn exr(
    channel: &str,
    (width, height): (usize, usize),
    value: impl Fn(usize, usize) -> f32,
) -> Vec<u8> {
    let attribute = |name: &str, kind: &str, value: &[u8]| {
        let size = (value.len() as u32).to_le_bytes();
        [name.as_bytes(), b"\0", kind.as_bytes(), b"\0", &size, value].concat()
    };
    let ints = |v: &[i32]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let floats = |v: &[f32]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    // Half is type 1; it is not linear; both samplings are 1.
    let channels = [channel.as_bytes(), b"\0", &ints(&[1, 0, 1, 1]), b"\0"].concat();
    let window = ints(&[0, 0, width as i32 - 1, height as i32 - 1]);
    let header = [
        b"\x76\x2f\x31\x01\x02\0\0\0".to_vec(),
        attribute("channels", "chlist", &channels),
        attribute("compression", "compression", &[3]),
        attribute("dataWindow", "box2i", &window),
        attribute("displayWindow", "box2i", &window),
        attribute("lineOrder", "lineOrder", &[0]),
        attribute("pixelAspectRatio", "float", &floats(&[1.0])),
        attribute("screenWindowCenter", "v2f", &floats(&[0.0, 0.0])),
        attribute("screenWindowWidth", "float", &floats(&[1.0])),
        vec![0],
    ]
    .concat();
    let chunks: Vec<Vec<u8>> = (0..height)
        .step_by(16)
        .map(|y| {
            let rows = y..height.min(y + 16);
            let values = rows.flat_map(|y| (0..width).map(move |x| (x, y)));
            let bytes: Vec<u8> = values
                .flat_map(|(x, y)| f16::from_f32(value(x, y)).to_le_bytes())
                .collect();
            // All low bytes, then all high bytes, each as its difference to the one before.
            let apart: Vec<u8> = [0, 1]
                .into_iter()
                .flat_map(|byte| bytes.iter().copied().skip(byte).step_by(2))
                .collect();
            let before = [128].into_iter().chain(apart.iter().copied());
            let differences: Vec<u8> = apart
                .iter()
                .zip(before)
                .enumerate()
                .map(|(i, (&v, before))| {
                    if i == 0 {
                        v
                    } else {
                        v.wrapping_sub(before).wrapping_add(128)
                    }
                })
                .collect();
            let mut packer = ZlibEncoder::new(Vec::new(), Compression::default());
            packer.write_all(&differences).unwrap();
            let packed = packer.finish().unwrap();
            // What packing makes longer is stored as it is.
            let packed = if packed.len() < bytes.len() {
                packed
            } else {
                bytes
            };
            [ints(&[y as i32, packed.len() as i32]), packed].concat()
        })
        .collect();
    let mut at = header.len() + 8 * chunks.len();
    let mut file = header;
    for chunk in &chunks {
        file.extend((at as u64).to_le_bytes());
        at += chunk.len();
    }
    file.extend(chunks.concat());
    file
}

fn zip(path: &Path, entries: &[(String, Vec<u8>)]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut archive = zip::ZipWriter::new(fs::File::create(path).unwrap());
    for (name, data) in entries {
        let options = zip::write::FileOptions::default();
        archive.start_file(name, options).unwrap();
        archive.write_all(data).unwrap();
    }
    archive.finish().unwrap();
}

/// An archive of `data` [N, …], whose rows belong to these frames.
fn rows(path: &Path, shape: &[usize], data: &[f32], frames: &[i64]) {
    let numbers: Vec<u8> = frames.iter().flat_map(|v| v.to_le_bytes()).collect();
    let inds = array("<i8", &[frames.len()], &numbers);
    let shape = [&[frames.len()], shape].concat();
    zip(
        path,
        &[
            ("data.npy".into(), npy(&shape, data)),
            ("inds.npy".into(), inds),
        ],
    );
}

fn png(labels: impl Fn(u32, u32) -> u8) -> Vec<u8> {
    let mut data = std::io::Cursor::new(Vec::new());
    image::GrayImage::from_fn(WIDTH as u32, HEIGHT as u32, |x, y| {
        image::Luma([labels(x, y)])
    })
    .write_to(&mut data, image::ImageFormat::Png)
    .unwrap();
    data.into_inner()
}

fn depth_of(frame: usize) -> Vec<u8> {
    exr("Z", (WIDTH, HEIGHT), |x, y| {
        if (x, y) == (0, 0) {
            f32::INFINITY
        } else {
            2.0 + frame as f32 + 0.125 * x as f32 + 0.25 * y as f32
        }
    })
}

fn poses(frames: &[i64]) -> Vec<f32> {
    let row = |&frame: &i64| {
        let (rotation, translation) = pose(2 * frame as usize);
        let cam_from_world = glam::DMat4::from_rotation_translation(rotation, translation);
        // Rows of the inverse are columns of its transpose.
        let rows = cam_from_world.inverse().transpose().to_cols_array();
        rows.map(|v| v as f32)
    };
    frames.iter().flat_map(row).collect()
}

/// All that `vipe infer` leaves of a video of three frames, and pictures of it.
fn sample() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let all: Vec<i64> = (0..FRAMES as i64).collect();
    rows(&root.join("pose/swing.npz"), &[4, 4], &poses(&all), &all);
    let intrinsics = [20.0, 21.0, 8.0, 6.0].repeat(FRAMES);
    rows(&root.join("intrinsics/swing.npz"), &[4], &intrinsics, &all);
    make::write(
        &root.join("intrinsics/swing_camera.txt"),
        "0: PINHOLE\n1: PINHOLE\n2: PINHOLE\n",
    );
    make::write(&root.join("rgb/swing.mp4"), "no video");
    let (mut depths, mut masks) = (Vec::new(), Vec::new());
    for frame in 0..FRAMES {
        make::ramp(&root.join(format!("rgb/swing/{frame:05}.png")), frame);
        depths.push((format!("{frame:05}.exr"), depth_of(frame)));
        // Sky above, a person on the left, and an instance that no line of the text is about.
        let labels = png(|x, y| match (x, y) {
            (_, 0..3) => 2,
            (0..4, _) => 1,
            (9, 9) => 7,
            _ => 0,
        });
        masks.push((format!("{frame:05}.png"), labels));
    }
    zip(&root.join("depth/swing.zip"), &depths);
    zip(&root.join("mask/swing.zip"), &masks);
    make::write(&root.join("mask/swing.txt"), "1: person\n2: sky\n");
    make::write(&root.join("vipe/swing_info.pkl"), "\x01");
    folder
}

/// Tracks, in the place of what ViPE does not make.
fn add_tracks(root: &Path) {
    for query in 0..FRAMES {
        for target in 0..FRAMES {
            let name = format!("flow3d_preprocessed/2d_tracks/{query:05}_{target:05}.npy");
            make::write(&root.join(name), npy(&[1, 4], &[1.0, 2.0, -5.0, -5.0]));
        }
    }
}

#[test]
fn what_vipe_writes_is_a_scene() {
    let folder = sample();
    let error = Scene::open(folder.path()).unwrap_err();
    assert!(
        matches!(error, IoError::MasksWithoutTracks { .. }),
        "{error}"
    );
    assert!(error.to_string().contains("swing.zip"), "{error}");

    add_tracks(folder.path());
    let scene = Scene::open(folder.path()).unwrap();
    assert_eq!((scene.layout, scene.frames.len()), ("ViPE", FRAMES));
    assert!(scene.test.is_empty() && scene.points.is_empty());
    assert_eq!(scene.tracks.as_ref().unwrap().num_tracks(), FRAMES);
    for (i, frame) in scene.frames.iter().enumerate() {
        let view = &frame.view;
        assert_eq!(
            (view.name.clone(), view.time),
            (format!("{i:05}"), i as f32)
        );
        let c = &view.camera;
        assert_eq!(
            (c.width, c.height, c.fx, c.fy, c.cx, c.cy),
            (WIDTH, HEIGHT, 20.0, 21.0, 8.0, 6.0)
        );
        let (rotation, translation) = pose(2 * i);
        let turn = glam::DMat3::from_quat(rotation);
        assert!(view.cam_from_world.matrix3.abs_diff_eq(turn, 1e-6));
        assert!((view.cam_from_world.translation - translation).length() < 1e-6);

        let depth = &frame.depth.as_ref().unwrap().values;
        assert_eq!(depth[0], 0.0, "what is infinitely far has no depth");
        let (x, y) = (5, 11);
        let z = 2.0 + i as f32 + 0.125 * x as f32 + 0.25 * y as f32;
        assert_eq!(depth[y * WIDTH + x], z, "z-depth, not disparity");
        let mask = &frame.mask.as_ref().unwrap().values;
        let moves = |x: usize, y: usize| mask[y * WIDTH + x];
        assert_eq!(
            [moves(1, 0), moves(1, 5), moves(9, 9), moves(5, 5)],
            [0.0, 1.0, 1.0, 0.0]
        );
    }
    for part in ["could move", "picture's corner"] {
        let told = scene.notes.iter().any(|n| n.contains(part));
        assert!(told, "{part}: {:?}", scene.notes);
    }

    // Pictures of half the size, and no depth that says which size the intrinsics are for but theirs.
    for frame in 0..FRAMES {
        let path = folder.path().join(format!("rgb/swing/{frame:05}.png"));
        make::picture(&path, (WIDTH / 2, HEIGHT / 2), |_, _| 9);
    }
    let scene = without_movers(folder.path()).unwrap();
    let c = &scene.frames[0].view.camera;
    assert_eq!([c.fx, c.cx, c.cy], [10.0, 4.0, 3.0]);
    assert!(scene.frames.iter().all(|f| f.mask.is_none()));
}

#[test]
fn what_is_not_there_of_vipe_is_done_without() {
    let folder = sample();
    let root = folder.path();
    // A pose that was not found; no depth, no masks, no kinds of cameras.
    rows(
        &root.join("pose/swing.npz"),
        &[4, 4],
        &poses(&[0, 2]),
        &[0, 2],
    );
    fs::remove_dir_all(root.join("depth")).unwrap();
    fs::remove_dir_all(root.join("mask")).unwrap();
    fs::remove_file(root.join("intrinsics/swing_camera.txt")).unwrap();
    let scene = Scene::open(root).unwrap();
    let names: Vec<_> = scene.frames.iter().map(|f| f.view.name.as_str()).collect();
    assert_eq!(names, ["00000", "00002"]);
    assert_eq!(scene.frames[1].view.time, 1.0);
    assert!(scene.frames[0].depth.is_none() && scene.frames[0].mask.is_none());
}

#[test]
fn a_video_is_not_decoded_and_the_line_that_does_it_is_told() {
    let folder = sample();
    fs::remove_dir_all(folder.path().join("rgb/swing")).unwrap();
    let error = Scene::open(folder.path()).unwrap_err().to_string();
    let root = folder.path().canonicalize().unwrap();
    let rgb = root.join("rgb").display().to_string();
    let line = format!(
        "mkdir '{rgb}/swing' && ffmpeg -i '{rgb}/swing.mp4' -start_number 0 '{rgb}/swing/%05d.png'"
    );
    assert!(error.contains(&line), "{error}");
    fs::remove_file(folder.path().join("rgb/swing.mp4")).unwrap();
    let error = Scene::open(folder.path()).unwrap_err().to_string();
    assert!(error.contains("neither pictures nor a video"), "{error}");
}

#[test]
fn what_is_wrong_with_vipes_files_is_named() {
    let all = [0, 1, 2];
    type Damage<'a> = &'a dyn Fn(&Path);
    let depth = |data: Vec<u8>| {
        move |r: &Path| {
            zip(
                &r.join("depth/swing.zip"),
                &[("00000.exr".into(), data.clone())],
            );
        }
    };
    let masks = |name: &'static str, data: Vec<u8>| {
        move |r: &Path| zip(&r.join("mask/swing.zip"), &[(name.into(), data.clone())])
    };
    let good = depth_of(0);
    let vast = exr("Z", (30_000, 16), |_, _| 1.0);
    // The same file, said to be 30,000 rows high.
    let at = vast
        .windows(4)
        .position(|w| w == 15i32.to_le_bytes())
        .unwrap();
    let mut bomb = vast.clone();
    bomb[at..at + 4].copy_from_slice(&29_999i32.to_le_bytes());
    let mut colour = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(WIDTH as u32, HEIGHT as u32)
        .write_to(&mut colour, image::ImageFormat::Png)
        .unwrap();
    let (mut nan, mut mirrored) = (poses(&all), poses(&all));
    nan[0] = f32::NAN;
    for value in mirrored[16..32].iter_mut().step_by(4) {
        *value *= -1.0;
    }
    let cases: [(Damage<'_>, &[&str]); 18] = [
        (
            &|r| fs::remove_file(r.join("pose/swing.npz")).unwrap(),
            &["poses", "pose"],
        ),
        (
            &|r| rows(&r.join("pose/other.npz"), &[4, 4], &poses(&all), &all),
            &["other, swing are several videos", "pose"],
        ),
        (
            &|r| rows(&r.join("pose/swing.npz"), &[4, 4], &nan, &all),
            &["frame 0", "swing.npz"],
        ),
        (
            &|r| rows(&r.join("pose/swing.npz"), &[4, 4], &mirrored, &all),
            &["frame 1", "swing.npz"],
        ),
        (
            &|r| rows(&r.join("pose/swing.npz"), &[16], &poses(&all), &all),
            &["[3, 16]", "swing.npz"],
        ),
        (
            &|r| rows(&r.join("pose/swing.npz"), &[4, 4], &poses(&all), &[0, 1, 1]),
            &["inds holds 1"],
        ),
        (
            &|r| {
                rows(
                    &r.join("pose/swing.npz"),
                    &[4, 4],
                    &poses(&all),
                    &[0, 1, -2],
                );
            },
            &["inds holds -2"],
        ),
        (
            &|r| fs::remove_file(r.join("rgb/swing/00001.png")).unwrap(),
            &["2 pictures", "frames up to 2", "rgb/swing"],
        ),
        (
            &|r| rows(&r.join("intrinsics/swing.npz"), &[4], &[9.0; 8], &[0, 2]),
            &["frame 1, and no intrinsics"],
        ),
        (
            &|r| rows(&r.join("intrinsics/swing.npz"), &[4], &[0.0; 12], &all),
            &["frame 0", "focal length 0"],
        ),
        (
            &|r| {
                make::write(
                    &r.join("intrinsics/swing_camera.txt"),
                    "0: PINHOLE\n1: MEI\n",
                );
            },
            &["frame 1 has a MEI camera", "swing_camera.txt"],
        ),
        (
            &|r| make::write(&r.join("mask/swing.txt"), "1: person\nsky\n"),
            &["line 2", "mask/swing.txt"],
        ),
        (
            &depth(good.clone()),
            &["depth of 00001, 00002", "depth/swing.zip"],
        ),
        (
            &depth(bomb),
            &["promises 30000x30000 pixels", "swing.zip/00000.exr"],
        ),
        (
            &depth(exr("R", (WIDTH, HEIGHT), |_, _| 1.0)),
            &["one channel Z", "00000.exr"],
        ),
        (
            &|r| {
                let entry = |i| (format!("{i:05}.exr"), exr("Z", (HEIGHT, WIDTH), |_, _| 1.0));
                zip(&r.join("depth/swing.zip"), &[0, 1, 2].map(entry));
            },
            &["12x16", "00000.png"],
        ),
        (
            &masks("00000.png", colour.into_inner()),
            &["8-bit grey", "swing.zip/00000.png"],
        ),
        (
            &masks("first.png", png(|_, _| 1)),
            &["entry first", "mask/swing.zip"],
        ),
    ];
    for (damage, told) in cases {
        let folder = sample();
        add_tracks(folder.path());
        damage(folder.path());
        let error = Scene::open(folder.path()).unwrap_err().to_string();
        for part in told {
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}

#[test]
fn archives_that_lie_about_sizes_are_refused() {
    // Zeros pack to a thousandth: the directory promises more than any packing gives.
    let folder = sample();
    let path = folder.path().join("depth/swing.zip");
    zip(&path, &[("00000.exr".into(), vec![0; 1 << 20])]);
    let mut data = fs::read(&path).unwrap();
    let size = data
        .windows(4)
        .rposition(|w| w == (1u32 << 20).to_le_bytes())
        .unwrap();
    data[size..size + 4].copy_from_slice(&0x7fff_ffffu32.to_le_bytes());
    fs::write(&path, data).unwrap();
    let error = without_movers(folder.path()).unwrap_err().to_string();
    assert!(error.contains("promises 2147483647 bytes"), "{error}");

    // Cut anywhere, each archive and each EXR in one is an error that names it.
    for name in [
        "pose/swing.npz",
        "intrinsics/swing.npz",
        "depth/swing.zip",
        "mask/swing.zip",
    ] {
        let folder = sample();
        add_tracks(folder.path());
        let path = folder.path().join(name);
        let whole = fs::read(&path).unwrap();
        for cut in (0..whole.len()).step_by(97) {
            fs::write(&path, &whole[..cut]).unwrap();
            let error = Scene::open(folder.path()).unwrap_err().to_string();
            assert!(error.contains(name), "{name} cut at {cut}: {error}");
        }
    }
    let whole = depth_of(0);
    let folder = sample();
    let path = folder.path().join("depth/swing.zip");
    for cut in 0..whole.len() {
        zip(&path, &[("00000.exr".into(), whole[..cut].to_vec())]);
        let error = without_movers(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains("swing.zip/00000.exr"),
            "cut at {cut}: {error}"
        );
    }
}

#[test]
fn changed_bytes_of_an_exr_are_an_error_or_another_depth() {
    let folder = sample();
    let path = folder.path().join("depth/swing.zip");
    let whole = depth_of(0);
    let others = [1, 2].map(|i| (format!("{i:05}.exr"), depth_of(i)));
    for at in 0..whole.len() {
        for change in [0x01, 0x80, 0xff] {
            let mut data = whole.clone();
            data[at] ^= change;
            let mut entries = vec![("00000.exr".to_owned(), data)];
            entries.extend(others.clone());
            zip(&path, &entries);
            if let Err(error) = without_movers(folder.path()) {
                let told = error.to_string();
                assert!(told.contains("swing"), "{at} ^ {change:#x}: {told}");
            }
        }
    }
}
