//! What a camera does while it takes a frame: it moves along a short path while its shutter is open, and its lens has an
//! aperture and a focus distance.
//!
//! The light of a frame comes from many moments and many points of the lens. [`samples`] draws some of them, and
//! [`Capture::poses`] says from where each sees the world: the moment moves the camera along its path, and the point of
//! the lens is a shear of the pose that leaves the plane of focus where it is. What is done with the poses is the
//! caller's; the crate knows no image and no Gaussian.
//!
//! ```
//! use burn::tensor::{DType, Device, Tensor};
//! use capture::{Capture, samples};
//!
//! let device = Device::flex().autodiff();
//! // Two frames, paths of degree 1, a scene of size 4.
//! let mut capture = Capture::still(2, 1, (&device, DType::F64));
//! // Frame 0 turns by 0.01 rad around y.
//! capture.paths = Tensor::from_data([[0.0, 0.01, 0.0, 0.0, 0.0, 0.0], [0.0; 6]], (&device, DType::F64));
//! let given = Tensor::from_data(
//!     [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
//!     (&device, DType::F64),
//! );
//! let taken = samples(8, 0.0);
//! let poses = capture.poses(0, &given, &taken, 4.0);
//! assert_eq!(poses.dims(), [8, 3, 4]);
//! assert!(capture.taken(0).path_px(200.0) > 1.9);
//! ```

mod capture;
mod motion;
mod samples;
mod taken;

pub use capture::Capture;
pub use motion::{RIGID, moved, shift_in_image, shift_of, turn_of, turns};
pub use samples::{BlurSize, GOLDEN_ANGLE, Sample, Spacing, samples, samples_for};
pub use taken::Taken;
