//! Tiny scenes, written by hand so that they do not share a line with the readers.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use io::{IoError, LoadOptions, Scene, View};
use tempfile::TempDir;

pub(crate) const WIDTH: usize = 16;
pub(crate) const HEIGHT: usize = 12;
pub(crate) const FRAMES: usize = 3;
pub(crate) const FOCAL: f64 = 20.0;

/// `.npy` of numbers of NumPy's type `kind`.
pub(crate) fn array(kind: &str, shape: &[usize], bytes: &[u8]) -> Vec<u8> {
    let sides: Vec<_> = shape.iter().map(|s| format!("{s},")).collect();
    let sides = sides.concat();
    let dict = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({sides}), }}");
    let header = format!("{dict:<117}\n");
    let mut data = b"\x93NUMPY\x01\x00".to_vec();
    data.extend((header.len() as u16).to_le_bytes());
    data.extend(header.as_bytes());
    data.extend(bytes);
    data
}

/// `.npy` of f32.
pub(crate) fn npy(shape: &[usize], values: &[f32]) -> Vec<u8> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    array("<f4", shape, &bytes)
}

pub(crate) fn write(path: &Path, data: impl AsRef<[u8]>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, data).unwrap();
}

/// A grey picture, PNG or JPEG by the path's ending.
pub(crate) fn picture(path: &Path, size: (usize, usize), value: impl Fn(usize, usize) -> u8) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let (w, h) = (size.0 as u32, size.1 as u32);
    image::GrayImage::from_fn(w, h, |x, y| image::Luma([value(x as usize, y as usize)]))
        .save(path)
        .unwrap();
}

/// A grey PNG that EXIF wants turned: 6 is a quarter to the right.
pub(crate) fn exif_picture(path: &Path, size: (usize, usize), orientation: u8) {
    let (w, h) = (size.0 as u32, size.1 as u32);
    let mut info = png::Info::with_size(w, h);
    info.bit_depth = png::BitDepth::Eight;
    // TIFF: little-endian, the directory at 8, one entry: tag 0x112 of one 16-bit number.
    let mut exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    info.exif_metadata = Some(exif.into());
    let file = fs::File::create(path).unwrap();
    let encoder = png::Encoder::with_info(file, info).unwrap();
    let mut writer = encoder.write_header().unwrap();
    let greys: Vec<u8> = (0..size.0 * size.1).map(|i| i as u8).collect();
    writer.write_image_data(&greys).unwrap();
}

/// A colour picture with a ramp in it.
pub(crate) fn ramp(path: &Path, frame: usize) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::RgbImage::from_fn(WIDTH as u32, HEIGHT as u32, |x, y| {
        image::Rgb([8 * x as u8, 8 * y as u8, 10 * frame as u8])
    })
    .save(path)
    .unwrap();
}

/// Camera from world of the model's image `number`: a slow pan to the right; odd ones 0.3 to the side.
pub(crate) fn pose(number: usize) -> (DQuat, DVec3) {
    let quat = DQuat::from_rotation_y(0.05 * (number / 2) as f64);
    let center = DVec3::new(0.3 * (number % 2) as f64, 0.1 * (number / 2) as f64, 0.0);
    (quat, -(DMat3::from_quat(quat) * center))
}

/// Twice the pictures' size, as the focal length of 1280x720 stands for pictures of 512x288.
const OF_CAMERAS: [f64; 3] = [2.0 * HEIGHT as f64, 2.0 * WIDTH as f64, 2.0 * FOCAL];

/// `poses_bounds.npy` with LLFF's rows: the axes down, right and back of each camera, its centre, and height, width, focal length.
pub(crate) fn poses_bounds(cameras: usize) -> Vec<u8> {
    let row = |number: usize| {
        let (rotation, translation) = pose(number);
        let world_from_cam = DMat3::from_quat(rotation).transpose();
        let center = -(world_from_cam * translation);
        let columns = [
            world_from_cam.y_axis,
            world_from_cam.x_axis,
            -world_from_cam.z_axis,
            center,
            DVec3::from_array(OF_CAMERAS),
        ];
        let rows = (0..3).flat_map(move |r| columns.map(|column| column[r] as f32));
        rows.chain([1.0, 10.0]).collect::<Vec<f32>>()
    };
    let values: Vec<f32> = (0..cameras).flat_map(row).collect();
    npy(&[cameras, 17], &values)
}

/// Asserts that a view's picture, time and camera are those of a row of [`poses_bounds`].
pub(crate) fn assert_stereo_camera(view: &View, row: usize) {
    let (rotation, translation) = pose(row);
    let found = view.cam_from_world;
    let (turn, shift) = (DMat3::from_quat(rotation), found.translation - translation);
    assert!(found.matrix3.abs_diff_eq(turn, 1e-6), "row {row}'s axes");
    assert!(shift.length() < 1e-6, "row {row}'s centre");
    let size = (view.image.width, view.image.height);
    assert_eq!(size, (WIDTH, HEIGHT), "row {row}'s picture");
    assert_eq!(view.time, (row / 2) as f32, "row {row}'s instant");
    // The cameras are those of pictures twice as large.
    let c = &view.camera;
    let expected = [FOCAL, FOCAL, 8.0, 6.0];
    assert_eq!([c.fx, c.fy, c.cx, c.cy], expected, "row {row}'s lens");
}

/// The scene with its movers ignored.
pub(crate) fn without_movers(root: &Path) -> Result<Scene, IoError> {
    let options = LoadOptions {
        static_scene: true,
        ..LoadOptions::default()
    };
    Scene::open_with(root, &options)
}

/// Points of the model, in front of the cameras.
pub(crate) const POINTS: [[f64; 3]; 2] = [[0.1, 0.2, 4.0], [-0.3, 0.1, 5.0]];

