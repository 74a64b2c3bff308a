//! The kernels on a GPU, one file per stage as in [`crate::cpu`]; they do not know which runtime compiles them.

pub(crate) mod composite;
pub(crate) mod conv;
pub(crate) mod instance_norm;
pub(crate) mod predict;
pub(crate) mod product;
pub(crate) mod upsample;
