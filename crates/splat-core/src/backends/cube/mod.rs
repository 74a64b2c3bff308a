//! GPUs, by the kernels of [`crate::cube`].

mod blend;
mod prepare;
mod sort;
mod stages;
mod tables;
mod unblend;

use std::sync::Arc;

use burn::backend::ops::FloatTensorOps as _;
use burn::backend::tensor::FloatTensor;
use burn::tensor::Shape;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{flat, zeros};

use crate::camera::Camera;
use crate::cpu::{BASE_CHANNELS, Transfer};
use crate::error::SplatError;
use crate::ops::{
    Blended, Collected, EXPOSE_INPUTS, INPUTS, MovingTensors, POSE, POSES, Picture, PreparedView,
    Projected, SceneTensors, SplatBackwardOps, SplatOps, Taking,
};
use blend::{Blend, mean_of_samples};
use prepare::prepare;
pub use tables::LARGEST_TABLE;
use tables::Scene;
pub(crate) use tables::Tables;
use unblend::{exposure_gradients, render_gradients, unblend};

/// What the way back of a render needs beside its inputs; nothing where there was no Gaussian.
#[derive(Clone, Debug)]
pub(crate) struct Saved(Option<(Arc<Tables>, CubeTensor)>);

/// What the way back of an exposure needs beside its inputs.
#[derive(Clone, Debug)]
pub(crate) struct SavedExposure(Option<Arc<Exposed>>);

#[derive(Debug)]
struct Exposed {
    tables: Tables,
    blend: Blend,
    picture: CubeTensor,
    transfer: Transfer,
}

/// What moves in each sample: means [n, F, 3] and left rotations [n, F, 3, 3].
struct Moving {
    means: CubeTensor,
    left_rotations: CubeTensor,
}

/// A scene that `moving` moves in, seen from `poses`.
fn scene_of(
    scene: SceneTensors<CubeBackend>,
    moving: Moving,
    poses: CubeTensor,
    camera: &Camera,
    sh_degree: usize,
) -> Scene {
    let sh = flat(scene.sh);
    let rows = sh.meta.shape()[0];
    let [samples, of_moving, _] = moving.means.meta.shape().dims();
    let table = |tensors: Vec<CubeTensor>, dim| flat(CubeBackend::float_cat(tensors, dim));
    let shapes = table(
        vec![
            scene.means,
            scene.quats,
            scene.log_scales,
            scene.opacity_logits,
        ],
        1,
    );
    let moved = if of_moving > 0 {
        let left = [samples, of_moving, 9].into();
        let left = CubeBackend::float_reshape(moving.left_rotations, left);
        table(vec![moving.means, left], 2)
    } else {
        // A buffer that no kernel reads, but none may be empty.
        shapes.clone()
    };
    Scene {
        camera: camera.clone(),
        sh_degree,
        stored: sh.meta.num_elements() / (3 * rows.max(1)),
        rows,
        moving: of_moving,
        samples,
        shapes,
        sh,
        moved,
        pose: flat(scene.cam_from_world),
        poses: flat(poses),
    }
}

/// Gaussians whose first rows have left rotations, as a scene of one sample.
fn still(scene: SceneTensors<CubeBackend>, camera: &Camera, sh_degree: usize) -> Scene {
    let left = scene.left_rotations.clone();
    let rows = left.meta.shape()[0];
    let means = CubeBackend::float_slice(
        scene.means.clone(),
        &[(0..rows as isize).into(), (0..3).into()],
    );
    let moving = Moving {
        means: CubeBackend::float_reshape(means, [1, rows, 3].into()),
        left_rotations: left,
    };
    let poses = scene.cam_from_world.clone();
    scene_of(scene, moving, poses, camera, sh_degree)
}

/// Channels beside alpha: colours, depth and features.
fn channels(features: &CubeTensor) -> usize {
    BASE_CHANNELS - 1 + features.meta.shape()[1]
}

/// A view [H, W, 5 + F], and what its way back needs.
fn rasterized(
    view: PreparedView<CubeBackend>,
    features: &CubeTensor,
) -> Result<(CubeTensor, Saved), SplatError> {
    match view {
        PreparedView::Blank { camera, .. } => {
            let channels = 1 + channels(features);
            let output = zeros(features, [camera.num_pixels() * channels]);
            let shape = [camera.height, camera.width, channels].into();
            Ok((CubeBackend::float_reshape(output, shape), Saved(None)))
        }
        PreparedView::Device { tables, .. } => {
            let blend = Blend::new(&tables, features, true)?;
            Ok((blend.output, Saved(Some((tables, blend.state)))))
        }
        #[cfg(any(feature = "flex", feature = "ndarray"))]
        PreparedView::Host { .. } => unreachable!("a view stays on its device"),
    }
}

/// What is collected while the shutter is open, and what its way back needs.
fn exposed(
    scene: SceneTensors<CubeBackend>,
    moving: MovingTensors<CubeBackend>,
    taking: &Taking,
) -> Result<(Picture<CubeBackend>, SavedExposure), SplatError> {
    let camera = &taking.camera;
    let size = [camera.height, camera.width, 3];
    if scene.means.meta.shape()[0] == 0 {
        camera.check()?;
        let color = zeros(&scene.means, [camera.num_pixels() * 3]);
        let picture = Picture {
            color: CubeBackend::float_reshape(color, size.into()),
            radii: zeros(&scene.means, [0]),
        };
        return Ok((picture, SavedExposure(None)));
    }
    let movers = Moving {
        means: moving.means,
        left_rotations: moving.left_rotations,
    };
    let scene = scene_of(scene, movers, moving.poses, camera, taking.sh_degree);
    let tables = prepare(scene, None)?;
    let blend = Blend::new(&tables, &tables.splats, false)?;
    let picture = mean_of_samples(&tables.scene, &blend.output, taking.transfer)?;
    let shown = Picture {
        color: CubeBackend::float_reshape(picture.clone(), size.into()),
        radii: tables.radii.clone(),
    };
    let saved = Exposed {
        tables,
        blend,
        picture,
        transfer: taking.transfer,
    };
    Ok((shown, SavedExposure(Some(Arc::new(saved)))))
}

