//! Arrays: `.npy` files and the entries of `.npz` archives.

use std::collections::BTreeMap;
use std::path::Path;

use npyz::{DType, NpyFile, NpyHeader, Order, TypeChar};

use crate::IoError;
use crate::archive::for_each_entry;
use crate::bytes::read_file;

/// An array as f32, row-major.
#[derive(Debug)]
pub(crate) struct Array {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Vec<f32>,
}

/// Reads a `.npy` file of bool or any integer or float type of up to 64 bits, in either byte order, in C
/// or Fortran order.
pub(crate) fn read_npy(path: &Path) -> Result<Array, IoError> {
    parse_npy(&read_file(path)?, path, "the array")
}

/// Parses a whole `.npy` file; `what` names the array in messages.
pub(crate) fn parse_npy(data: &[u8], path: &Path, what: &str) -> Result<Array, IoError> {
    check_header(data, path, what)?;
    let malformed = |e: std::io::Error| IoError::malformed(path, format!("{what}: {e}"));
    let mut rest = data;
    let header = NpyHeader::from_reader(&mut rest).map_err(malformed)?;

    let DType::Plain(kind) = header.dtype() else {
        return Err(IoError::malformed(path, format!("{what} holds records")));
    };
    let item_bytes = kind.num_bytes().unwrap_or(0);
    let mut shape = Vec::new();
    let mut needed = Some(item_bytes);
    for &side in header.shape() {
        let side = usize::try_from(side).ok();
        needed = needed.zip(side).and_then(|(n, s)| n.checked_mul(s));
        shape.extend(side);
    }
    if needed.is_none_or(|needed| needed > rest.len()) {
        let have = rest.len();
        let shape = header.shape();
        let what = format!("{what} promises {shape:?} of {kind}, {have} bytes are there");
        return Err(IoError::truncated(path, what));
    }

    let (order, strides) = (header.order(), header.strides().to_vec());
    let file = NpyFile::with_header(header, rest);
    let values = match (kind.type_char(), item_bytes) {
        (TypeChar::Float, 2) => convert(file, half::f16::to_f32),
        (TypeChar::Float, 4) => convert(file, |v: f32| v),
        (TypeChar::Float, 8) => convert(file, |v: f64| v as f32),
        (TypeChar::Bool, 1) => convert(file, |v: bool| f32::from(u8::from(v))),
        (TypeChar::Uint, 1) => convert(file, |v: u8| f32::from(v)),
        (TypeChar::Uint, 2) => convert(file, |v: u16| f32::from(v)),
        (TypeChar::Uint, 4) => convert(file, |v: u32| v as f32),
        (TypeChar::Uint, 8) => convert(file, |v: u64| v as f32),
        (TypeChar::Int, 1) => convert(file, |v: i8| f32::from(v)),
        (TypeChar::Int, 2) => convert(file, |v: i16| f32::from(v)),
        (TypeChar::Int, 4) => convert(file, |v: i32| v as f32),
        (TypeChar::Int, 8) => convert(file, |v: i64| v as f32),
        _ => {
            return Err(IoError::malformed(
                path,
                format!("{what} has type {kind}; real numbers are expected"),
            ));
        }
    }
    .map_err(malformed)?;
    let values = match order {
        Order::C => values,
        Order::Fortran => to_row_major(&values, &shape, &strides),
    };
    Ok(Array { shape, values })
}

/// Refuses headers that would make the parser allocate, recurse, backtrack or multiply beyond reason: an
/// array of plain numbers has one dictionary and in it one shape, written without escapes.
fn check_header(data: &[u8], path: &Path, what: &str) -> Result<(), IoError> {
    const MAX_HEADER: usize = 1 << 16;
    if data.len() < 12 || &data[..6] != b"\x93NUMPY" {
        return Err(IoError::malformed(
            path,
            format!("{what} is not in npy format"),
        ));
    }
    let (start, length) = if data[6] == 1 {
        (10, usize::from(u16::from_le_bytes([data[8], data[9]])))
    } else {
        let length = u32::from_le_bytes([data[8], data[9], data[10], data[11]]);
        (12, length as usize)
    };
    if length > MAX_HEADER || start + length > data.len() {
        return Err(IoError::truncated(
            path,
            format!("{what} promises a header of {length} bytes"),
        ));
    }
    let text = String::from_utf8_lossy(&data[start..start + length]);
    let count = |pattern: &str| text.matches(pattern).count();
    if count("[") > 0 {
        return Err(IoError::malformed(
            path,
            format!("{what} does not hold plain numbers"),
        ));
    }
    let plain = count("{") == 1 && count("(") == 1 && count("shape") == 1 && count("\\") == 0;
    let shape = text
        .split_once("shape")
        .and_then(|(_, rest)| rest.split_once('('))
        .and_then(|(_, rest)| rest.split_once(')'));
    let elements = shape.and_then(|(sides, _)| {
        sides
            .split(',')
            .map(str::trim)
            .filter(|side| !side.is_empty())
            .try_fold(1u64, |n, side| {
                n.checked_mul(side.parse::<u64>().ok()?.max(1))
            })
    });
    if !plain || elements.is_none() {
        return Err(IoError::malformed(
            path,
            format!("{what} has no usable npy header"),
        ));
    }
    Ok(())
}

