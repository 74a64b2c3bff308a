//! What an iteration costs, stage by stage, against the machine's floor, and how that grows.
//!
//! `cargo xtask bench` runs it; docs/PERFORMANCE.md holds what it found.

pub mod bound;
pub mod curves;
pub mod floor;
#[cfg(any(feature = "wgpu", feature = "cuda"))]
pub mod gpu;
pub mod growth;
pub mod iteration;
pub mod machine;
pub mod net;
pub mod pairs;
pub mod report;
pub mod spans;
pub mod workload;
