//! The positional encoding p(x) of a pixel.

use std::f64::consts::TAU;

/// Channels of the positional encoding: sine and cosine of four frequencies on two axes.
pub const ENCODING_CHANNELS: usize = 16;

/// Cycles over the image of the four frequencies. (The reference code's frequencies, 10^-j, do not
/// vary over an image beyond the first; the paper wants high-frequency detail.)
const CYCLES: [f64; 4] = [1.0, 2.0, 4.0, 8.0];

/// Positional encoding p(x) of the pixel centres along one axis of `length` pixels: first the four
/// sines, then the four cosines, by rising frequency 2^0 to 2^3 cycles over the image. A pixel has that
/// of its column, then that of its row.
pub(crate) fn axis_encoding(length: usize) -> Vec<[f32; ENCODING_CHANNELS / 2]> {
    (0..length)
        .map(|i| {
            let position = (i as f64 + 0.5) / length as f64;
            std::array::from_fn(|channel| {
                let angle = TAU * CYCLES[channel % CYCLES.len()] * position;
                let value = if channel < CYCLES.len() {
                    angle.sin()
                } else {
                    angle.cos()
                };
                value as f32
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_encoding_turns_once_to_eight_times_over_the_axis() {
        let axis = axis_encoding(8);
        for (i, value) in axis.iter().enumerate() {
            for (j, cycles) in [1.0, 2.0, 4.0, 8.0].into_iter().enumerate() {
                let angle = TAU * cycles * (i as f64 + 0.5) / 8.0;
                assert!((f64::from(value[j]) - angle.sin()).abs() < 1e-7);
                assert!((f64::from(value[4 + j]) - angle.cos()).abs() < 1e-7);
            }
        }
        // The middle of the axis is half a turn of the lowest frequency away from its start.
        assert!((axis[0][4] + axis[4][4]).abs() < 1e-6);
    }

    #[test]
    fn one_pixel_sits_in_the_middle() {
        let [value] = axis_encoding(1)[..] else {
            panic!("one pixel, one row")
        };
        let expected = [0.0, 0.0, 0.0, 0.0, -1.0, 1.0, 1.0, 1.0];
        for (value, expected) in value.into_iter().zip(expected) {
            assert!((f64::from(value) - expected).abs() < 1e-6);
        }
    }
}
