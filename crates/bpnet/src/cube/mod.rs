//! The kernels on a GPU, one file per stage as in [`crate::cpu`]; they do not know which runtime compiles them.

pub(crate) mod composite;
