//! `io`'s parsers: each function puts the bytes where its kind of file belongs in a small good scene and
//! opens the scene by `io`'s front door. Whatever opens must be sound.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use io::{IoError, Map, Scene, View};
use tempfile::TempDir;

/// A target: the folder made by [`scenes`], and a file's content.
pub type Target = fn(&Path, &[u8]) -> Result<(), IoError>;

/// Every target by its name.
pub const TARGETS: [(&str, Target); 8] = [
    ("npy", npy),
    ("picture", picture),
    ("colmap_binary", colmap_binary),
    ("colmap_text", colmap_text),
    ("transforms", transforms),
    ("ply", ply),
    ("tracks", tracks),
    ("exr", exr),
];

/// An array, as a frame's disparity.
pub fn npy(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    let file = "flow3d_preprocessed/aligned_depth_anything_colmap/0.npy";
    open(&scenes.join("binary"), file, bytes)
}

/// A frame's picture; what is inside decides on the format, not the name.
pub fn picture(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    open(&scenes.join("binary"), "images/0.png", bytes)
}

/// A file of a binary COLMAP model; the first byte says which.
pub fn colmap_binary(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    colmap(&scenes.join("binary"), "bin", bytes)
}

/// A file of a COLMAP model as text; the first byte says which.
pub fn colmap_text(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    colmap(&scenes.join("text"), "txt", bytes)
}

fn colmap(scene: &Path, ending: &str, bytes: &[u8]) -> Result<(), IoError> {
    let (name, content) = match bytes.split_first() {
        Some((b'c', content)) => ("cameras", content),
        Some((b'i', content)) => ("images", content),
        _ => ("points3D", bytes.get(1..).unwrap_or_default()),
    };
    let file = format!("flow3d_preprocessed/colmap/sparse/{name}.{ending}");
    open(scene, &file, content)
}

/// nerfstudio's `transforms.json`.
pub fn transforms(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    open(&scenes.join("nerfstudio"), "transforms.json", bytes)
}

/// A PLY file, as a scene's points and as Gaussians; good if it is one of them.
pub fn ply(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    let points = open(&scenes.join("nerfstudio"), "points.ply", bytes);
    let path = scenes.join("gaussians.ply");
    fs::write(&path, bytes).expect("a file can be written");
    let gaussians = io::read_ply(&path).map(|read| {
        let n = read.len();
        let sh = 3 * n * (read.sh_degree + 1).pow(2);
        let lengths = [
            read.quats.len(),
            read.log_scales.len(),
            read.opacity_logits.len(),
        ];
        assert_eq!((lengths, read.sh.len()), ([n; 3], sh), "lengths");
        let numbers = [
            read.means.as_flattened(),
            read.quats.as_flattened(),
            &read.sh,
        ];
        assert!(numbers.concat().iter().all(|v| v.is_finite()), "numbers");
    });
    points.or(gaussians)
}

/// Tracks: of one pair of frames as an array, or of all in an archive.
pub fn tracks(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    let (scene, file) = if bytes.starts_with(b"PK") {
        ("archive", "flow3d_preprocessed/2d_tracks.npz")
    } else {
        ("binary", "flow3d_preprocessed/2d_tracks/0_1.npy")
    };
    open(&scenes.join(scene), file, bytes)
}

/// An EXR, as the depth of ViPE's one frame.
pub fn exr(scenes: &Path, bytes: &[u8]) -> Result<(), IoError> {
    let archive = stored("00000.exr", bytes);
    open(&scenes.join("vipe"), "depth/clip.zip", &archive)
}

/// A zip archive of one file, which is not packed.
fn stored(name: &str, bytes: &[u8]) -> Vec<u8> {
    let int = |value: usize| (value as u32).to_le_bytes();
    let (size, sum) = (int(bytes.len()), crc32fast::hash(bytes).to_le_bytes());
    let length = (name.len() as u16).to_le_bytes();
    // Version 2.0, neither flags nor packing nor time, and no extra field.
    let about = [
        &[20, 0, 0, 0, 0, 0, 0, 0, 0, 0][..],
        &sum,
        &size,
        &size,
        &length,
        &[0; 2],
    ]
    .concat();
    let file = [b"PK\x03\x04", &about[..], name.as_bytes(), bytes].concat();
    // No comment, the first disk, no attributes, at the beginning.
    let entry = [b"PK\x01\x02\x14\0", &about[..], &[0; 14], name.as_bytes()].concat();
    let end = [
        &b"PK\x05\x06\0\0\0\0\x01\0\x01\0"[..],
        &int(entry.len()),
        &int(file.len()),
        &[0; 2],
    ];
    [file, entry, end.concat()].concat()
}

