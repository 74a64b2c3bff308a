//! The kernels on a GPU, one file per stage as in [`crate::cpu`]; they do not know which runtime compiles them.

mod frame;
pub(crate) mod moved;
pub(crate) mod moved_backward;