fn convert<T: npyz::Deserialize>(
    file: NpyFile<&[u8]>,
    to_f32: impl Fn(T) -> f32,
) -> std::io::Result<Vec<f32>> {
    let values = file
        .data::<T>()
        .map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidData, e.to_string()))?;
    values.map(|v| v.map(&to_f32)).collect()
}

/// Reorders values that are stored with `strides` (in elements).
fn to_row_major(values: &[f32], shape: &[usize], strides: &[u64]) -> Vec<f32> {
    (0..values.len())
        .map(|flat| {
            let (mut rest, mut at) = (flat, 0);
            for (&side, &stride) in shape.iter().zip(strides).rev() {
                at += rest % side * stride as usize;
                rest /= side;
            }
            values[at]
        })
        .collect()
}

/// Reads every array of an `.npz` archive, by entry name without `.npy`.
pub(crate) fn read_npz(path: &Path) -> Result<BTreeMap<String, Array>, IoError> {
    let mut arrays = BTreeMap::new();
    for_each_entry(path, ".npy", |name, bytes| {
        let array = parse_npy(&bytes, path, &format!("entry {name}"))?;
        match arrays.insert(name.to_owned(), array) {
            None => Ok(()),
            Some(_) => {
                let what = format!("entry {name} is there twice");
                Err(IoError::malformed(path, what))
            }
        }
    })?;
    Ok(arrays)
}

#[cfg(test)]
mod tests {
    use super::*;
    use npyz::WriterBuilder as _;

    fn npy<T: npyz::AutoSerialize + Copy>(values: &[T], shape: &[u64], order: Order) -> Vec<u8> {
        let mut bytes = Vec::new();
        let options = npyz::WriteOptions::new().default_dtype().order(order);
        let mut writer = options.shape(shape).writer(&mut bytes).begin_nd().unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
        bytes
    }

    fn parse(data: &[u8]) -> Result<Array, IoError> {
        parse_npy(data, Path::new("a.npy"), "the array")
    }

    /// A file of version 1 with this header.
    fn with_header(header: &str) -> Vec<u8> {
        let mut data = b"\x93NUMPY\x01\x00".to_vec();
        data.extend((header.len() as u16).to_le_bytes());
        data.extend(header.as_bytes());
        data
    }

    #[test]
    fn an_archive_with_a_damaged_byte_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npz");
        let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        // As numpy's `savez` packs it: not at all.
        let options = zip::write::FileOptions::default();
        let options = options.compression_method(zip::CompressionMethod::Stored);
        archive.start_file("a.npy", options).unwrap();
        let array = npy(&[1.0f32, 2.0, 3.0], &[3], Order::C);
        std::io::Write::write_all(&mut archive, &array).unwrap();
        archive.finish().unwrap();
        assert_eq!(read_npz(&path).unwrap()["a"].values, [1.0, 2.0, 3.0]);

