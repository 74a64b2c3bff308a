//! Checksums (CRC-32): of a checkpoint, whole, and of the numbers that a run learns from.

use bytemuck::NoUninit;
use crc32fast::Hasher;
use std::ops::Range;

/// What stands in a checkpoint's header where its checksum will be: eight digits.
pub(crate) const OPEN: &str = "00000000";

/// What comes before the checksum. The header is JSON within JSON, where no text inside can look like this.
const BEFORE: &[u8] = br#"\"checksum\":\""#;

/// The checksum of numbers.
pub(crate) fn of_numbers<T: NoUninit>(values: &[T]) -> u32 {
    crc32fast::hash(bytemuck::cast_slice(values))
}

/// Puts its checksum into a checkpoint.
///
/// # Panics
/// Panics if there is no place for it.
pub(crate) fn seal(bytes: &mut [u8]) {
    let digits = place(bytes).expect("the header has a place for the checksum");
    let sum = of(bytes, &digits);
    bytes[digits].copy_from_slice(sum.as_bytes());
}

/// Whether every byte of a checkpoint is as it was sealed.
pub(crate) fn holds(bytes: &[u8]) -> bool {
    place(bytes).is_some_and(|digits| of(bytes, &digits).as_bytes() == &bytes[digits])
}

/// Of all bytes, the checksum's own as if it were open.
fn of(bytes: &[u8], digits: &Range<usize>) -> String {
    let mut hasher = Hasher::new();
    hasher.update(&bytes[..digits.start]);
    hasher.update(OPEN.as_bytes());
    hasher.update(&bytes[digits.end..]);
    format!("{:08x}", hasher.finalize())
}

/// Where the checksum stands; its header begins with its length.
fn place(bytes: &[u8]) -> Option<Range<usize>> {
    let (length, rest) = bytes.split_first_chunk::<8>()?;
    let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
    let header = rest.get(..length)?;
    let at = header.windows(BEFORE.len()).position(|w| w == BEFORE)?;
    let start = 8 + at + BEFORE.len();
    (start + OPEN.len() <= 8 + length).then(|| start..start + OPEN.len())
}
