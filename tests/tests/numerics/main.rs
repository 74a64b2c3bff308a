//! Input at the extremes and what rounding costs, on every backend.

mod extremes;
mod figures;
