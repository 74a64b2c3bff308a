//! The float types of the kernels.

/// `f32` or `f64`: what the kernels compute in.
pub(super) trait Real: host::Real + radsort::Key {}
impl Real for f32 {}
impl Real for f64 {}
