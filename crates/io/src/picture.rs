//! Pictures: PNG and JPEG in, 8-bit PNG out.

use std::io::Cursor;
use std::path::Path;

use image::codecs::png::PngEncoder;
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder as _, ImageEncoder as _, ImageFormat, ImageReader,
};

use crate::bytes::{check_regular, read_file};
use crate::{IoError, write_atomic};

/// A colour picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// sRGB in [0, 1], [H, W, 3] row-major.
    pub pixels: Vec<f32>,
}

/// One number per pixel: a depth, a mask.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// [H, W] row-major.
    pub values: Vec<f32>,
}

/// Deflate and JPEG cannot pack better than about 1:1032. A header that claims more is wrong, and is
/// refused before its pixels are allocated.
pub(crate) const MAX_PACKING: u64 = 1100;

/// No picture of a video comes near (8K has 33 million); larger ones are refused before they are allocated.
const MAX_PIXELS: u64 = 100_000_000;

fn decode(path: &Path) -> Result<DynamicImage, IoError> {
    let data = read_file(path)?;
    let mut reader = ImageReader::new(Cursor::new(&data))
        .with_guessed_format()
        .map_err(|e| IoError::access(path, e))?;
    let format = reader.format();
    if !is_whole(&data, format) {
        let what = "the end of the picture is missing";
        return Err(IoError::truncated(path, what));
    }
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(8 * MAX_PIXELS);
    reader.limits(limits);

    let bad = |e: image::ImageError| match e {
        image::ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            IoError::truncated(path, "the picture ends too early")
        }
        image::ImageError::Unsupported(_) => {
            IoError::malformed(path, "not a PNG or JPEG picture that can be read")
        }
        e => IoError::malformed(path, format!("broken picture: {e}")),
    };
    let decoder = reader.into_decoder().map_err(bad)?;
    let (width, height) = decoder.dimensions();
    let pixels = u64::from(width) * u64::from(height);
    // A pixel takes a bit or more before it is packed.
    if pixels > MAX_PIXELS || pixels / 8 > MAX_PACKING * data.len() as u64 + 4096 {
        return Err(IoError::truncated(
            path,
            format!("promises {width}x{height} pixels in {} bytes", data.len()),
        ));
    }
    if width == 0 || height == 0 {
        return Err(IoError::malformed(path, "the picture has no pixels"));
    }
    DynamicImage::from_decoder(decoder).map_err(bad)
}

/// Whether the picture's end marker is there. The decoders forgive a missing end: they fill in grey.
fn is_whole(data: &[u8], format: Option<ImageFormat>) -> bool {
    let last = |marker: &[u8]| data.windows(marker.len()).rposition(|w| w == marker);
    match format {
        Some(ImageFormat::Png) => last(b"IEND\xae\x42\x60\x82").is_some(),
        // The end marker must follow the last scan: an embedded thumbnail has an end of its own.
        Some(ImageFormat::Jpeg) => last(&[0xff, 0xd9]) > last(&[0xff, 0xda]),
        _ => true,
    }
}

/// A picture's width and height, from its header alone.
pub(crate) fn read_size(path: &Path) -> Result<(usize, usize), IoError> {
    check_regular(path)?;
    let (width, height) = image::image_dimensions(path)
        .map_err(|e| IoError::malformed(path, format!("not a picture that can be read: {e}")))?;
    Ok((width as usize, height as usize))
}

/// Reads a PNG or JPEG as sRGB in [0, 1]. Grey is repeated over the channels, alpha is dropped.
///
/// # Errors
/// [`IoError::Access`], [`IoError::Truncated`] or [`IoError::Malformed`].
pub fn read_image(path: &Path) -> Result<Image, IoError> {
    let picture = decode(path)?.into_rgb32f();
    Ok(Image {
        width: picture.width() as usize,
        height: picture.height() as usize,
        pixels: picture.into_raw(),
    })
}

/// Reads the first channel of a PNG or JPEG, in [0, 1]. (Masks are often stored as three equal channels.)
///
/// # Errors
/// [`IoError::Access`], [`IoError::Truncated`] or [`IoError::Malformed`].
pub fn read_map(path: &Path) -> Result<Map, IoError> {
    let picture = decode(path)?.into_rgb32f();
    Ok(Map {
        width: picture.width() as usize,
        height: picture.height() as usize,
        values: picture.as_raw().iter().step_by(3).copied().collect(),
    })
}

