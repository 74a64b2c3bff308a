//! The trainer's own ops on every backend.

mod adam;
mod devices;
mod losses;
