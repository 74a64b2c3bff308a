//! Pictures: PNG and JPEG in, 8-bit PNG and JPEG out.

use std::io::{Cursor, ErrorKind};
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::metadata::Orientation;
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder as _, ImageEncoder as _, ImageError, ImageFormat,
    ImageReader,
};

use crate::bytes::{check_regular, read_file};
use crate::notes::note;
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
pub(crate) const MAX_PIXELS: u64 = 100_000_000;

/// A picture in memory as it is stored, and how its EXIF data wants it turned.
fn decode(data: &[u8], path: &Path) -> Result<(DynamicImage, Orientation), IoError> {
    let mut reader = ImageReader::new(Cursor::new(data))
        .with_guessed_format()
        .map_err(|e| IoError::access(path, e))?;
    let format = reader.format();
    if !is_whole(data, format) {
        let what = "the end of the picture is missing";
        return Err(IoError::truncated(path, what));
    }
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(8 * MAX_PIXELS);
    reader.limits(limits);

    let bad = |e| undecodable(path, e);
    let mut decoder = reader.into_decoder().map_err(bad)?;
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
    let orientation = decoder.orientation().map_err(bad)?;
    let picture = DynamicImage::from_decoder(decoder).map_err(bad)?;
    Ok((picture, orientation))
}

fn undecodable(path: &Path, error: ImageError) -> IoError {
    match error {
        ImageError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => {
            IoError::truncated(path, "the picture ends too early")
        }
        ImageError::Unsupported(_) => {
            IoError::malformed(path, "not a PNG or JPEG picture that can be read")
        }
        e => IoError::malformed(path, format!("broken picture: {e}")),
    }
}

/// Width and height, or any other two sides.
pub(crate) type Size = (usize, usize);

/// A picture, turned as its EXIF data says. What made a scene's cameras may have looked at the pixels as they are stored: where
/// these fit the `expected` size and the turned ones do not, they are left alone.
pub(crate) fn decode_upright(
    path: &Path,
    expected: Option<Size>,
    notes: &mut Vec<String>,
) -> Result<DynamicImage, IoError> {
    let (mut picture, orientation) = decode(&read_file(path)?, path)?;
    if orientation == Orientation::NoTransforms {
        return Ok(picture);
    }
    let stored = (picture.width() as usize, picture.height() as usize);
    if stays(stored, orientation, expected) {
        note(
            notes,
            "EXIF data wants pictures turned: they are not, as their cameras have the size of the stored pixels",
        );
        return Ok(picture);
    }
    note(notes, "pictures are turned as their EXIF data says");
    picture.apply_orientation(orientation);
    Ok(picture)
}

/// Whether a picture of this size fits the `expected` one as it is stored and not as its EXIF data wants it turned.
fn stays(stored: Size, orientation: Orientation, expected: Option<Size>) -> bool {
    let fit = |size| expected.map(|expected| (size == expected, has_aspect(size, expected)));
    fit(stored) > fit(turned(stored, orientation))
}

/// A size once it is turned.
fn turned((width, height): Size, orientation: Orientation) -> Size {
    match orientation {
        Orientation::Rotate90
        | Orientation::Rotate270
        | Orientation::Rotate90FlipH
        | Orientation::Rotate270FlipH => (height, width),
        Orientation::NoTransforms
        | Orientation::Rotate180
        | Orientation::FlipHorizontal
        | Orientation::FlipVertical => (width, height),
    }
}

