//! What the fuzz targets run; `tests/tests/fuzz_corpus.rs` runs the same on their corpus.

#[cfg(feature = "checkpoint")]
pub mod checkpoint;
pub mod parsers;
