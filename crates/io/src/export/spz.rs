//! SPZ version 3: Gaussians in a few bytes each, gzipped. Spark, SuperSplat and LichtFeld all read it, and not all of
//! them version 4.
//!
//! Specification: README.md and `src/cc/load-spz.cc` in <https://github.com/nianticlabs/spz>. A header of 16 bytes, then of all
//! Gaussians positions (24-bit fixed point), opacities (8 bits), colours (8 bits), scales (8 bits of the logarithm), rotations
//! (the three smaller numbers of the quaternion in 10 bits each) and spherical harmonics (8 bits). Axes are OpenGL's: y up.
//!
//! The reference writer rounds spherical harmonics to 5 bits and 4, which readers need not know. Where coefficients are small, as
//! Limpid's are, that is most of them: on the demo a picture came within 37.5 dB with them rounded so, and within 51.3 dB with all 8
//! bits, for a file half again as large (docs/EXPORT.md).

use std::io::Write as _;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use splat_core::Gaussians;

use super::gaussians::{OPENGL, check, opacity, turned, unit_quat};
use crate::{IoError, write_atomic};

/// Positions are within ± this, in steps of 2^-bits scene units.
const MAX_FIXED: f32 = 8_388_607.0;
/// Finer steps than this no scene needs, and readers shift by the number.
const MAX_BITS: i32 = 20;
/// A degree-0 coefficient's share of the stored colour: wide enough for what is brighter than white.
const COLOR_SCALE: f32 = 0.15;

/// What a file could not hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpzLoss {
    /// Positions are rounded to this, in scene units.
    pub position_step: f32,
    /// Largest coordinate of all positions, in scene units: what the step follows from.
    pub farthest: f32,
    /// Gaussians with a scale outside of what the format has, which is e^-10 to e^5.94 scene units: it is the nearest there.
    pub clipped_scales: usize,
    /// Gaussians with a colour outside of what the format has, which is -0.44 to 1.44 where white is 1, and -1 to 0.99 for
    /// coefficients over degree 0: it is the nearest there.
    pub clipped_colors: usize,
}

/// Writes Gaussians as SPZ version 3, atomically, and says what the format lost beside its usual rounding.
///
/// # Errors
/// [`IoError::Invalid`]: arrays that do not fit each other, a Gaussian over 8,388,607 scene units away, over 4 billion of them;
/// [`IoError::NotANumber`]; [`IoError::Access`].
pub fn write_spz(path: &Path, gaussians: &Gaussians) -> Result<SpzLoss, IoError> {
    check(gaussians, path)?;
    let count = u32::try_from(gaussians.len())
        .map_err(|_| IoError::invalid(path, "over 4 billion Gaussians, more than SPZ can count"))?;
    let farthest = gaussians.means.as_flattened().iter();
    let farthest = farthest.fold(0.0_f32, |far, v| far.max(v.abs()));
    if farthest > MAX_FIXED {
        let what = format!("a Gaussian is {farthest} scene units away, and SPZ holds {MAX_FIXED}");
        return Err(IoError::invalid(path, what));
    }
    let bits = fractional_bits(farthest);
    let turned = turned(gaussians, OPENGL);
    let degree = u8::try_from(turned.sh_degree).expect("a degree from 0 to 3");
    let num_sh = (turned.sh_degree + 1).pow(2);
    let rows = || turned.sh.chunks_exact(3 * num_sh);
    let scales = turned.log_scales.iter();
    let is_clipped_scale = |scale: &&[f32; 3]| scale.iter().any(|s| is_clipped(stored_scale(*s)));
    let is_clipped_color = |sh: &&[f32]| {
        let (color, rest) = sh.split_at(3);
        color.iter().any(|c| is_clipped(stored_color(*c)))
            || rest.iter().any(|c| is_clipped(stored_sh(*c)))
    };
    let loss = SpzLoss {
        position_step: 0.5_f32.powi(bits),
        farthest,
        clipped_scales: scales.filter(is_clipped_scale).count(),
        clipped_colors: rows().filter(is_clipped_color).count(),
    };
    write_atomic(path, |out| {
        let mut out = GzEncoder::new(out, Compression::best());
        out.write_all(b"NGSP")?;
        out.write_all(&3_u32.to_le_bytes())?;
        out.write_all(&count.to_le_bytes())?;
        out.write_all(&[degree, bits as u8, 0, 0])?;
        let unit = 2.0_f32.powi(bits);
        for v in turned.means.as_flattened() {
            let fixed = (v * unit).round() as i32;
            out.write_all(&fixed.to_le_bytes()[..3])?;
        }
        let opacities = turned.opacity_logits.iter();
        out.write_all(&bytes(opacities.map(|o| 255.0 * opacity(*o))))?;
        let colors = rows().flat_map(|sh| &sh[..3]);
        out.write_all(&bytes(colors.map(|c| stored_color(*c))))?;
        let scales = turned.log_scales.as_flattened().iter();
        out.write_all(&bytes(scales.map(|s| stored_scale(*s))))?;
        for quat in &turned.quats {
            out.write_all(&smallest_three(*quat).to_le_bytes())?;
        }
        for sh in rows() {
            out.write_all(&bytes(sh[3..].iter().map(|c| stored_sh(*c))))?;
        }
        out.finish()?.flush()
    })?;
    Ok(loss)
}

/// As many as leave room for the farthest position.
fn fractional_bits(farthest: f32) -> i32 {
    let fits = |bits: &i32| farthest * 2.0_f32.powi(*bits) <= MAX_FIXED;
    (0..=MAX_BITS).rev().find(fits).unwrap_or(0)
}

fn stored_scale(log_scale: f32) -> f32 {
    (log_scale + 10.0) * 16.0
}

/// Of a coefficient of degree 0.
fn stored_color(coefficient: f32) -> f32 {
    coefficient * (COLOR_SCALE * 255.0) + 127.5
}

/// Of the other coefficients.
fn stored_sh(coefficient: f32) -> f32 {
    coefficient * 128.0 + 128.0
}

/// Whether a byte loses more of a value than by rounding it.
fn is_clipped(value: f32) -> bool {
    !(0.0..=255.0).contains(&value.round())
}

/// Rounded and clamped.
fn bytes(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.map(|value| value.round() as u8).collect()
}

/// A rotation (w, x, y, z) without its largest number: that one's place among (x, y, z, w) in two bits, then of each of the
/// others sign and size, 511 for √½.
fn smallest_three(quat: [f32; 4]) -> u32 {
    let [w, x, y, z] = unit_quat(quat);
    let quat = [x, y, z, w];
    let mut largest = 0;
    for i in 1..4 {
        if quat[i].abs() > quat[largest].abs() {
            largest = i;
        }
    }
    let mut packed = largest as u32;
    for i in (0..4).filter(|i| *i != largest) {
        let is_negative = (quat[i] < 0.0) != (quat[largest] < 0.0);
        let size = (511.0 * (quat[i].abs() / std::f32::consts::FRAC_1_SQRT_2) + 0.5) as u32;
        packed = packed << 10 | u32::from(is_negative) << 9 | size.min(511);
    }
    packed
}
