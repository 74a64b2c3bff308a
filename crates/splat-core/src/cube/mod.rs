//! The kernels on a GPU, one file per stage as in [`crate::cpu`], and the sort that a GPU has to bring itself; they do not know
//! which runtime compiles them.
//!
//! All samples of an exposure go through each stage together: an *item* is a Gaussian in a sample, number `sample * N + row`;
//! a *tile* counts on from sample to sample. A plain render is an exposure of one sample. A *slot* is a pair of an item and a
//! tile, counted item by item in depth order: an item's slots lie side by side, and partial gradients are summed from there in
//! a fixed order, so that results have the same bits in every run.

pub(crate) mod body;
pub(crate) mod color;
pub(crate) mod exposure;
pub(crate) mod geometry;
mod matrices;
pub(crate) mod project;
pub(crate) mod project_backward;
pub(crate) mod raster;
pub(crate) mod raster_backward;
pub(crate) mod scan;
mod sh;
pub(crate) mod sort;
pub(crate) mod splat;
pub(crate) mod tiles;
