//! Files: datasets in; images, JSON, and scenes and cameras in formats that others read out.
//!
//! [`Scene::open`] recognises a folder by its content (Shape-of-Motion's layout, nerfstudio's
//! `transforms.json`, and others) and hands out frames, cameras, times and whatever of depth, masks and tracks
//! there is, in this project's conventions: OpenCV camera axes, pixel centres at + 0.5, z-depth,
//! sRGB in [0, 1], time in units of training frames.
//!
//! This crate knows nothing of training or of tensors. Files are not trusted: every count in a header
//! is held against the length of the file before anything is allocated from it, and whatever is wrong
//! comes back as an [`IoError`] that names the file.

mod archive;
mod atomic;
mod bytes;
mod camera_model;
mod colmap;
mod error;
mod export;
mod exr;
mod folder;
mod json;
mod key_frames;
mod layouts;
mod load;
mod mask;
mod notes;
mod npy;
mod open;
mod picture;
mod plan;
mod ply;
mod resample;
mod rotation;
mod scene;
mod tracks;
mod truth;
mod undistort;

pub use atomic::{unfinished, write_atomic, write_atomic_keeping, write_json};
pub use error::{IoError, list_names};
pub use export::{
    ExportedView, Glb, GlbPart, RigidMotion, SpzLoss, write_colmap, write_glb, write_spz,
    write_transforms,
};
pub use glam;
pub use json::{parse_json, read_json};
pub use key_frames::{KeyFrame, read_key_frames};
pub use mask::read_map;
pub use picture::{Image, Map, encode_jpeg, read_image, write_map_png, write_png};
pub use ply::{read_ply, write_ply, write_points_ply};
pub use resample::shrink_image;
pub use scene::{Frame, LoadOptions, Scene, SparsePoint, TruthFolders, View};
pub use splat_core::Gaussians;
pub use tracks::{QueryTracks, TrackSample, Tracks};
pub use truth::{TrueExposure, Truth};
pub use undistort::Undistortion;