/// A copy of the good scenes, for targets to change.
///
/// # Panics
/// The system refuses to copy.
pub fn scenes() -> TempDir {
    let copy = tempfile::tempdir().expect("a temporary folder can be made");
    // Found from this package and from the tests' alike.
    let good = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/scenes");
    copy_folder(&good, copy.path());
    copy
}

fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a folder can be made");
    for entry in fs::read_dir(from).expect("the good scenes are there") {
        let path = entry.expect("an entry of a folder").path();
        let target = to.join(path.file_name().expect("an entry has a name"));
        if path.is_dir() {
            copy_folder(&path, &target);
        } else {
            fs::copy(&path, &target).expect("a file can be copied");
        }
    }
}

/// Opens a scene in which one file has this content, and puts the file back.
fn open(scene: &Path, file: &str, bytes: &[u8]) -> Result<(), IoError> {
    let path = scene.join(file);
    let good = fs::read(&path).expect("the good scene has the file");
    fs::write(&path, bytes).expect("a file can be written");
    let opened = Scene::open(scene);
    fs::write(&path, good).expect("a file can be written");
    opened.map(|scene| check(&scene))
}

/// What a scene promises to everyone who gets one.
fn check(scene: &Scene) {
    let frames: Vec<&View> = scene.frames.iter().map(|frame| &frame.view).collect();
    assert!(!frames.is_empty(), "a scene has frames");
    for views in [&frames, &scene.test.iter().collect()] {
        let names: BTreeSet<&str> = views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!(names.len(), views.len(), "names are there once");
        views.iter().for_each(|view| check_view(view, frames.len()));
    }
    for frame in &scene.frames {
        let size = (frame.view.image.width, frame.view.image.height);
        let check_map = |map: &Map, largest: f32| {
            assert_eq!((map.width, map.height), size, "a map's size");
            assert_eq!(map.values.len(), size.0 * size.1, "a map's values");
            let inside = map.values.iter().all(|v| (0.0..=largest).contains(v));
            assert!(inside, "a map's values: {:?}", map.values);
        };
        frame.depth.iter().for_each(|map| check_map(map, f32::MAX));
        frame.mask.iter().for_each(|map| check_map(map, 1.0));
    }
    for point in &scene.points {
        let color = point.color.iter().all(|c| (0.0..=1.0).contains(c));
        assert!(point.position.is_finite() && color, "{point:?}");
    }
    if let Some(tracks) = &scene.tracks {
        assert_eq!(tracks.num_frames, frames.len(), "frames with tracks");
        assert_eq!(tracks.queries.len(), frames.len(), "frames with queries");
        for sample in tracks.queries.iter().flat_map(|query| &query.samples) {
            let position = sample.x.is_finite() && sample.y.is_finite();
            let logits = !sample.occlusion.is_nan() && !sample.expected_distance.is_nan();
            assert!(position && logits, "{sample:?}");
        }
    }
}

fn check_view(view: &View, num_frames: usize) {
    let (camera, image) = (&view.camera, &view.image);
    assert_eq!(
        (camera.width, camera.height),
        (image.width, image.height),
        "sizes"
    );
    assert_eq!(image.pixels.len(), 3 * image.width * image.height, "pixels");
    let focal = [camera.fx, camera.fy]
        .iter()
        .all(|f| f.is_finite() && *f > 0.0);
    assert!(
        focal && camera.cx.is_finite() && camera.cy.is_finite(),
        "{camera:?}"
    );
    let pose = &view.cam_from_world;
    let excess = pose.matrix3.transpose() * pose.matrix3 - glam::DMat3::IDENTITY;
    let rigid = excess.to_cols_array().iter().all(|v| v.abs() < 1e-9);
    let proper = (pose.matrix3.determinant() - 1.0).abs() < 1e-9;
    assert!(rigid && proper && pose.translation.is_finite(), "{pose:?}");
    let times = 0.0..=(num_frames - 1) as f32;
    assert!(
        times.contains(&view.time),
        "time {} of {num_frames}",
        view.time
    );
}
