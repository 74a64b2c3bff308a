//! Motion bases on every backend.

mod fit;
mod fit_terms;
mod smoothness;
mod tensors;
