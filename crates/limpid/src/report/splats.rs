//! The scene as the report's page reads it (`page/splats.js`): Gaussians in 36 bytes each and what their colours take, and
//! the motion bases. A change here is a change there, and of `VERSION`.
//!
//! All is little-endian. Eight numbers (u32) come first: magic, version, Gaussians N, movers F, bases B, frames T, degree D of the
//! spherical harmonics, 0. Then, each beginning at a multiple of four bytes:
//!
//! | what | type | shape |
//! |---|---|---|
//! | means, scene units; of movers in the canonical frame | f32 | [N, 3] |
//! | quaternions (w, x, y, z) of length 1, times 32,767 | i16 | [N, 4] |
//! | logarithms of the scales, opacity logit, colour of degree 0, factor of the other degrees | f16 | [N, 8] |
//! | motion bases: 6D rotation and translation | f32 | [T, B, 9] |
//! | logits of the motion coefficients | f32 | [F, B] |
//! | colour of degrees 1 to D, coefficient-major, in 127ths of the Gaussian's factor | i8 | [N, (D + 1)² - 1, 3] |
//!
//! Movers are the first F rows. A row with a number that is not finite is written with an opacity of none.

use half::f16;
use trainer::MotionArrays;

const MAGIC: [u8; 4] = *b"LMPD";
const VERSION: u32 = 1;
/// The most that a factor of f16 can be.
const LARGEST: f32 = 65_504.0;

/// Gaussians in the canonical frame, `[N]` rows each; colours coefficient-major.
pub(crate) struct Rows<'a> {
    pub(crate) means: &'a [[f32; 3]],
    pub(crate) quats: &'a [[f32; 4]],
    pub(crate) log_scales: &'a [[f32; 3]],
    pub(crate) opacity_logits: &'a [f32],
    /// [N, stored, 3].
    pub(crate) sh: &'a [f32],
}

/// The bytes of a scene, with colours up to `degree`.
pub(crate) fn encode(rows: &Rows<'_>, degree: usize, motion: Option<&MotionArrays>) -> Vec<u8> {
    let count = rows.means.len();
    let stored = rows.sh.len() / count.max(1);
    let degree = degree.min((stored / 3).isqrt().saturating_sub(1));
    let (bases, frames) = motion.map_or((0, 0), |m| (m.num_bases, m.num_frames));
    let movers = motion.map_or(0, |m| m.coefficients.len() / m.num_bases.max(1));
    let used = (3 * (degree + 1) * (degree + 1)).min(stored);
    let colors = |row: usize| &rows.sh[row * stored..][..used];
    let is_whole = |row: usize| {
        let logits = motion
            .filter(|_| row < movers)
            .map(|m| &m.coefficients[row * bases..][..bases]);
        let numbers = rows.means[row]
            .iter()
            .chain(&rows.quats[row])
            .chain(&rows.log_scales[row]);
        let numbers = numbers
            .chain(&rows.opacity_logits[row..=row])
            .chain(colors(row));
        numbers
            .chain(logits.unwrap_or_default())
            .all(|v| v.is_finite())
    };
    let whole: Vec<bool> = (0..count).map(is_whole).collect();
    let factors: Vec<f32> = (0..count)
        .map(|row| {
            let others = colors(row).get(3..).unwrap_or_default();
            others
                .iter()
                .fold(0.0_f32, |most, v| most.max(v.abs()))
                .min(LARGEST)
        })
        // As it will be read.
        .map(|factor| f16::from_f32(factor).to_f32())
        .collect();

    let mut out =
        Vec::with_capacity(32 + count * (36 + used) + movers * bases * 4 + frames * bases * 36);
    out.extend(MAGIC);
    for number in [VERSION as usize, count, movers, bases, frames, degree, 0] {
        out.extend((number as u32).to_le_bytes());
    }
    let nothing = |row: usize, value: f32| if whole[row] { value } else { 0.0 };
    for (row, mean) in rows.means.iter().enumerate() {
        out.extend(mean.iter().flat_map(|&v| nothing(row, v).to_le_bytes()));
    }
    for quat in rows.quats {
        out.extend(
            unit(quat)
                .iter()
                .flat_map(|v| ((v * 32_767.0).round() as i16).to_le_bytes()),
        );
    }
    for row in 0..count {
        let mut numbers = [0.0; 8];
        numbers[..3].copy_from_slice(&rows.log_scales[row]);
        numbers[3] = rows.opacity_logits[row];
        for (number, color) in numbers[4..7].iter_mut().zip(colors(row)) {
            *number = color.clamp(-LARGEST, LARGEST);
        }
        numbers[7] = factors[row];
        if !whole[row] {
            numbers = [0.0; 8];
            numbers[3] = f32::NEG_INFINITY;
        }
        out.extend(numbers.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()));
    }
    if let Some(motion) = motion {
        for frame in 0..frames {
            for basis in 0..bases {
                let at = basis * frames + frame;
                let numbers = motion.rots[6 * at..][..6]
                    .iter()
                    .chain(&motion.transls[3 * at..][..3]);
                out.extend(numbers.flat_map(|v| v.to_le_bytes()));
            }
        }
        for (at, logit) in motion.coefficients.iter().enumerate() {
            out.extend(nothing(at / bases, *logit).to_le_bytes());
        }
    }
    for row in 0..count {
        let unit = if factors[row] > 0.0 && whole[row] {
            127.0 / factors[row]
        } else {
            0.0
        };
        let others = colors(row).get(3..).unwrap_or_default();
        // A conversion to an integer ends at its ends.
        out.extend(
            others
                .iter()
                .map(|v| (nothing(row, *v) * unit).round() as i8 as u8),
        );
    }
    out
}

