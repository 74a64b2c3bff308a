//! Motion bases on every backend.

mod fit;
mod smoothness;
mod tensors;
