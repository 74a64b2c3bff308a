//! trainer

pub mod adam;
pub mod density;
pub mod losses;
pub mod metrics;
mod real;
