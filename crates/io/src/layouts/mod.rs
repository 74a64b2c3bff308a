//! Every layout that is known, one file each.
//!
//! A new one is a file here that says in its `LAYOUT` what it looks for and how it plans, and an entry in
//! [`LAYOUTS`].

mod d2rf;
mod dyblurf;
mod dycheck;
mod megasam;
mod nerfstudio;
mod shape_of_motion;
mod stereo;
mod vipe;

use crate::plan::Layout;

/// A folder that several recognise is read by the first.
pub(crate) const LAYOUTS: [&Layout; 7] = [
    &nerfstudio::LAYOUT,
    // Before Shape-of-Motion's, whose images/ are blurry: here they are the sharp ones, for scoring.
    &d2rf::LAYOUT,
    &shape_of_motion::LAYOUT,
    &dycheck::LAYOUT,
    &megasam::LAYOUT,
    &vipe::LAYOUT,
    &dyblurf::LAYOUT,
];