/// A COLMAP model of these images, numbered by position. `camera` is the model's number and parameters.
pub(crate) fn colmap_binary(folder: &Path, names: &[String], camera: (i32, &[f64])) {
    let le = |v: u64| v.to_le_bytes();
    let floats = |v: &[f64]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let mut cameras = le(1).to_vec();
    cameras.extend(1u32.to_le_bytes());
    cameras.extend(camera.0.to_le_bytes());
    cameras.extend([le(WIDTH as u64), le(HEIGHT as u64)].concat());
    cameras.extend(floats(camera.1));
    write(&folder.join("cameras.bin"), cameras);

    let mut images = le(names.len() as u64).to_vec();
    for (number, name) in names.iter().enumerate() {
        let (q, t) = pose(number);
        images.extend((number as u32 + 1).to_le_bytes());
        images.extend(floats(&[q.w, q.x, q.y, q.z, t.x, t.y, t.z]));
        images.extend(1u32.to_le_bytes());
        images.extend(name.as_bytes());
        images.push(0);
        // One 2D point, so that it has to be skipped.
        images.extend([le(1).as_slice(), &floats(&[1.0, 2.0]), &le(7)].concat());
    }
    write(&folder.join("images.bin"), images);

    let mut points = le(POINTS.len() as u64).to_vec();
    for (id, position) in POINTS.iter().enumerate() {
        points.extend(le(id as u64));
        points.extend(floats(position));
        points.extend([255, 0, 51]);
        points.extend(floats(&[0.5]));
        points.extend([le(2), le(1), le(2)].concat());
    }
    write(&folder.join("points3D.bin"), points);
}

/// The same as text.
pub(crate) fn colmap_text(folder: &Path, names: &[String]) {
    let mut images = String::from("# Image list with two lines of data per image:\n");
    for (number, name) in names.iter().enumerate() {
        let (q, t) = pose(number);
        let pose = [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
            .map(|v| format!("{v:?}"))
            .join(" ");
        // The second line may be empty.
        let second = if number % 2 == 0 { "1.0 2.0 7" } else { "" };
        images += &format!("{} {pose} 1 {name}\n{second}\n", number + 1);
    }
    write(&folder.join("images.txt"), images);
    let (cx, cy) = (WIDTH as f64 / 2.0, HEIGHT as f64 / 2.0);
    let camera = format!("# comment\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {cx} {cy}\n");
    write(&folder.join("cameras.txt"), camera);
    let mut points = String::from("# comment\n");
    for (id, [x, y, z]) in POINTS.iter().enumerate() {
        points += &format!("{id} {x} {y} {z} 255 0 51 0.5 1 0 2 1\n");
    }
    write(&folder.join("points3D.txt"), points);
}

pub(crate) fn names(count: usize) -> Vec<String> {
    (0..count).map(|i| format!("{i:05}.png")).collect()
}

pub(crate) const PINHOLE: (i32, &[f64]) = (1, &[FOCAL, FOCAL, 8.0, 6.0]);

/// A scene in Shape-of-Motion's layout with everything: stereo, depth, masks, tracks, truth.
pub(crate) struct Som {
    folder: TempDir,
}

impl Som {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let pre = root.join("flow3d_preprocessed");
        for q in 0..FRAMES {
            let png = format!("{q:05}.png");
            ramp(&root.join("images").join(&png), q);
            ramp(&root.join("images_test").join(&png), q + 10);
            ramp(&root.join("truth/images_sharp").join(&png), q + 20);
            let size = (WIDTH, HEIGHT);
            picture(&root.join("masks").join(&png), size, |x, _| {
                255 * u8::from(x < 5)
            });
            picture(&root.join("truth/covisible").join(&png), size, |_, _| 255);
            picture(&root.join("truth/masks_test").join(&png), size, |x, _| {
                255 * u8::from(x < 4)
            });
            let disparity: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| 0.1 + 0.01 * i as f32).collect();
            write(
                &pre.join(format!("aligned_depth_anything_colmap/{q:05}.npy")),
                npy(&[HEIGHT, WIDTH], &disparity),
            );
            for t in 0..FRAMES {
                // q + 1 points; point p of query q is at (p + t, q) in frame t.
                let rows: Vec<f32> = (0..=q)
                    .flat_map(|p| [(p + t) as f32, q as f32, -5.0, -4.0])
                    .collect();
                write(
                    &pre.join(format!("2d_tracks/{q:05}_{t:05}.npy")),
                    npy(&[q + 1, 4], &rows),
                );
            }
        }
        colmap_binary(&pre.join("colmap/sparse"), &names(2 * FRAMES), PINHOLE);
        Self { folder }
    }

    pub(crate) fn root(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn path(&self, inside: &str) -> PathBuf {
        self.root().join(inside)
    }

    pub(crate) fn remove(&self, inside: &str) {
        let path = self.path(inside);
        if path.is_dir() {
            fs::remove_dir_all(path).unwrap();
        } else {
            fs::remove_file(path).unwrap();
        }
    }

    /// Puts the track files into one archive.
    pub(crate) fn pack_tracks(&self) {
        let folder = self.path("flow3d_preprocessed/2d_tracks");
        let archive = self.path("flow3d_preprocessed/2d_tracks.npz");
        let mut archive = zip::ZipWriter::new(fs::File::create(archive).unwrap());
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            archive
                .start_file(name, zip::write::FileOptions::default())
                .unwrap();
            archive.write_all(&fs::read(&path).unwrap()).unwrap();
        }
        archive.finish().unwrap();
        self.remove("flow3d_preprocessed/2d_tracks");
    }
}
