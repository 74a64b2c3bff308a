//! The splatting op and its exposing twin on every backend.

mod devices;
mod exposure;
mod gsplat;
mod tensors;