        let mut data = std::fs::read(&path).unwrap();
        let two = 2.0f32.to_le_bytes();
        let at = data.windows(4).position(|bytes| bytes == two).unwrap();
        data[at + 2] ^= 1;
        std::fs::write(&path, data).unwrap();
        let said = read_npz(&path).unwrap_err().to_string();
        assert!(
            said.contains("checksum") && said.contains("entry a"),
            "{said}"
        );
    }

    #[test]
    fn reads_both_orders_of_axes() {
        let want = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
        let c = parse(&npy(&want, &[2, 3], Order::C)).unwrap();
        assert_eq!(
            (c.shape.as_slice(), c.values.as_slice()),
            (&[2, 3][..], &want[..])
        );
        let fortran = npy(&[0.0f32, 3.0, 1.0, 4.0, 2.0, 5.0], &[2, 3], Order::Fortran);
        assert_eq!(parse(&fortran).unwrap().values, want);
        let empty = parse(&npy::<f32>(&[], &[0, 4], Order::C)).unwrap();
        assert_eq!(empty.shape, [0, 4]);
    }

    #[test]
    fn reads_every_number_type_in_both_byte_orders() {
        let bytes = |values: [f32; 3], big_endian: &dyn Fn(f32) -> Vec<u8>| values.map(big_endian);
        let (signed, unsigned) = ([-2.0, 0.0, 100.0], [2.0, 0.0, 100.0]);
        for (kind, want, rows) in [
            ("b1", [1.0, 0.0, 1.0], [vec![1], vec![0], vec![1]]),
            (
                "i1",
                signed,
                bytes(signed, &|v| (v as i8).to_be_bytes().into()),
            ),
            (
                "i2",
                signed,
                bytes(signed, &|v| (v as i16).to_be_bytes().into()),
            ),
            (
                "i4",
                signed,
                bytes(signed, &|v| (v as i32).to_be_bytes().into()),
            ),
            (
                "i8",
                signed,
                bytes(signed, &|v| (v as i64).to_be_bytes().into()),
            ),
            (
                "u1",
                unsigned,
                bytes(unsigned, &|v| (v as u8).to_be_bytes().into()),
            ),
            (
                "u2",
                unsigned,
                bytes(unsigned, &|v| (v as u16).to_be_bytes().into()),
            ),
            (
                "u4",
                unsigned,
                bytes(unsigned, &|v| (v as u32).to_be_bytes().into()),
            ),
            (
                "u8",
                unsigned,
                bytes(unsigned, &|v| (v as u64).to_be_bytes().into()),
            ),
            (
                "f2",
                signed,
                bytes(signed, &|v| half::f16::from_f32(v).to_be_bytes().into()),
            ),
            ("f4", signed, bytes(signed, &|v| v.to_be_bytes().into())),
            (
                "f8",
                signed,
                bytes(signed, &|v| f64::from(v).to_be_bytes().into()),
            ),
        ] {
            for order in [">", "<"] {
                // What has one byte has no order.
                let order = if rows[0].len() == 1 { "|" } else { order };
                let mut data = with_header(&format!(
                    "{{'descr': '{order}{kind}', 'fortran_order': False, 'shape': (3,), }}\n"
                ));
                for row in &rows {
                    let mut row = row.clone();
                    if order == "<" {
                        row.reverse();
                    }
                    data.extend(row);
                }
                let read = parse(&data).unwrap_or_else(|e| panic!("{order}{kind}: {e}"));
                assert_eq!(read.values, want, "{order}{kind}");
            }
        }
        let largest = parse(&npy(&[u64::MAX], &[1], Order::C)).unwrap();
        assert_eq!(largest.values, [2f32.powi(64)]);
    }

    #[test]
    fn every_cut_is_an_error() {
        let data = npy(&[1.0f32; 24], &[4, 6], Order::C);
        for length in 0..data.len() {
            assert!(parse(&data[..length]).is_err(), "cut at {length}");
        }
    }

    #[test]
    fn absurd_headers_are_errors() {
        let dict = |shape: &str, descr: &str| {
            with_header(&format!(
                "{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"
            ))
        };
        for (name, data) in [
            ("huge", dict("(1000000000, 1000000)", "'<f4'")),
            (
                "overflowing",
                dict("(4294967296, 4294967296, 4294967296)", "'<f4'"),
            ),
            (
                "overflowing beside a zero",
                dict("(0, 9223372036854775807, 9223372036854775807)", "'<f4'"),
            ),
            (
                "overflowing, after another shape",
                with_header(
                    "{'old_shape': (1,), 'descr': '<f4', 'fortran_order': False, \
                     'shape': (4294967296, 4294967296, 4)}",
                ),
            ),
            (
                "overflowing, escaped",
                with_header(
                    "{'old_shape': (1,), 'descr': '<f4', 'fortran_order': False, \
                     'sh\\x61pe': [4294967296, 4294967296, 4]}",
                ),
            ),
            ("negative", dict("(-4, 4)", "'<f4'")),
            ("pickled", dict("(1,)", "'|O'")),
            ("a record", dict("(1,)", "[('a', '<f4')]")),
            ("text", dict("(1,)", "'<U4'")),
            (
                "nested",
                with_header(&format!("{}'shape': (1,)", "[".repeat(60_000))),
            ),
            // Time doubles with each bracket: it may be a set or a dictionary.
            (
                "backtracking",
                with_header(&format!(
                    "{}'{}', 'shape': (1,)",
                    "{".repeat(15),
                    "a".repeat(60_000)
                )),
            ),
            ("long header", {
                let mut data = b"\x93NUMPY\x02\x00".to_vec();
                data.extend(u32::MAX.to_le_bytes());
                data
            }),
        ] {
            assert!(parse(&data).is_err(), "{name}");
        }
    }
}
