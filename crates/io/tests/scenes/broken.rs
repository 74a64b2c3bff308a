//! Broken input: an error that names the file, never a panic, never memory that a header asks for.

use std::fs;
use std::path::Path;

use io::{IoError, Scene};

use crate::make::{self, FRAMES, HEIGHT, Som, WIDTH, npy};

/// Opens the scene and wants an error that names `file`.
fn error_names(root: &Path, file: &str, why: &str) -> IoError {
    let opened = Scene::open(root).and_then(|scene| scene.truth().map(|_| scene));
    let Err(error) = opened else {
        panic!("{why}: the scene opened");
    };
    let text = error.to_string();
    assert!(text.contains(file), "{why}: '{text}' does not name {file}");
    error
}

const SPARSE: &str = "flow3d_preprocessed/colmap/sparse";
const DEPTH: &str = "flow3d_preprocessed/aligned_depth_anything_colmap";

#[test]
fn truncated_at_every_37th_byte() {
    let som = Som::new();
    let jpeg = som.path("images/00001.jpg");
    make::picture(&jpeg, (WIDTH, HEIGHT), |x, y| (x * y) as u8);
    som.remove("images/00001.png");
    Scene::open(som.root()).unwrap();

    let mut files = vec![
        "images/00000.png".to_string(),
        "images/00001.jpg".into(),
        "images_test/00002.png".into(),
        "masks/00001.png".into(),
        "truth/covisible/00001.png".into(),
        format!("{DEPTH}/00001.npy"),
        "flow3d_preprocessed/2d_tracks/00002_00001.npy".into(),
    ];
    for stem in ["cameras", "images", "points3D"] {
        files.push(format!("{SPARSE}/{stem}.bin"));
    }
    for file in files {
        let path = som.path(&file);
        let whole = fs::read(&path).unwrap();
        let ends = [whole.len() - 1, whole.len().saturating_sub(5)];
        for length in (0..whole.len()).step_by(37).chain(ends) {
            fs::write(&path, &whole[..length]).unwrap();
            error_names(som.root(), &file, &format!("{file} cut at {length}"));
        }
        fs::write(&path, &whole).unwrap();
    }
    Scene::open(som.root()).unwrap();

    som.pack_tracks();
    let path = som.path("flow3d_preprocessed/2d_tracks.npz");
    let whole = fs::read(&path).unwrap();
    for length in (0..whole.len()).step_by(37) {
        fs::write(&path, &whole[..length]).unwrap();
        error_names(
            som.root(),
            "2d_tracks.npz",
            &format!("archive cut at {length}"),
        );
    }
}

#[test]
fn truncated_text_never_panics() {
    let som = Som::new();
    som.remove(SPARSE);
    make::colmap_text(&som.path(SPARSE), &make::names(2 * FRAMES));
    Scene::open(som.root()).unwrap();
    for stem in ["cameras", "images", "points3D"] {
        let path = som.path(&format!("{SPARSE}/{stem}.txt"));
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            // Half a model can be a smaller model; what matters is that it is told, not guessed.
            Scene::open(som.root()).ok();
        }
        fs::write(&path, "1 what is this\n").unwrap();
        let error = error_names(som.root(), &format!("{stem}.txt"), "nonsense");
        assert!(error.to_string().contains("line 1"), "{error}");
        fs::write(&path, &whole).unwrap();
    }
}

