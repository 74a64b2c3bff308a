//! What is written for others, read back by readers that are not ours to write with: small ones here, which follow the formats'
//! specifications, and the loader of data sets for cameras.
#![expect(
    clippy::unwrap_used,
    reason = "a test that cannot make its input has failed"
)]
#![expect(
    clippy::missing_assert_message,
    reason = "a reader's assertions are the specification's words"
)]

mod cameras;
mod glb;
mod made;
mod spz;