/// Whether one size is the other made larger or smaller. A side rounded to whole pixels may be off by one.
pub(crate) fn has_aspect((width, height): Size, expected: Size) -> bool {
    let scale_x = width as f64 / expected.0 as f64;
    let scale_y = height as f64 / expected.1 as f64;
    let tolerance = 1.0 / width.min(height) as f64 + 1e-9;
    (scale_x / scale_y - 1.0).abs() <= tolerance
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

/// A picture's width and height once it is turned as its EXIF data says, from its header alone.
pub(crate) fn read_size(path: &Path) -> Result<Size, IoError> {
    read_size_for(path, None)
}

/// As [`read_size`], for a camera of this size or a multiple of it: what fits it only as it is stored is not turned.
pub(crate) fn read_size_for(path: &Path, expected: Option<Size>) -> Result<Size, IoError> {
    check_regular(path)?;
    let open = || ImageReader::open(path)?.with_guessed_format();
    let reader = open().map_err(|e| IoError::access(path, e))?;
    let bad = |e| undecodable(path, e);
    let mut decoder = reader.into_decoder().map_err(bad)?;
    let (width, height) = decoder.dimensions();
    let orientation = decoder.orientation().map_err(bad)?;
    let stored = (width as usize, height as usize);
    Ok(if stays(stored, orientation, expected) {
        stored
    } else {
        turned(stored, orientation)
    })
}

/// Reads a PNG or JPEG as sRGB in [0, 1], turned as its EXIF data says. Grey is repeated over the channels, alpha is dropped.
///
/// # Errors
/// [`IoError::Access`], [`IoError::Truncated`] or [`IoError::Malformed`].
pub fn read_image(path: &Path) -> Result<Image, IoError> {
    read_image_for(path, None, &mut Vec::new())
}

/// As [`read_image`], for a camera of this size or a multiple of it: a picture that fits it only as it is stored is not turned.
pub(crate) fn read_image_for(
    path: &Path,
    size: Option<Size>,
    notes: &mut Vec<String>,
) -> Result<Image, IoError> {
    let picture = decode_upright(path, size, notes)?.into_rgb32f();
    Ok(Image {
        width: picture.width() as usize,
        height: picture.height() as usize,
        pixels: picture.into_raw(),
    })
}

/// Reads the raw numbers of a 16-bit grey PNG, as depth sensors' files have them, for a picture of this size or a multiple of it.
pub(crate) fn read_depth_png(
    path: &Path,
    size: Size,
    notes: &mut Vec<String>,
) -> Result<Map, IoError> {
    match decode_upright(path, Some(size), notes)? {
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

/// The raw numbers of an 8-bit grey PNG in memory, as segmentations have them, and its size. `path` says in messages where it
/// is from.
pub(crate) fn parse_labels(data: &[u8], path: &Path) -> Result<(Size, Vec<u8>), IoError> {
    match decode(data, path)? {
        (DynamicImage::ImageLuma8(picture), _) => {
            let size = (picture.width() as usize, picture.height() as usize);
            Ok((size, picture.into_raw()))
        }
        (other, _) => Err(IoError::malformed(
            path,
            format!(
                "numbers of instances must be 8-bit grey, this is {:?}",
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

/// An 8-bit JPEG, rounded and clamped, of a quality from 1 to 100; `None` where `pixels` is not [H, W, 3] with at least one pixel
/// and sides that a JPEG can have.
#[must_use]
pub fn encode_jpeg(image: &Image, quality: u8) -> Option<Vec<u8>> {
    let [width, height] = [image.width, image.height].map(|side| u16::try_from(side).ok());
    let (width, height) = (width?, height?);
    if image.pixels.is_empty() || image.pixels.len() != 3 * image.width * image.height {
        return None;
    }
    let bytes: Vec<u8> = image.pixels.iter().map(|&v| to_u8(v)).collect();
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, quality)
        .write_image(&bytes, width.into(), height.into(), ExtendedColorType::Rgb8)
        .ok()?;
    Some(jpeg)
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
    use crate::mask::{read_map, read_map_for};

    #[test]
    fn a_jpeg_comes_back_nearly_as_it_was_and_no_picture_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        let ramp = |i: usize| (i / 3 % 16) as f32 / 15.0;
        let image = Image {
            width: 16,
            height: 8,
            pixels: (0..3 * 16 * 8).map(ramp).collect(),
        };
        std::fs::write(&path, encode_jpeg(&image, 95).unwrap()).unwrap();
        let back = read_image(&path).unwrap();
        assert_eq!((back.width, back.height), (16, 8));
        for (a, b) in back.pixels.iter().zip(&image.pixels) {
            assert!((a - b).abs() < 0.03, "{a} for {b}");
        }
        for (width, height) in [(0, 8), (16, 7), (70_000, 0)] {
            let odd = Image {
                width,
                height,
                pixels: image.pixels.clone(),
            };
            assert!(encode_jpeg(&odd, 95).is_none(), "{width} x {height}");
        }
    }

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

    /// A picture [2, 4] of greys 0 to 7 that EXIF wants turned by this, as PNG or JPEG by the path's ending.
    fn with_exif(path: &Path, orientation: Orientation) {
        // TIFF: little-endian, the directory at 8, one entry: tag 0x112 of one 16-bit number.
        let mut exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
        exif.extend([orientation.to_exif(), 0, 0, 0, 0, 0, 0, 0]);
        let mut data = Vec::new();
        let greys = [0, 1, 2, 3, 4, 5, 6, 7];
        if path.extension().is_some_and(|ending| ending == "jpg") {
            let mut jpeg = JpegEncoder::new(&mut data);
            jpeg.set_exif_metadata(exif).unwrap();
            jpeg.write_image(&greys, 4, 2, ExtendedColorType::L8)
        } else {
            let mut png = PngEncoder::new(&mut data);
            png.set_exif_metadata(exif).unwrap();
            png.write_image(&greys, 4, 2, ExtendedColorType::L8)
        }
        .unwrap();
        std::fs::write(path, data).unwrap();
    }

    #[test]
    fn pictures_are_turned_unless_their_camera_says_otherwise() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        // The size, the grey at the top left, and whether the note says that pictures are turned.
        let read = |expected: Option<Size>| {
            let mut notes = Vec::new();
            let map = read_map_for(&path, expected, &mut notes).unwrap();
            assert_eq!(notes.len(), 1, "{notes:?}");
            let corner = (255.0 * map.values[0]).round() as u8;
            let turned = notes[0].contains("are turned");
            ((map.width, map.height), corner, turned)
        };
        let stored = ((4, 2), 0, false);
        with_exif(&path, Orientation::Rotate90);
        assert_eq!(read_size(&path).unwrap(), (2, 4));
        for expected in [None, Some((2, 4)), Some((100, 200)), Some((7, 7))] {
            assert_eq!(read(expected), ((2, 4), 4, true), "{expected:?}");
        }
        for expected in [(200, 100), (4, 2)] {
            assert_eq!(read(Some(expected)), stored);
            assert_eq!(read_size_for(&path, Some(expected)).unwrap(), (4, 2));
        }
        with_exif(&path, Orientation::Rotate270);
        assert_eq!(read(None), ((2, 4), 3, true));
        with_exif(&path, Orientation::Rotate180);
        assert_eq!(read_size(&path).unwrap(), (4, 2));
        assert_eq!(read(Some((4, 2))), ((4, 2), 7, true), "both fit");
        let picture = read_image(&path).unwrap();
        assert_eq!((255.0 * picture.pixels[0]).round(), 7.0);

        let jpeg = folder.path().join("a.jpg");
        with_exif(&jpeg, Orientation::Rotate90);
        assert_eq!(read_size(&jpeg).unwrap(), (2, 4));
        let picture = read_image(&jpeg).unwrap();
        assert_eq!((picture.width, picture.height), (2, 4));

        with_exif(&path, Orientation::NoTransforms);
        let mut notes = Vec::new();
        read_map_for(&path, Some((2, 4)), &mut notes).unwrap();
        assert!(notes.is_empty(), "{notes:?}");
    }
}
