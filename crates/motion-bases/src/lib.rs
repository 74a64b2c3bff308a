//! SE(3) motion bases: the motion of a scene as a few rigid motions, shared by all dynamic Gaussians.
//!
//! A basis is a rotation (continuous 6D form, Zhou et al. 2019) and a translation per training
//! frame. A Gaussian blends the bases with softmax weights of its own and gets its 6D vector and
//! translation at a time; [`gram_schmidt`] makes a rotation of the former. Blending comes first
//! (Shape of Motion, Wang et al. 2024).
//!
//! The way through the crate: [`Tracks3d`] → [`initialize`] → [`MotionInit`] → the first fit, whose
//! loss is [`fit_loss`] → [`MotionBases::moved_at`] in each iteration. The optimiser is the caller's.
//!
//! The crate does no I/O, keeps no clock, and draws random numbers only from the caller's seed.

#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod backends;
mod basis_init;
mod clustering;
mod cpu;
#[cfg(feature = "cube")]
mod cube;
mod error;
mod fit;
mod fit_data;
mod init;
mod merging;
mod motion;
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod ops;
mod procrustes;
mod quaternion;
mod rotation;
mod selection;
mod smoothness;
mod statistics;
mod tracks;

pub use error::MotionError;
pub use fit::{Fit, fit_loss};
pub use fit_data::{FitCamera, FitData};
pub use glam;
pub use init::{InitOptions, MotionInit, initialize};
pub use motion::{Motion, MotionBases, positions_all_frames};
pub use procrustes::procrustes;
pub use quaternion::{quat_from_matrix, quats_of_posed};
pub use rotation::gram_schmidt;
pub use smoothness::{along_ray, bases_acceleration, means_acceleration};
pub use tracks::Tracks3d;
