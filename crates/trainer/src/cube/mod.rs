//! The kernels on a GPU, one file per stage as in [`crate::cpu`]; they do not know which runtime compiles them.
//!
//! Sums have a fixed order and counts are whole numbers: results have the same bits in every run.

pub(crate) mod adam;
pub(crate) mod depth;
pub(crate) mod detail;
pub(crate) mod mask;
pub(crate) mod reduce;
pub(crate) mod ssim;
