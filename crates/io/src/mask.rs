//! What a picture says of each pixel as one number: masks, as those who make them store them.

use std::path::Path;

use image::DynamicImage;

use crate::notes::note;
use crate::picture::{Size, decode_upright};
use crate::{IoError, Map};

/// Reads the first channel of a PNG or JPEG, in [0, 1], turned as its EXIF data says. (Masks are often stored as three equal
/// channels.) Where the colour is the same everywhere and the alpha channel is not, the alpha channel; where instances have colours
/// of their own, 1 for all but black; and where 16 bits hold what 8 would, as those 8.
///
/// # Errors
/// [`IoError::Access`], [`IoError::Truncated`] or [`IoError::Malformed`].
pub fn read_map(path: &Path) -> Result<Map, IoError> {
    read_map_for(path, None, &mut Vec::new())
}

/// As [`read_map`], for a picture of this size: what fits it only as it is stored is not turned.
pub(crate) fn read_map_for(
    path: &Path,
    size: Option<Size>,
    notes: &mut Vec<String>,
) -> Result<Map, IoError> {
    let picture = decode_upright(path, size, notes)?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let channel = |values: &[f32], channels: usize, at: usize| {
        values.iter().skip(at).step_by(channels).copied().collect()
    };
    // Numbers, as of instances, in more bits than they need.
    if let DynamicImage::ImageLuma16(deep) = &picture
        && deep.iter().all(|value| *value <= u16::from(u8::MAX))
    {
        let values = deep.iter().map(|value| f32::from(*value) / 255.0).collect();
        return Ok(Map {
            width,
            height,
            values,
        });
    }
    let (pixels, channels) = if picture.color().has_alpha() {
        (picture.into_rgba32f().into_raw(), 4)
    } else {
        (picture.into_rgb32f().into_raw(), 3)
    };
    let values = if channels == 4 && says_alpha(&pixels) {
        note(
            notes,
            "masks have one colour everywhere: they are read from the alpha channel",
        );
        channel(&pixels, channels, 3)
    } else if is_coloured(&pixels, channels) {
        of_colours(&pixels, channels, notes)
    } else {
        channel(&pixels, channels, 0)
    };
    Ok(Map {
        width,
        height,
        values,
    })
}

/// Brings maps that belong together, the largest of whose values at their files' own size is `largest`, to [0, 1], and says how:
/// what is stored as 0 and 1 of 255 is stretched, and of small numbers (of instances, say) all above 0 counts. `None` where they
/// are as they should be, or empty.
pub(crate) fn settle<'a>(maps: impl Iterator<Item = &'a mut Map>, largest: f32) -> Option<String> {
    const ONE_STEP: f32 = 1.0 / 255.0;
    if !(0.5 * ONE_STEP..=0.5).contains(&largest) {
        return None;
    }
    let is_stretched = largest < 1.5 * ONE_STEP;
    for value in maps.flat_map(|map| &mut map.values) {
        *value = if is_stretched {
            *value / largest
        } else {
            f32::from(*value >= 0.5 * ONE_STEP)
        };
    }
    Some(if is_stretched {
        "the masks hold 0 and 1 of 255: read as 0 and 255".to_owned()
    } else {
        format!(
            "the masks' largest value is {:.0} of 255: read as numbers of instances, all above 0 moves",
            255.0 * largest
        )
    })
}

/// Whether pixels [N, C] are of several colours and not only greys, as where each instance has one of its own; a JPEG's greys are
/// not quite grey.
fn is_coloured(pixels: &[f32], channels: usize) -> bool {
    pixels.chunks_exact(channels).any(|pixel| {
        let [least, most] = range(pixel);
        most - least > 0.1
    })
}

/// A mask of such pixels: all that is not black, but for what a JPEG leaves beside an edge.
fn of_colours(pixels: &[f32], channels: usize, notes: &mut Vec<String>) -> Vec<f32> {
    note(
        notes,
        "masks are coloured: all that is not black in them moves, whichever its colour",
    );
    let pixels = pixels.chunks_exact(channels);
    pixels
        .map(|pixel| f32::from(range(pixel)[1] > 0.06))
        .collect()
}

/// Least and most of a pixel's red, green and blue.
fn range(pixel: &[f32]) -> [f32; 2] {
    let [r, g, b] = [pixel[0], pixel[1], pixel[2]];
    [r.min(g).min(b), r.max(g).max(b)]
}