/// Reads the raw numbers of a 16-bit grey PNG, as depth sensors' files have them.
pub(crate) fn read_depth_png(path: &Path) -> Result<Map, IoError> {
    match decode(path)? {
        DynamicImage::ImageLuma16(picture) => Ok(Map {
            width: picture.width() as usize,
            height: picture.height() as usize,
            values: picture.as_raw().iter().map(|&v| f32::from(v)).collect(),
        }),
        other => Err(IoError::malformed(
            path,
            format!(
                "a depth PNG must be 16-bit grey, this is {:?}",
                other.color()
            ),
        )),
    }
}

/// A number in [0, 1] as 8 bits, rounded; what is outside is clamped, not a number becomes 0.
fn to_u8(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Writes an 8-bit RGB PNG, rounded and clamped, atomically (see [`write_atomic`]).
///
/// # Errors
/// [`IoError::Invalid`] when `pixels` is not [H, W, 3] with at least one pixel; [`IoError::Access`].
pub fn write_png(path: &Path, image: &Image) -> Result<(), IoError> {
    let size = (image.width, image.height);
    write_pixels(path, size, &image.pixels, ExtendedColorType::Rgb8)
}

/// Writes an 8-bit grey PNG of values in [0, 1], rounded and clamped, atomically (see [`write_atomic`]).
///
/// # Errors
/// [`IoError::Invalid`] when `values` is not [H, W] with at least one pixel; [`IoError::Access`].
pub fn write_map_png(path: &Path, map: &Map) -> Result<(), IoError> {
    let size = (map.width, map.height);
    write_pixels(path, size, &map.values, ExtendedColorType::L8)
}

fn write_pixels(
    path: &Path,
    (width, height): (usize, usize),
    values: &[f32],
    color: ExtendedColorType,
) -> Result<(), IoError> {
    let channels = usize::from(color.channel_count());
    let (Ok(w), Ok(h)) = (u32::try_from(width), u32::try_from(height)) else {
        return Err(IoError::invalid(path, "the picture is too large for a PNG"));
    };
    if width == 0 || height == 0 || values.len() != width * height * channels {
        let found = values.len();
        let what = format!("{found} values are no picture [{height}, {width}, {channels}]");
        return Err(IoError::invalid(path, what));
    }
    let bytes: Vec<u8> = values.iter().map(|&v| to_u8(v)).collect();
    let mut png = Vec::new();
    PngEncoder::new(&mut png)
        .write_image(&bytes, w, h, color)
        .map_err(|e| IoError::invalid(path, format!("cannot be written as PNG: {e}")))?;
    write_atomic(path, |out| out.write_all(&png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_pictures_come_back_rounded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let image = Image {
            width: 2,
            height: 1,
            pixels: vec![0.0, 1.0, 100.4 / 255.0, 100.6 / 255.0, -0.3, 1.7],
        };
        write_png(&path, &image).unwrap();
        let want = [0.0, 255.0, 100.0, 101.0, 0.0, 255.0].map(|v| v / 255.0);
        assert_eq!(read_image(&path).unwrap().pixels, want);

        let map = Map {
            width: 1,
            height: 2,
            values: vec![0.5, f32::NAN],
        };
        write_map_png(&path, &map).unwrap();
        assert_eq!(read_map(&path).unwrap().values, [128.0 / 255.0, 0.0]);
    }

    #[test]
    fn pictures_without_their_pixels_are_not_written() {
        let image = Image {
            width: 2,
            height: 2,
            pixels: vec![0.0; 6],
        };
        let path = Path::new("never-written.png");
        assert!(matches!(
            write_png(path, &image),
            Err(IoError::Invalid { .. })
        ));
        assert!(!path.exists());
    }

    #[test]
    fn any_8_or_16_bit_kind_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let half = u16::MAX / 2;
        image::ImageBuffer::from_pixel(1, 1, image::Rgb([u16::MAX, half, 0]))
            .save(&path)
            .unwrap();
        let want = [1.0, f32::from(half) / 65535.0, 0.0];
        assert_eq!(read_image(&path).unwrap().pixels, want);
        image::RgbaImage::from_pixel(1, 1, image::Rgba([255, 51, 0, 7]))
            .save(&path)
            .unwrap();
        assert_eq!(
            read_image(&path).unwrap().pixels,
            [1.0, 0.2, 0.0],
            "alpha is dropped"
        );
        assert_eq!(read_map(&path).unwrap().values, [1.0], "the first channel");
    }
}
