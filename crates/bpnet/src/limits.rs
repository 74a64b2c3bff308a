//! How large a blur model may be.

/// Largest side of a blur kernel, in pixels.
pub const MAX_KERNEL_SIZE: usize = 15;

/// Features and kernels are computed on a picture at most so many times smaller.
pub const MAX_DOWNSCALE: usize = 4;