impl SplatOps for CubeBackend {
    fn project(
        scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        camera: Camera,
        sh_degree: usize,
    ) -> Projected<Self> {
        if scene.means.meta.shape()[0] == 0 {
            let radii = zeros(&scene.means, [0]);
            let checked = camera.check();
            return checked
                .map(|()| PreparedView::Blank { camera, radii })
                .into();
        }
        let features = (features.meta.num_elements() > 0).then(|| flat(features));
        prepare(still(scene, &camera, sh_degree), features.as_ref())
            .map(|tables| PreparedView::Device {
                radii: tables.radii.clone(),
                tables: Arc::new(tables),
            })
            .into()
    }

    fn rasterize(
        view: PreparedView<Self>,
        _scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        _screen_grad: FloatTensor<Self>,
    ) -> Blended<Self> {
        rasterized(view, &features).map(|(output, _)| output).into()
    }

    fn expose(
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        _screen_grad: FloatTensor<Self>,
        taking: Taking,
    ) -> Collected<Self> {
        exposed(scene, moving, &taking)
            .map(|(picture, _)| picture)
            .into()
    }
}

impl SplatBackwardOps for CubeBackend {
    type Saved = Saved;

    fn rasterize_saved(
        view: PreparedView<Self>,
        features: FloatTensor<Self>,
    ) -> Result<(FloatTensor<Self>, Self::Saved), SplatError> {
        if let PreparedView::Device { tables, .. } = &view {
            tables.have_room_for_gradients(channels(&features))?;
        }
        rasterized(view, &features)
    }

    fn rasterize_backward(
        saved: Self::Saved,
        scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; INPUTS],
    ) -> [Option<FloatTensor<Self>>; INPUTS] {
        let like = scene.means.clone();
        let rows = like.meta.shape()[0];
        let of_features = features.meta.shape().clone();
        let shapes = scene.into_array().map(|tensor| tensor.meta.shape().clone());
        let shape_of = |k: usize| match k {
            0..7 => shapes[k].clone(),
            7 => of_features.clone(),
            _ => [rows].into(),
        };
        let gradients = saved.0.map(|(tables, state)| {
            let channels = channels(&features);
            let pixels = render_gradients(&tables, &state, flat(gradient), channels);
            let features = flat(features);
            unblend(&tables, &features, pixels, channels, wanted[POSE], false)
        });
        each_wanted(wanted, |k| {
            let shape = shape_of(k);
            match &gradients {
                None => none(&like, shape),
                Some(g) => match k {
                    LEFT => g.moving(1, shape),
                    POSE => Self::float_add(g.poses(shape.clone()), g.color_pose(shape)),
                    0..7 => g.scene(k, shape),
                    7 => g.features(shape),
                    _ => g.screen(),
                },
            }
        })
    }

    type SavedExposure = SavedExposure;

    fn expose_saved(
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        taking: &Taking,
    ) -> Result<(Picture<Self>, Self::SavedExposure), SplatError> {
        let taken = exposed(scene, moving, taking)?;
        if let SavedExposure(Some(exposed)) = &taken.1 {
            exposed.tables.have_room_for_gradients(3)?;
        }
        Ok(taken)
    }

    fn expose_backward(
        saved: Self::SavedExposure,
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; EXPOSE_INPUTS],
    ) -> [Option<FloatTensor<Self>>; EXPOSE_INPUTS] {
        let like = scene.means.clone();
        let rows = like.meta.shape()[0];
        let shapes = scene.into_array().map(|tensor| tensor.meta.shape().clone());
        let of_moving = moving
            .into_array()
            .map(|tensor| tensor.meta.shape().clone());
        let gradients = saved.0.map(|exposed| {
            let Exposed {
                tables,
                blend,
                picture,
                transfer,
            } = &*exposed;
            let pixels = exposure_gradients(tables, blend, picture, flat(gradient), *transfer);
            unblend(tables, &tables.splats, pixels, 3, wanted[POSES], true)
        });
        let shape_of = |k: usize| match k {
            0..POSES => shapes[k].clone(),
            _ if k < POSES + 3 => of_moving[k - POSES].clone(),
            _ => [rows].into(),
        };
        each_wanted(wanted, |k| {
            let shape = shape_of(k);
            match &gradients {
                None => none(&like, shape),
                Some(g) => match k {
                    // The left rotations of the middle take no part.
                    LEFT => none(&like, shape),
                    // The pose of the middle is there for its colours alone.
                    POSE => g.color_pose(shape),
                    0..POSES => g.scene(k, shape),
                    POSES => g.poses(shape),
                    _ if k < POSES + 3 => g.moving(k - POSES - 1, shape),
                    _ => g.screen(),
                },
            }
        })
    }
}

/// Place of the left rotations among the inputs.
const LEFT: usize = 2;

/// A gradient for every wanted input.
fn each_wanted<const N: usize>(
    wanted: [bool; N],
    gradient: impl Fn(usize) -> CubeTensor,
) -> [Option<CubeTensor>; N] {
    std::array::from_fn(|k| wanted[k].then(|| gradient(k)))
}

/// Zeros.
fn none(like: &CubeTensor, shape: Shape) -> CubeTensor {
    CubeBackend::float_reshape(zeros(like, [shape.num_elements()]), shape)
}
