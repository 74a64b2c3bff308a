//! The `limpid` program.
fn main() {}