/// Whether it is the alpha channel that says something, of pixels [N, 4]: it differs and the colour does not. A picture that
/// is transparent everywhere holds nothing, whatever its colour.
fn says_alpha(pixels: &[f32]) -> bool {
    let Some(first) = pixels.first_chunk::<4>() else {
        return false;
    };
    let differs = |c: usize| pixels.iter().skip(c).step_by(4).any(|&v| v != first[c]);
    let one_color = !(0..3).any(differs);
    one_color && (differs(3) || (first[3] == 0.0 && first[0] > 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_is_in_the_alpha_channel_where_only_that_differs() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let read = |pixels: [[u8; 4]; 2]| {
            let raw = pixels.concat();
            image::RgbaImage::from_raw(2, 1, raw)
                .unwrap()
                .save(&path)
                .unwrap();
            let mut notes = Vec::new();
            let map = read_map_for(&path, None, &mut notes).unwrap();
            (map.values, notes.len())
        };
        for color in [0, 255] {
            let [c, d] = [[color, color, color, 0], [color, color, color, 255]];
            assert_eq!(read([c, d]), (vec![0.0, 1.0], 1), "{color}");
        }
        let both_differ = [[0, 0, 0, 255], [255, 255, 255, 0]];
        assert_eq!(read(both_differ), (vec![0.0, 1.0], 0), "colour counts");
        assert_eq!(read([[255, 255, 255, 255]; 2]), (vec![1.0, 1.0], 0));
        assert_eq!(
            read([[255, 255, 255, 0]; 2]),
            (vec![0.0, 0.0], 1),
            "nothing is there"
        );
        assert_eq!(
            read([[0, 0, 0, 0]; 2]),
            (vec![0.0, 0.0], 0),
            "and nothing to tell"
        );
    }

    #[test]
    fn what_is_stored_as_small_numbers_is_brought_to_the_whole_range() {
        let settled = |steps: [f32; 3]| {
            let values = steps.map(|step| step / 255.0).to_vec();
            let largest = values.iter().copied().fold(0.0, f32::max);
            let mut maps = [Map {
                width: 3,
                height: 1,
                values,
            }];
            let note = settle(maps.iter_mut(), largest);
            let [map] = maps;
            (map.values, note.is_some())
        };
        assert_eq!(settled([0.0, 1.0, 0.5]), (vec![0.0, 1.0, 0.5], true));
        assert_eq!(settled([0.0, 1.0, 7.0]), (vec![0.0, 1.0, 1.0], true));
        for as_is in [[0.0, 0.0, 0.0], [0.0, 255.0, 51.0]] {
            let values = as_is.map(|step| step / 255.0).to_vec();
            assert_eq!(settled(as_is), (values, false), "{as_is:?}");
        }
    }

    #[test]
    fn masks_hold_numbers_in_16_bits_and_colours_of_instances() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let read = || {
            let mut notes = Vec::new();
            let map = read_map_for(&path, None, &mut notes).unwrap();
            (map.values, notes.concat())
        };
        let deep = |values: Vec<u16>| {
            let picture = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(3, 1, values);
            picture.unwrap().save(&path).unwrap();
        };
        deep(vec![0, 1, 3]);
        assert_eq!(read().0, [0.0, 1.0 / 255.0, 3.0 / 255.0]);
        deep(vec![0, 32_768, 65_535]);
        assert_eq!(read().0, [0.0, 32_768.0 / 65_535.0, 1.0]);

        // The first colours of the palette that segmenters use, and black.
        let colours = vec![128, 0, 0, 0, 128, 0, 0, 0, 0];
        let picture = image::RgbImage::from_raw(3, 1, colours);
        picture.unwrap().save(&path).unwrap();
        let (values, notes) = read();
        assert_eq!(values, [1.0, 1.0, 0.0]);
        assert!(notes.contains("coloured"), "{notes}");
        let grey = image::RgbImage::from_raw(3, 1, vec![9, 9, 9, 200, 200, 200, 255, 255, 255]);
        grey.unwrap().save(&path).unwrap();
        assert_eq!(read().0, [9.0, 200.0, 255.0].map(|v| v / 255.0));
    }
}
