//! Formats that others read: glTF, SPZ, and cameras as nerfstudio and COLMAP have them. (PLY is `ply.rs`, as it is read too.)

mod colmap;
mod gaussians;
mod glb;
mod spz;
mod transforms;
mod view;

pub use colmap::write_colmap;
pub use glb::{Glb, GlbPart, RigidMotion, write_glb};
pub use spz::{SpzLoss, write_spz};
pub use transforms::write_transforms;
pub use view::ExportedView;
