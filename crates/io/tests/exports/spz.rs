//! SPZ, by a reader of version 3 after its specification.

use crate::made::{
    Numbers, axes_differ, extreme, gaussians, refuses_what_is_no_number, sh_sign, sigmoid,
};
use flate2::read::GzDecoder;
use io::{Gaussians, IoError, write_spz};
use std::io::Read as _;

/// y up, x right, z back.
const UP: [f32; 3] = [1.0, -1.0, -1.0];

struct Read {
    bits: i32,
    degree: usize,
    means: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    colors: Vec<[f32; 3]>,
    log_scales: Vec<[f32; 3]>,
    /// (w, x, y, z).
    quats: Vec<[f32; 4]>,
    sh: Vec<f32>,
}

fn read(data: &[u8]) -> Read {
    assert_eq!(data[..2], [0x1f, 0x8b], "gzip");
    let mut all = Vec::new();
    GzDecoder::new(data).read_to_end(&mut all).unwrap();
    assert_eq!(&all[..8], b"NGSP\x03\0\0\0");
    let n = u32::from_le_bytes(all[8..12].try_into().unwrap()) as usize;
    let (degree, bits) = (usize::from(all[12]), i32::from(all[13]));
    assert_eq!(all[14..16], [0, 0], "no flags");
    let mut rest = &all[16..];
    let mut take = |count: usize| {
        let (head, tail) = rest.split_at(count);
        rest = tail;
        head.to_vec()
    };
    let three = |v: Vec<f32>| v.as_chunks::<3>().0.to_vec();
    let position = |b: &[u8; 3]| {
        // The sign is the third byte's.
        let fixed = i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8;
        fixed as f32 * 0.5_f32.powi(bits)
    };
    let means = three(
        take(9 * n)
            .as_chunks::<3>()
            .0
            .iter()
            .map(position)
            .collect(),
    );
    let bytes = |raw: Vec<u8>, scale: f32, shift: f32| -> Vec<f32> {
        raw.iter().map(|b| f32::from(*b) * scale + shift).collect()
    };
    let opacities = bytes(take(n), 1.0 / 255.0, 0.0);
    let colors = three(bytes(take(3 * n), 1.0 / (255.0 * 0.15), -0.5 / 0.15));
    let log_scales = three(bytes(take(3 * n), 1.0 / 16.0, -10.0));
    let quats = take(4 * n)
        .as_chunks::<4>()
        .0
        .iter()
        .map(|b| quat(u32::from_le_bytes(*b)))
        .collect();
    let num_sh = 3 * ((degree + 1).pow(2) - 1);
    let sh = bytes(take(num_sh * n), 1.0 / 128.0, -1.0);
    assert!(rest.is_empty(), "{} bytes more", rest.len());
    Read {
        bits,
        degree,
        means,
        opacities,
        colors,
        log_scales,
        quats,
        sh,
    }
}

fn quat(mut packed: u32) -> [f32; 4] {
    let largest = (packed >> 30) as usize;
    let mut xyzw = [0.0_f32; 4];
    let mut sum = 0.0;
    for i in (0..4).rev().filter(|i| *i != largest) {
        let size = (packed & 511) as f32 / 511.0 * 0.5_f32.sqrt();
        xyzw[i] = if packed & 512 == 0 { size } else { -size };
        sum += size * size;
        packed >>= 10;
    }
    xyzw[largest] = (1.0 - sum).max(0.0).sqrt();
    let [x, y, z, w] = xyzw;
    [w, x, y, z]
}

fn written(gaussians: &Gaussians) -> (Read, io::SpzLoss) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.spz");
    let loss = write_spz(&path, gaussians).unwrap();
    (read(&std::fs::read(path).unwrap()), loss)
}

#[test]
fn every_number_comes_back_within_its_rounding() {
    for (n, degree) in [(300, 0), (50, 1), (50, 2), (300, 3), (1, 3)] {
        let all = gaussians(n, degree);
        let (read, loss) = written(&all);
        assert_eq!((read.degree, read.means.len()), (degree, n));
        assert_eq!((loss.clipped_scales, loss.clipped_colors), (0, 0));
        assert_eq!(loss.position_step, 0.5_f32.powi(read.bits));
        assert!(loss.position_step < 1e-5, "fine for a scene of 20 units");
        let width = 3 * (degree + 1).pow(2);
        for i in 0..n {
            let [x, y, z] = all.means[i];
            for (found, expected) in read.means[i].into_iter().zip([x, -y, -z]) {
                assert!(
                    (found - expected).abs() <= 0.5 * loss.position_step,
                    "{found} {expected}"
                );
            }
            let opacity = sigmoid(all.opacity_logits[i]);
            assert!((read.opacities[i] - opacity).abs() < 0.51 / 255.0);
            for c in 0..3 {
                let of_color = (read.colors[i][c] - all.sh[i * width + c]).abs();
                assert!(of_color < 0.51 / (255.0 * 0.15), "{of_color}");
                assert!((read.log_scales[i][c] - all.log_scales[i][c]).abs() < 0.51 / 16.0);
            }
            assert!(axes_differ(read.quats[i], all.quats[i], UP) < 0.006);
            for k in 1..(degree + 1).pow(2) {
                for c in 0..3 {
                    let found = read.sh[(i * (width / 3 - 1) + k - 1) * 3 + c];
                    let expected = sh_sign(k, UP) * all.sh[i * width + 3 * k + c];
                    assert!(
                        (found - expected).abs() < 0.51 / 128.0,
                        "{k} {found} {expected}"
                    );
                }
            }
        }
    }
}

