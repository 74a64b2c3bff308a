//! Masks in the forms that people have them in.

use std::fs;

use io::{LoadOptions, Scene};

use crate::make::{self, FRAMES, HEIGHT, Som, WIDTH};

#[test]
fn empty_masks_are_no_masks() {
    let som = Som::new();
    som.remove("flow3d_preprocessed/2d_tracks");
    for i in 0..FRAMES {
        make::picture(
            &som.path(&format!("masks/{i:05}.png")),
            (WIDTH, HEIGHT),
            |_, _| 0,
        );
    }
    let scene = Scene::open(som.root()).unwrap();
    assert!(scene.frames.iter().all(|f| f.mask.is_none()));
    assert!(
        scene.notes.iter().any(|n| n.contains("empty")),
        "{:?}",
        scene.notes
    );
}

#[test]
fn files_of_other_kinds_are_not_passed_over() {
    for (folder, file) in [
        ("masks", "00000.npy"),
        (
            "flow3d_preprocessed/aligned_depth_anything_colmap",
            "00000.png",
        ),
    ] {
        let som = Som::new();
        som.remove(folder);
        fs::create_dir_all(som.path(folder)).unwrap();
        fs::write(som.path(&format!("{folder}/{file}")), "not looked at").unwrap();
        let said = Scene::open(som.root()).unwrap_err().to_string();
        assert!(
            said.contains(folder) && said.contains("convert them"),
            "{said}"
        );
    }
}

#[test]
fn masks_of_zero_and_one_are_stretched() {
    let som = Som::new();
    for i in 0..FRAMES {
        let at = som.path(&format!("masks/{i:05}.png"));
        make::picture(&at, (WIDTH, HEIGHT), |x, _| u8::from(x == 0));
    }
    let halved = LoadOptions {
        downscale: 2,
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(som.root(), &halved).unwrap();
    assert_eq!(
        scene.frames[0].mask.as_ref().unwrap().values[..2],
        [0.5, 0.0]
    );
}

#[test]
fn masks_of_small_numbers_move_where_they_are_not_zero() {
    let som = Som::new();
    for i in 0..FRAMES {
        let at = som.path(&format!("masks/{i:05}.png"));
        make::picture(&at, (WIDTH, HEIGHT), |x, _| x.min(3) as u8);
    }
    let scene = Scene::open(som.root()).unwrap();
    assert_eq!(
        scene.frames[0].mask.as_ref().unwrap().values[..5],
        [0.0, 1.0, 1.0, 1.0, 1.0]
    );
    let told = |note: &String| note.contains("3 of 255");
    assert!(scene.notes.iter().any(told), "{:?}", scene.notes);
}

/// How much of a pixel moves is the same whichever number its mover has.
#[test]
fn smaller_masks_of_numbers_are_those_of_255() {
    let masks = |left: u8, right: u8, downscale: usize| {
        let som = Som::new();
        for i in 0..FRAMES {
            let at = som.path(&format!("masks/{i:05}.png"));
            make::picture(&at, (WIDTH, HEIGHT), |x, y| match (x, y) {
                (0..5, _) => left,
                (13.., 2..9) => right,
                _ => 0,
            });
        }
        let options = LoadOptions {
            downscale,
            ..LoadOptions::default()
        };
        let scene = Scene::open_with(som.root(), &options).unwrap();
        let masks = scene.frames.into_iter().map(|f| f.mask.unwrap());
        masks.collect::<Vec<_>>()
    };
    for downscale in [1, 2, 3, 4] {
        let expected = masks(255, 255, downscale);
        for (left, right) in [(1, 20), (20, 1), (3, 3), (2, 127)] {
            let found = masks(left, right, downscale);
            assert!(found == expected, "{left} and {right} / {downscale}");
        }
    }
    // A quarter of each pixel in the second column.
    assert_eq!(masks(1, 20, 4)[0].values[..2], [1.0, 0.25]);
}

/// The numbers of the first frames may be small where another's say that they are shares.
#[test]
fn masks_are_read_alike_in_all_frames() {
    let som = Som::new();
    for (i, most) in [0, 64, 255].into_iter().enumerate() {
        let at = som.path(&format!("masks/{i:05}.png"));
        make::picture(&at, (WIDTH, HEIGHT), |x, _| if x < 5 { most } else { 0 });
    }
    let scene = Scene::open(som.root()).unwrap();
    let first = |i: usize| scene.frames[i].mask.as_ref().unwrap().values[0];
    assert_eq!([first(0), first(1), first(2)], [0.0, 64.0 / 255.0, 1.0]);
}

#[test]
fn masks_in_the_alpha_channel_are_read() {
    let som = Som::new();
    let plain = Scene::open(som.root()).unwrap();
    for i in 0..FRAMES {
        let path = som.path(&format!("masks/{i:05}.png"));
        image::RgbaImage::from_fn(WIDTH as u32, HEIGHT as u32, |x, _| {
            image::Rgba([0, 0, 0, 255 * u8::from(x < 5)])
        })
        .save(path)
        .unwrap();
    }
    let scene = Scene::open(som.root()).unwrap();
    for (frame, wanted) in scene.frames.iter().zip(&plain.frames) {
        assert_eq!(frame.mask, wanted.mask);
    }
    let told = |n: &&String| n.contains("alpha channel");
    assert_eq!(
        scene.notes.iter().filter(told).count(),
        1,
        "{:?}",
        scene.notes
    );
}

/// One bit a pixel packs eight times better than one byte, and is no broken file for that.
#[test]
fn masks_of_one_bit_are_read() {
    let som = Som::new();
    let (w, h) = (640, 480);
    for i in 0..FRAMES {
        let file = fs::File::create(som.path(&format!("masks/{i:05}.png"))).unwrap();
        let mut encoder = png::Encoder::new(file, w, h);
        encoder.set_depth(png::BitDepth::One);
        let mut writer = encoder.write_header().unwrap();
        writer
            .write_image_data(&vec![0; (w * h / 8) as usize])
            .unwrap();
    }
    io::read_map(&som.path("masks/00000.png")).unwrap();
}