#[test]
fn absurd_counts() {
    let som = Som::new();
    // A wrong count anywhere in the models: at the start, and an image's or a point's own.
    for (file, at) in [
        ("cameras.bin", 0),
        ("images.bin", 0),
        ("images.bin", 8 + 4 + 56 + 4 + 10),
        ("points3D.bin", 0),
        ("points3D.bin", 8 + 8 + 24 + 3 + 8),
    ] {
        let path = som.path(&format!("{SPARSE}/{file}"));
        let whole = fs::read(&path).unwrap();
        for count in [1u64 << 40, u64::MAX, 1000] {
            let mut broken = whole.clone();
            broken[at..at + 8].copy_from_slice(&count.to_le_bytes());
            fs::write(&path, &broken).unwrap();
            let error = error_names(som.root(), file, &format!("{count} at {at} of {file}"));
            assert!(matches!(error, IoError::Truncated { .. }), "{error}");
        }
        fs::write(&path, &whole).unwrap();
    }

    let huge = npy(&[1 << 30, 1 << 20], &[1.0; 8]);
    for file in [
        format!("{DEPTH}/00000.npy"),
        "flow3d_preprocessed/2d_tracks/00000_00001.npy".into(),
    ] {
        let whole = fs::read(som.path(&file)).unwrap();
        fs::write(som.path(&file), &huge).unwrap();
        let error = error_names(som.root(), &file, "huge array");
        assert!(matches!(error, IoError::Truncated { .. }), "{error}");
        fs::write(som.path(&file), whole).unwrap();
    }

    // The archive's directory lies about an entry: packed size (at 20) or real size (at 24).
    let som_packed = Som::new();
    som_packed.pack_tracks();
    let file = "flow3d_preprocessed/2d_tracks.npz";
    let whole = fs::read(som_packed.path(file)).unwrap();
    let entry = whole.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    for at in [20, 24] {
        let mut broken = whole.clone();
        broken[entry + at..entry + at + 4].copy_from_slice(&0xffff_0000u32.to_le_bytes());
        fs::write(som_packed.path(file), broken).unwrap();
        let error = error_names(som_packed.root(), file, "huge entry");
        assert!(matches!(error, IoError::Truncated { .. }), "{error}");
    }

    // A picture of 60000 x 60000 in a few hundred bytes, with a right checksum.
    let file = "images/00000.png";
    let mut data = fs::read(som.path(file)).unwrap();
    data[16..20].copy_from_slice(&60_000u32.to_be_bytes());
    data[20..24].copy_from_slice(&60_000u32.to_be_bytes());
    let checksum = crc32(&data[12..29]);
    data[29..33].copy_from_slice(&checksum.to_be_bytes());
    fs::write(som.path(file), &data).unwrap();
    let error = error_names(som.root(), file, "huge picture");
    assert!(matches!(error, IoError::Truncated { .. }), "{error}");
}

/// PNG's checksum, bit by bit.
fn crc32(data: &[u8]) -> u32 {
    let step = |crc: u32, _| {
        if crc & 1 == 1 {
            (crc >> 1) ^ 0xedb8_8320
        } else {
            crc >> 1
        }
    };
    !data
        .iter()
        .fold(!0u32, |crc, &b| (0..8).fold(crc ^ u32::from(b), step))
}

#[test]
fn missing_files_are_named() {
    for (file, named) in [
        (format!("{DEPTH}/00001.npy"), "00001"),
        ("masks/00002.png".into(), "00002"),
        (
            "flow3d_preprocessed/2d_tracks/00001_00002.npy".into(),
            "00001_00002.npy",
        ),
        ("images/00001.png".into(), "00002 without a file in images/"),
        (
            "images_test/00001.png".into(),
            "00003 without a file in images_test/",
        ),
        (format!("{SPARSE}/images.bin"), "images.bin"),
        (format!("{SPARSE}/cameras.bin"), "cameras.bin"),
    ] {
        let som = Som::new();
        som.remove(&file);
        error_names(som.root(), named, &format!("without {file}"));
    }
    let som = Som::new();
    for i in 0..FRAMES {
        som.remove(&format!("images/{i:05}.png"));
    }
    make::write(&som.path("images/a.webp"), "");
    error_names(som.root(), "images", "no pictures at all");
}

#[test]
fn wrong_sizes_are_named() {
    for (file, size, told) in [
        ("images/00001.png", (WIDTH / 2, HEIGHT / 2), "8x6"),
        ("masks/00001.png", (WIDTH / 2, HEIGHT), "8x12"),
    ] {
        let som = Som::new();
        make::picture(&som.path(file), size, |_, _| 255);
        let error = error_names(som.root(), file, told);
        assert!(matches!(error, IoError::Size { .. }), "{error}");
        let expected = format!("{told}, expected 16x12");
        assert!(error.to_string().contains(&expected), "{error}");
    }
    // The odd one is named where it is the first too, which has depth, and where sizes are even in number.
    for (others, odd) in [(vec![], 0), (vec![], 2), (vec![2], 0)] {
        let som = Som::new();
        for other in others {
            make::picture(
                &som.path(&format!("images/{other:05}.png")),
                (32, 24),
                |_, _| 9,
            );
        }
        let file = format!("images/{odd:05}.png");
        make::picture(&som.path(&file), (WIDTH / 2, HEIGHT / 2), |_, _| 255);
        let error = error_names(som.root(), &file, "one of another size");
        assert!(error.to_string().contains("8x6, expected 16x12"), "{error}");
    }
    let som = Som::new();
    let file = format!("{DEPTH}/00001.npy");
    for shape in [
        vec![HEIGHT, WIDTH / 2],
        vec![WIDTH, HEIGHT],
        vec![HEIGHT * WIDTH],
        vec![0, WIDTH],
    ] {
        let values = vec![1.0; shape.iter().product()];
        make::write(&som.path(&file), npy(&shape, &values));
        error_names(som.root(), &file, &format!("{shape:?}"));
    }
    let som = Som::new();
    let file = "flow3d_preprocessed/2d_tracks/00001_00001.npy";
    for shape in [[1, 4], [3, 4], [4, 2]] {
        make::write(
            &som.path(file),
            npy(&shape, &vec![1.0; shape[0] * shape[1]]),
        );
        error_names(som.root(), file, &format!("{shape:?}"));
    }
}