#[test]
fn positions_use_all_the_bits_that_there_are() {
    for size in [1e-4_f32, 0.3, 7.9, 2047.0, 2049.0, 8_388_607.0] {
        let mut all = gaussians(20, 0);
        let mut numbers = Numbers::new(3);
        all.means
            .iter_mut()
            .for_each(|m| *m = [(); 3].map(|()| size * numbers.next()));
        all.means[0] = [size, -size, size];
        let (read, loss) = written(&all);
        assert_eq!(loss.farthest, size);
        let finest = (size / 8_388_607.0).max(0.5_f32.powi(20));
        assert!(
            loss.position_step < 2.01 * finest,
            "{size}: {}",
            loss.position_step
        );
        for (found, [x, y, z]) in read.means.iter().zip(&all.means) {
            for (found, expected) in found.iter().zip([x, &-y, &-z]) {
                // And f32's own rounding.
                let off = (found - expected).abs();
                assert!(
                    off <= 0.5 * loss.position_step + 1e-7 * size,
                    "{size}: {found} {expected}"
                );
            }
        }
    }
}

#[test]
fn the_ends_of_numbers_are_the_ends_of_bytes() {
    let (read, loss) = written(&extreme());
    assert_eq!((read.opacities[0], read.opacities[1]), (1.0, 0.0));
    assert_eq!(read.log_scales[2], [5.9375; 3]);
    assert_eq!(read.log_scales[3], [-10.0; 3]);
    assert_eq!((loss.clipped_scales, loss.clipped_colors), (2, 2));
    assert_eq!(
        read.quats[4],
        [1.0, 0.0, 0.0, 0.0],
        "no rotation where there is none"
    );
    let all = read.quats.iter().flatten().chain(&read.sh);
    assert!(all.clone().all(|v| v.is_finite()));
}

#[test]
fn colours_beyond_what_a_byte_holds_are_counted() {
    const WIDTH: usize = 12;
    // The coefficient of x, whose sign stays.
    const X: usize = 9;
    let of_color = |byte: f32| (byte - 127.5) / (255.0 * 0.15);
    let of_rest = |byte: f32| (byte - 128.0) / 128.0;
    let mut all = gaussians(6, 1);
    // Less than half a step beyond is rounding.
    (all.sh[0], all.sh[1]) = (of_color(255.4), of_color(-0.4));
    (all.sh[X], all.sh[X + 1]) = (of_rest(255.4), of_rest(-0.4));
    assert_eq!(written(&all).1.clipped_colors, 0);
    all.sh[WIDTH] = of_color(255.6);
    all.sh[2 * WIDTH + 2] = of_color(-0.6);
    all.sh[3 * WIDTH + X] = of_rest(255.6);
    // One Gaussian, whichever of its numbers.
    all.sh[4 * WIDTH + X + 2] = of_rest(-0.6);
    all.sh[4 * WIDTH] = 9.0;
    let (read, loss) = written(&all);
    assert_eq!((loss.clipped_colors, loss.clipped_scales), (4, 0));
    for (found, end) in [
        (read.colors[1][0], 255.0),
        (read.colors[2][2], 0.0),
        (read.colors[4][0], 255.0),
    ] {
        assert!((found - of_color(end)).abs() < 1e-5, "{found}");
    }
}

#[test]
fn none_is_a_file_too() {
    let (read, loss) = written(&Gaussians {
        sh_degree: 3,
        ..Gaussians::default()
    });
    assert_eq!(
        (read.means.len(), read.degree, loss.clipped_scales),
        (0, 3, 0)
    );
}

#[test]
fn what_it_cannot_hold_is_refused() {
    refuses_what_is_no_number(|path, gaussians| write_spz(path, gaussians).map(|_| ()));
    let folder = tempfile::tempdir().unwrap();
    let mut far = gaussians(3, 0);
    far.means[1][2] = -1e9;
    let error = write_spz(&folder.path().join("scene.spz"), &far).unwrap_err();
    assert!(matches!(error, IoError::Invalid { .. }), "{error}");
    assert!(
        error.to_string().contains("1000000000 scene units away"),
        "{error}"
    );
}
