//! Zip archives, entry by entry.

use std::io::{Cursor, Read as _};
use std::path::Path;

use zip::ZipArchive;
use zip::result::ZipError;

use crate::IoError;
use crate::bytes::read_file;
use crate::picture::MAX_PACKING;

/// Hands every entry whose name ends with `ending` to `take`, by its name without that, one at a time and
/// in the archive's order.
pub(crate) fn for_each_entry(
    path: &Path,
    ending: &str,
    mut take: impl FnMut(&str, Vec<u8>) -> Result<(), IoError>,
) -> Result<(), IoError> {
    let data = read_file(path)?;
    let archive_bytes = data.len() as u64;
    let malformed = |e: ZipError| IoError::malformed(path, format!("not a zip archive: {e}"));
    let mut zip = ZipArchive::new(Cursor::new(&data)).map_err(malformed)?;

    let mut packed_total = 0u64;
    for index in 0..zip.len() {
        let entry = zip.by_index(index).map_err(malformed)?;
        let Some(name) = entry.name().strip_suffix(ending).map(String::from) else {
            continue;
        };
        // Sizes in an archive's directory are promises too; overlapping entries would make a small
        // file unpack to anything.
        let (packed, size) = (entry.compressed_size(), entry.size());
        packed_total = packed_total.saturating_add(packed);
        if packed_total > archive_bytes || size > packed.saturating_mul(MAX_PACKING) {
            return Err(IoError::truncated(
                path,
                format!("entry {name} promises {size} bytes, packed into {packed}"),
            ));
        }
        let mut bytes = Vec::new();
        // To the end and not up to its size: checksums are compared there.
        entry
            .take(size.saturating_add(1))
            .read_to_end(&mut bytes)
            .map_err(|e| IoError::malformed(path, format!("entry {name}: {e}")))?;
        if bytes.len() as u64 != size {
            return Err(IoError::malformed(
                path,
                format!("entry {name} is not of the {size} bytes that it promises"),
            ));
        }
        take(&name, bytes)?;
    }
    Ok(())
}
