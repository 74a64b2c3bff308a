//! Depth as OpenEXR holds it: one channel `Z` in rows, plain or packed by zlib.

use std::io::Cursor;
use std::path::Path;

use exr::block::UncompressedBlock;
use exr::compression::Compression;
use exr::error::Error;
use exr::math::Vec2;
use exr::meta::BlockDescription;
use exr::meta::attribute::SampleType;
use exr::meta::header::Header;
use half::f16;

use crate::picture::{MAX_PACKING, MAX_PIXELS};
use crate::{IoError, Map};

/// Reads a file in memory; `path` says in messages where it is from.
pub(crate) fn parse_depth_exr(data: &[u8], path: &Path) -> Result<Map, IoError> {
    let bad = |error: Error| match error {
        Error::Io(_) => IoError::truncated(path, "the EXR ends too early"),
        error => IoError::malformed(path, format!("broken EXR: {error}")),
    };
    let reader = exr::block::read(Cursor::new(data), true).map_err(bad)?;
    let [header] = reader.headers() else {
        return Err(IoError::malformed(path, "the EXR has several parts"));
    };
    let is_half = depth_is_half(header).ok_or_else(|| {
        let what = "this EXR is not of the kind that is read: one channel Z of 16 or 32-bit floats in rows, \
                    plain, ZIP or ZIPS";
        IoError::malformed(path, what)
    })?;
    let Vec2(width, height) = header.layer_size;
    let bytes: usize = if is_half { 2 } else { 4 };
    // Nothing was allocated by these sizes so far.
    let pixels = (width as u64).saturating_mul(height as u64);
    if pixels > MAX_PIXELS || pixels * bytes as u64 > MAX_PACKING * data.len() as u64 {
        let what = format!("promises {width}x{height} pixels in {} bytes", data.len());
        return Err(IoError::truncated(path, what));
    }
    if pixels == 0 {
        return Err(IoError::malformed(path, "the EXR has no pixels"));
    }

    let mut values = Vec::new();
    let meta = reader.meta_data().clone();
    for chunk in reader.all_chunks(true).map_err(bad)? {
        let block = UncompressedBlock::decompress_chunk(chunk.map_err(bad)?, &meta, true);
        let UncompressedBlock { index, data } = block.map_err(bad)?;
        let whole = index.pixel_size.0 == width && data.len() == index.pixel_size.area() * bytes;
        if !whole || index.pixel_position != Vec2(0, values.len() / width) {
            return Err(IoError::malformed(path, "the EXR's rows are in disorder"));
        }
        if is_half {
            let (numbers, _) = data.as_chunks();
            values.extend(numbers.iter().map(|&v| f16::from_ne_bytes(v).to_f32()));
        } else {
            let (numbers, _) = data.as_chunks();
            values.extend(numbers.iter().map(|&v| f32::from_ne_bytes(v)));
        }
    }
    if values.len() != width * height {
        return Err(IoError::truncated(path, "rows of the EXR are missing"));
    }
    Ok(Map {
        width,
        height,
        values,
    })
}

/// Whether the depth's numbers have 16 bits (true) or 32; None where the file is not of the kind that is
/// read.
fn depth_is_half(header: &Header) -> Option<bool> {
    let [channel] = &header.channels.list[..] else {
        return None;
    };
    let is_half = match channel.sample_type {
        SampleType::F16 => true,
        SampleType::F32 => false,
        SampleType::U32 => return None,
    };
    let packings = [
        Compression::Uncompressed,
        Compression::ZIP1,
        Compression::ZIP16,
    ];
    let readable = !header.deep
        && header.blocks == BlockDescription::ScanLines
        && packings.contains(&header.compression)
        && channel.name.eq("Z")
        && channel.sampling == Vec2(1, 1);
    readable.then_some(is_half)
}
