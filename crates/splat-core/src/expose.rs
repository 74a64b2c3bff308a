//! Exposures on tensors: what a camera collects while its shutter is open.

use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::cpu::Transfer;
use crate::error::SplatError;
use crate::ops::{Collected, MovingTensors, Picture, SplatOps, Taking};
use crate::render::scene;
use crate::splats::{Splats, Viewpoint, check_dtype, check_shape};

/// From where the light of one picture comes: n samples of equal weight, in the float type of the Gaussians.
#[derive(Clone, Debug)]
pub struct Exposure {
    /// The samples' poses, [n, 3, 4] with n > 0. They need not be rigid: a point of a lens is a shear.
    pub poses: Tensor<3>,
    /// Where moving Gaussians are in each sample; `None` where all rest as they stand.
    pub movers: Option<Movers>,
    /// How the picture's values stand for light.
    pub transfer: Transfer,
}

/// Gaussians that move while the shutter is open: rows [0, F).
#[derive(Clone, Debug)]
pub struct Movers {
    /// Means in each sample, scene units, [n, F, 3].
    pub means: Tensor<3>,
    /// Matrices multiplied from the left of their rotations, [n, F, 3, 3].
    pub left_rotations: Tensor<4>,
}

/// A picture that was exposed.
#[derive(Clone, Debug)]
pub struct Exposed {
    /// Colour on a black background, not clamped above 1, [H, W, 3].
    pub color: Tensor<3>,
    /// Largest radius of every Gaussian over the samples (three standard deviations of its longer axis), px, `[N]` in f32;
    /// 0 for Gaussians that no sample draws.
    pub radii: Tensor<1>,
}

/// The mean of all samples' renders, taken in light: one op with one set of gradients.
///
/// `splats` are the Gaussians in the middle of the exposure, and `middle` is the view from there; every sample sees a
/// Gaussian in the colour in which its middle is seen then, which is exact without SH bands over 0, and otherwise off by
/// the turn of the direction within the exposure (a fortieth of an 8-bit step for a path of 3 px, a fifth for one of 10, in a test
/// with pictures 256 wide: `tests/tests/splat_core/exposure.rs`). The left rotations of `splats` are those of the middle, and count where
/// nothing moves.
///
/// `screen_grad` is as in [`crate::Extra`]; its statistic is the sum over the samples.
///
/// # Errors
/// Wrong shapes or types, no sample, an unusable camera, a value that is not finite (named with its row).
///
/// # Panics
/// As [`crate::prepare`].
pub fn expose(
    mut splats: Splats,
    middle: &Viewpoint,
    exposure: Exposure,
    screen_grad: Option<Tensor<1>>,
) -> Result<Exposed, SplatError> {
    let standing = splats.left_rotations.take();
    let layout = splats.layout(&middle.cam_from_world)?;
    layout.check_degree(middle.sh_degree)?;
    let options = (&splats.means.device(), layout.dtype);
    let [n, ..] = exposure.poses.dims();
    check_shape("poses", exposure.poses.dims(), [n.max(1), 3, 4])?;
    check_dtype("poses", exposure.poses.dtype(), layout.dtype)?;
    let (means, left_rotations) = match exposure.movers {
        Some(Movers {
            means,
            left_rotations,
        }) => {
            let rows = means.dims()[1].min(layout.rows);
            check_shape("moving_means", means.dims(), [n, rows, 3])?;
            check_shape("left_rotations", left_rotations.dims(), [n, rows, 3, 3])?;
            check_dtype("moving_means", means.dtype(), layout.dtype)?;
            check_dtype("left_rotations", left_rotations.dtype(), layout.dtype)?;
            (means, left_rotations)
        }
        None => match standing {
            Some(left) if left.dims()[0] > 0 => {
                let [rows, ..] = left.dims();
                check_shape("left_rotations", left.dims(), [rows.min(layout.rows), 3, 3])?;
                check_dtype("left_rotations", left.dtype(), layout.dtype)?;
                let means = splats.means.clone().slice_dim(0, 0..rows);
                (
                    means.reshape([1, rows, 3]).expand([n, rows, 3]),
                    left.reshape([1, rows, 3, 3]).expand([n, rows, 3, 3]),
                )
            }
            _ => (
                Tensor::zeros([n, 0, 3], options),
                Tensor::zeros([n, 0, 3, 3], options),
            ),
        },
    };
    let screen_grad = match screen_grad {
        Some(screen) => {
            check_shape("screen_grad", screen.dims(), [layout.rows])?;
            check_dtype("screen_grad", screen.dtype(), layout.dtype)?;
            screen
        }
        None => Tensor::zeros([0], options),
    };
    let moving = MovingTensors {
        poses: exposure.poses.into_dispatch(),
        means: means.into_dispatch(),
        left_rotations: left_rotations.into_dispatch(),
    };
    let taking = Taking {
        camera: middle.camera.clone(),
        sh_degree: middle.sh_degree,
        transfer: exposure.transfer,
    };
    let scene = scene(splats, middle.cam_from_world.clone());
    match <Dispatch as SplatOps>::expose(scene, moving, screen_grad.into_dispatch(), taking) {
        Collected::Done(Picture { color, radii }) => Ok(Exposed {
            color: Tensor::from_dispatch(color),
            radii: Tensor::from_dispatch(radii),
        }),
        Collected::Refused(error) => Err(error),
    }
}