#[test]
fn not_a_number_is_named() {
    let som = Som::new();
    let file = format!("{DEPTH}/00001.npy");
    let mut disparity = vec![0.5f32; WIDTH * HEIGHT];
    disparity[WIDTH + 3] = f32::NAN;
    make::write(&som.path(&file), npy(&[HEIGHT, WIDTH], &disparity));
    let error = error_names(som.root(), &file, "NaN depth");
    assert!(matches!(error, IoError::NotANumber { .. }), "{error}");
    assert!(error.to_string().contains("column 3, row 1"), "{error}");
    assert!(error.to_string().contains("with 0"), "{error}");

    let som = Som::new();
    let file = "flow3d_preprocessed/2d_tracks/00001_00000.npy";
    make::write(
        &som.path(file),
        npy(&[2, 4], &[0.0, 0.0, 0.0, 0.0, 1.0, f32::NAN, 0.0, 0.0]),
    );
    let error = error_names(som.root(), file, "NaN track");
    assert!(error.to_string().contains("row 1"), "{error}");
    // There, 0 is a place.
    assert!(!error.to_string().contains("with 0"), "{error}");

    for at in [8 + 4, 8 + 4 + 32] {
        let som = Som::new();
        let path = som.path(&format!("{SPARSE}/images.bin"));
        let mut data = fs::read(&path).unwrap();
        data[at..at + 8].copy_from_slice(&f64::NAN.to_le_bytes());
        fs::write(&path, data).unwrap();
        error_names(som.root(), "images.bin", "NaN pose");
    }
    for (focal, fault) in [
        (f64::NAN, "NaN is not a number"),
        (0.0, "0 is not over zero"),
        (-5.0, "-5 is not over zero"),
        (f64::INFINITY, "inf is no lens's"),
    ] {
        let som = Som::new();
        let names = make::names(2 * FRAMES);
        make::colmap_binary(&som.path(SPARSE), &names, (1, &[20.0, focal, 8.0, 6.0]));
        let why = format!("camera 1: focal length {fault}");
        let error = error_names(som.root(), "cameras.bin", &why);
        assert!(error.to_string().contains(&why), "{error}");
    }
    let som = Som::new();
    let camera = (1, &[20.0, 20.0, 8.0, f64::NAN][..]);
    make::colmap_binary(&som.path(SPARSE), &make::names(2 * FRAMES), camera);
    let error = error_names(som.root(), "cameras.bin", "NaN centre");
    assert!(error.to_string().contains("coordinate NaN"), "{error}");
}

#[test]
fn other_kinds_of_files_are_named() {
    for (file, content) in [
        ("images/00001.png", &b"GIF89a, or something else"[..]),
        ("masks/00000.png", b""),
        (
            "flow3d_preprocessed/2d_tracks/00000_00000.npy",
            b"PK\x03\x04",
        ),
    ] {
        let som = Som::new();
        fs::write(som.path(file), content).unwrap();
        error_names(som.root(), file, "another kind of file");
    }
    let som = Som::new();
    fs::write(som.path("transforms.json"), "{\"frames\": [").unwrap();
    error_names(som.root(), "transforms.json", "half a file");

    // A file in the place of the scene's folder.
    let file = som.path("transforms.json");
    let error = error_names(&file, "transforms.json", "a file");
    assert!(error.to_string().contains("scene is a folder"), "{error}");
}

/// Neither what has no end nor what never begins keeps the loader busy.
#[cfg(unix)]
#[test]
fn what_is_no_regular_file_is_refused() {
    for file in [
        "images/00001.png",
        "flow3d_preprocessed/2d_tracks/00000_00000.npy",
    ] {
        let som = Som::new();
        som.remove(file);
        std::os::unix::fs::symlink("/dev/zero", som.path(file)).unwrap();
        error_names(som.root(), file, "a file without end");
    }
}
