//! The blur model of "Dynamic Gaussian Splatting from Defocused and Motion-blurred Monocular Videos"
//! (NeurIPS 2025, arXiv 2510.10691): a scene feature extractor, a blur prediction network (BP-Net)
//! that gives each pixel a K x K kernel and an intensity m, and the per-pixel blur as one op with its
//! own backward.
//!
//! ```
//! use bpnet::{BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
//! use burn::tensor::{DType, Device, Tensor};
//!
//! let device = Device::flex();
//! let config = BpNetConfig { kernel_size: 5, num_frames: 2, shortcut: true, downscale: 1, head: HeadInit::Mild, seed: 0 };
//! let net = BpNet::new(&config, &device, DType::F32)?;
//! let sharp = Tensor::<3>::ones([6, 8, 3], &device);
//! let inputs = BlurInputs {
//!     color: sharp.clone(),
//!     disparity: Tensor::ones([6, 8], &device),
//!     mask: Tensor::zeros([6, 8], &device),
//! };
//! let field = net.forward(1, &inputs, Extractor::Trained)?;
//! let blurry = composite(sharp, &field)?.picture();
//! assert_eq!(blurry.dims(), [6, 8, 3]);
//! # Ok::<(), bpnet::BpNetError>(())
//! ```

#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod backends;
mod blur;
mod cpu;
#[cfg(feature = "cube")]
mod cube;
mod encoding;
mod error;
mod extractor;
mod field;
mod init;
mod layers;
mod limits;
mod net;
#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
mod ops;

pub use blur::blur;
pub use encoding::ENCODING_CHANNELS;
pub use error::BpNetError;
pub use extractor::FEATURE_CHANNELS;
pub use field::{
    BlurField, Composite, cell_means, composite, composite_trusted, kernel_center_loss,
};
pub use limits::{MAX_DOWNSCALE, MAX_KERNEL_SIZE};
pub use net::{
    BlurInputs, BpNet, BpNetConfig, EMBEDDING_CHANNELS, Extractor, HIDDEN_CHANNELS, HeadInit,
};