/// The quaternion at length 1; no rotation where it has none.
fn unit(quat: &[f32; 4]) -> [f64; 4] {
    let wide = quat.map(f64::from);
    let length = wide.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 1e-12 && length.is_finite() {
        wide.map(|v| v / length)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads the numbers of a section, as the page does.
    fn floats(bytes: &[u8], at: usize, count: usize) -> Vec<f32> {
        let (words, _) = bytes[at..][..4 * count].as_chunks::<4>();
        words.iter().map(|b| f32::from_le_bytes(*b)).collect()
    }

    fn halves(bytes: &[u8], at: usize, count: usize) -> Vec<f32> {
        let (words, _) = bytes[at..][..2 * count].as_chunks::<2>();
        words
            .iter()
            .map(|b| f16::from_le_bytes(*b).to_f32())
            .collect()
    }

    #[test]
    fn sections_lie_where_the_layout_says() {
        let motion = MotionArrays {
            num_frames: 2,
            num_bases: 3,
            rots: (0..36).map(|v| v as f32).collect(),
            transls: (100..118).map(|v| v as f32).collect(),
            coefficients: vec![0.5, -1.0, 2.0],
        };
        let sh: Vec<f32> = (0..2 * 12).map(|v| 0.01 * v as f32 - 0.1).collect();
        let rows = Rows {
            means: &[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            quats: &[[2.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 4.0]],
            log_scales: &[[-1.0, -2.0, -3.0], [-4.0, -5.0, -6.0]],
            opacity_logits: &[1.5, -2.5],
            sh: &sh,
        };
        let bytes = encode(&rows, 1, Some(&motion));
        assert_eq!(&bytes[..4], b"LMPD");
        let header: Vec<u32> = bytes[4..32]
            .as_chunks::<4>()
            .0
            .iter()
            .map(|b| u32::from_le_bytes(*b))
            .collect();
        assert_eq!(header, [1, 2, 1, 3, 2, 1, 0]);
        let (means, quats) = (32, 32 + 24);
        let numbers = quats + 16;
        let bases = numbers + 32;
        let logits = bases + 2 * 3 * 36;
        let others = logits + 12;
        assert_eq!(bytes.len(), others + 2 * 9);
        assert_eq!(floats(&bytes, means, 6), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        let quats: Vec<i16> = bytes[quats..numbers]
            .as_chunks::<2>()
            .0
            .iter()
            .map(|b| i16::from_le_bytes(*b))
            .collect();
        assert_eq!(quats, [32_767, 0, 0, 0, 0, 19_660, 0, 26_214]);
        let numbers = halves(&bytes, numbers, 16);
        assert_eq!(numbers[..4], [-1.0, -2.0, -3.0, 1.5]);
        // Frame 1, basis 2: rotation and translation side by side.
        assert_eq!(
            floats(&bytes, bases + 36 * 5, 9),
            [30.0, 31.0, 32.0, 33.0, 34.0, 35.0, 115.0, 116.0, 117.0]
        );
        assert_eq!(floats(&bytes, logits, 3), [0.5, -1.0, 2.0]);
        for row in 0..2 {
            let factor = numbers[8 * row + 7];
            for (k, byte) in bytes[others + 9 * row..][..9].iter().enumerate() {
                let read = f32::from(*byte as i8) * factor / 127.0;
                let wanted = sh[12 * row + 3 + k];
                assert!(
                    (read - wanted).abs() <= 0.51 * factor / 127.0 + 1e-6,
                    "row {row}, {k}: {read} for {wanted}"
                );
            }
        }
    }

    #[test]
    fn a_row_that_is_not_finite_is_not_seen_and_spoils_no_other() {
        let rows = Rows {
            means: &[[f32::NAN, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]],
            quats: &[[1.0, 0.0, 0.0, 0.0], [0.0; 4], [1.0, 0.0, 0.0, 0.0]],
            log_scales: &[[0.0; 3]; 3],
            opacity_logits: &[5.0, 5.0, f32::INFINITY],
            sh: &[0.5, 0.5, 0.5, 1e30, 0.5, -1e30, 0.5, 0.5, 0.5],
        };
        let bytes = encode(&rows, 0, None);
        assert_eq!(bytes.len(), 32 + 3 * 36);
        assert!(floats(&bytes, 32, 9).iter().all(|v| v.is_finite()));
        let numbers = halves(&bytes, 32 + 36 + 24, 24);
        assert_eq!(
            [numbers[3], numbers[11], numbers[19]],
            [f32::NEG_INFINITY, 5.0, f32::NEG_INFINITY]
        );
        assert!(numbers[12..15].iter().all(|v| v.is_finite()));
    }

    #[test]
    fn no_gaussians_are_a_header() {
        let rows = Rows {
            means: &[],
            quats: &[],
            log_scales: &[],
            opacity_logits: &[],
            sh: &[],
        };
        assert_eq!(encode(&rows, 3, None).len(), 32);
    }
}
