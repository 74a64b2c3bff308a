//! Hashes that stand for what something depends on.

use sha2::{Digest as _, Sha256};
use std::fmt::Write as _;

/// SHA-256 of texts in their order.
pub(crate) fn hashed<'a>(parts: impl IntoIterator<Item = &'a str>) -> [u8; 32] {
    let mut hash = Sha256::new();
    for part in parts {
        // With their lengths, so that no two lists of parts run into the same bytes.
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    }
    hash.finalize().into()
}

/// A short name for a file that is known by what it holds.
pub(crate) fn name_of(text: &str) -> String {
    hex(&hashed([text])[..4])
}

/// Bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("a string takes text");
        text
    })
}
