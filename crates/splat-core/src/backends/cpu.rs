//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::sync::Arc;

use burn::backend::{TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::Shape;
use host::{HostBackend, HostFloat, Real as _, tensor, with_float};

use crate::camera::Camera;
use crate::cpu::{
    self, BASE_CHANNELS, BackwardOptions, ExposedState, Exposure, Float, Forward, Projection,
    RasterState, SplatSlices, View,
};
use crate::error::SplatError;
use crate::ops::{
    Blended, Collected, EXPOSE_INPUTS, HostProjection, INPUTS, MovingTensors, POSE, POSES, Picture,
    PreparedView, Projected, SceneTensors, SplatBackwardOps, SplatOps, Taking,
};

macro_rules! host_ops {
    ($backend:ty) => {
        impl SplatOps for $backend {
            fn project(
                scene: SceneTensors<Self>,
                _features: FloatTensor<Self>,
                camera: Camera,
                sh_degree: usize,
            ) -> Projected<Self> {
                project_on::<Self>(scene, camera, sh_degree).into()
            }

            fn rasterize(
                view: PreparedView<Self>,
                _scene: SceneTensors<Self>,
                features: FloatTensor<Self>,
                _screen_grad: FloatTensor<Self>,
            ) -> Blended<Self> {
                Self::rasterize_saved(view, features)
                    .map(|(output, _)| output)
                    .into()
            }

            fn expose(
                scene: SceneTensors<Self>,
                moving: MovingTensors<Self>,
                _screen_grad: FloatTensor<Self>,
                taking: Taking,
            ) -> Collected<Self> {
                take_picture_on::<Self>(scene, moving, &taking).into()
            }
        }

        impl SplatBackwardOps for $backend {
            type Saved = Arc<Saved>;

            fn rasterize_saved(
                view: PreparedView<Self>,
                features: FloatTensor<Self>,
            ) -> Result<(FloatTensor<Self>, Self::Saved), SplatError> {
                let (output, saved) = match view {
                    #[cfg(feature = "cube")]
                    PreparedView::Device { .. } | PreparedView::Blank { .. } => {
                        unreachable!("a view stays on its device")
                    }
                    PreparedView::Host {
                        projection: HostProjection::F32(projection),
                        ..
                    } => {
                        let (output, state) = rasterize_on::<f32, Self>(&projection, features)?;
                        (output, Saved::F32(projection, state))
                    }
                    PreparedView::Host {
                        projection: HostProjection::F64(projection),
                        ..
                    } => {
                        let (output, state) = rasterize_on::<f64, Self>(&projection, features)?;
                        (output, Saved::F64(projection, state))
                    }
                };
                Ok((output, Arc::new(saved)))
            }

            fn rasterize_backward(
                saved: Self::Saved,
                scene: SceneTensors<Self>,
                features: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; INPUTS],
            ) -> [Option<FloatTensor<Self>>; INPUTS] {
                match &*saved {
                    Saved::F32(projection, state) => {
                        backward_on(projection, state, scene, features, gradient, wanted)
                    }
                    Saved::F64(projection, state) => {
                        backward_on(projection, state, scene, features, gradient, wanted)
                    }
                }
            }

            type SavedExposure = Arc<SavedExposure>;

            fn expose_saved(
                scene: SceneTensors<Self>,
                moving: MovingTensors<Self>,
                taking: &Taking,
            ) -> Result<(Picture<Self>, Self::SavedExposure), SplatError> {
                expose_on::<Self>(scene, moving, taking)
            }

            fn expose_backward(
                saved: Self::SavedExposure,
                scene: SceneTensors<Self>,
                moving: MovingTensors<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; EXPOSE_INPUTS],
            ) -> [Option<FloatTensor<Self>>; EXPOSE_INPUTS] {
                let SavedExposure { taking, state } = &*saved;
                match state {
                    HostExposure::F32(state) => {
                        expose_backward_on((taking, state), scene, moving, gradient, wanted)
                    }
                    HostExposure::F64(state) => {
                        expose_backward_on((taking, state), scene, moving, gradient, wanted)
                    }
                }
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

/// What the backward pass needs of a forward pass beside its inputs.
#[derive(Debug)]
pub(crate) enum Saved {
    F32(Arc<Projection<f32>>, RasterState<f32>),
    F64(Arc<Projection<f64>>, RasterState<f64>),
}

/// What the backward pass needs of an exposure beside its inputs.
#[derive(Debug)]
pub(crate) struct SavedExposure {
    taking: Taking,
    state: HostExposure,
}

#[derive(Debug)]
enum HostExposure {
    F32(ExposedState<f32>),
    F64(ExposedState<f64>),
}

impl From<ExposedState<f32>> for HostExposure {
    fn from(state: ExposedState<f32>) -> Self {
        Self::F32(state)
    }
}

impl From<ExposedState<f64>> for HostExposure {
    fn from(state: ExposedState<f64>) -> Self {
        Self::F64(state)
    }
}

impl From<Projection<f32>> for HostProjection {
    fn from(projection: Projection<f32>) -> Self {
        Self::F32(Arc::new(projection))
    }
}

impl From<Projection<f64>> for HostProjection {
    fn from(projection: Projection<f64>) -> Self {
        Self::F64(Arc::new(projection))
    }
}

/// Calls `run` with a scene on slices, the pose apart.
fn with_slices<T: HostFloat, B: HostBackend, R>(
    scene: SceneTensors<B>,
    run: impl FnOnce(&SplatSlices<'_, T>, &[T]) -> R,
) -> R {
    let mut s = scene;
    run(
        &SplatSlices {
            means: &B::elements::<T>(&mut s.means),
            quats: &B::elements::<T>(&mut s.quats),
            left_rotations: &B::elements::<T>(&mut s.left_rotations),
            log_scales: &B::elements::<T>(&mut s.log_scales),
            opacity_logits: &B::elements::<T>(&mut s.opacity_logits),
            sh: &B::elements::<T>(&mut s.sh),
        },
        &B::elements::<T>(&mut s.cam_from_world),
    )
}

fn project_on<B: HostBackend>(
    scene: SceneTensors<B>,
    camera: Camera,
    sh_degree: usize,
) -> Result<PreparedView<B>, SplatError> {
    let like = scene.means.clone();
    let (projection, radii) = with_float!(like.dtype(), T => {
        let projection = with_slices::<T, B, _>(scene, |splats, pose| {
            let view = View {
                camera,
                cam_from_world: std::array::from_fn(|k| pose[k].to_f64()),
                sh_degree,
            };
            cpu::project(splats, &view)
        })?;
        let radii = projection.radii().to_vec();
        (projection.into(), radii)
    });
    let rows = radii.len();
    Ok(PreparedView::Host {
        projection,
        radii: tensor::<f32, B>(radii, [rows], &like),
    })
}

fn rasterize_on<T: HostFloat + Float, B: HostBackend>(
    projection: &Projection<T>,
    mut features: FloatTensor<B>,
) -> Result<(FloatTensor<B>, RasterState<T>), SplatError> {
    let num_features = features.shape()[1];
    let raster = cpu::rasterize(projection, &B::elements::<T>(&mut features), num_features)?;
    let camera = &projection.view().camera;
    let shape = [camera.height, camera.width, BASE_CHANNELS + num_features];
    Ok((
        tensor::<T, B>(raster.output, shape, &features),
        raster.state,
    ))
}

fn backward_on<T: HostFloat + Float, B: HostBackend>(
    projection: &Projection<T>,
    state: &RasterState<T>,
    scene: SceneTensors<B>,
    mut features: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
    wanted: [bool; INPUTS],
) -> [Option<FloatTensor<B>>; INPUTS] {
    let like = gradient.clone();
    let shapes = scene.clone().into_array().map(|tensor| tensor.shape());
    let shapes = shapes
        .into_iter()
        .chain([features.shape(), Shape::from([projection.len()])]);
    let g = with_slices::<T, B, _>(scene, |splats, _| {
        let forward = Forward {
            splats,
            projection,
            features: &B::elements::<T>(&mut features),
            state,
        };
        let options = BackwardOptions {
            pose: wanted[POSE],
            ..BackwardOptions::default()
        };
        cpu::backward(&forward, &B::elements::<T>(&mut gradient), options)
    })
    .expect("shapes were checked by the forward pass");
    let mut values = [
        g.means,
        g.quats,
        g.left_rotations,
        g.log_scales,
        g.opacity_logits,
        g.sh,
        g.cam_from_world.to_vec(),
        g.features,
        g.screen,
    ]
    .into_iter()
    .zip(shapes);
    wanted.map(|is_wanted| {
        let (values, shape) = values.next().expect("a gradient for every input");
        is_wanted.then(|| tensor::<T, B>(values, shape, &like))
    })
}

/// Calls `run` with an exposure on slices.
fn with_exposure<T: HostFloat + Float, B: HostBackend, R>(
    scene: SceneTensors<B>,
    moving: MovingTensors<B>,
    taking: &Taking,
    run: impl FnOnce(&Exposure<'_, T>) -> R,
) -> R {
    let mut m = moving;
    with_slices::<T, B, R>(scene, |splats, pose| {
        run(&Exposure {
            splats: *splats,
            middle: &View {
                camera: taking.camera.clone(),
                cam_from_world: std::array::from_fn(|k| pose[k].to_f64()),
                sh_degree: taking.sh_degree,
            },
            poses: &B::elements::<T>(&mut m.poses),
            moving_means: &B::elements::<T>(&mut m.means),
            left_rotations: &B::elements::<T>(&mut m.left_rotations),
            transfer: taking.transfer,
        })
    })
}

fn expose_on<B: HostBackend>(
    scene: SceneTensors<B>,
    moving: MovingTensors<B>,
    taking: &Taking,
) -> Result<(Picture<B>, Arc<SavedExposure>), SplatError> {
    let like = scene.means.clone();
    with_float!(like.dtype(), T => {
        let exposed = with_exposure::<T, B, _>(scene, moving, taking, cpu::expose)?;
        let saved = SavedExposure {
            taking: taking.clone(),
            state: exposed.state.into(),
        };
        let picture = picture_of::<T, B>((exposed.color, exposed.radii), taking, &like);
        Ok((picture, Arc::new(saved)))
    })
}

fn take_picture_on<B: HostBackend>(
    scene: SceneTensors<B>,
    moving: MovingTensors<B>,
    taking: &Taking,
) -> Result<Picture<B>, SplatError> {
    let like = scene.means.clone();
    with_float!(like.dtype(), T => {
        let taken = with_exposure::<T, B, _>(scene, moving, taking, cpu::take_picture)?;
        Ok(picture_of::<T, B>(taken, taking, &like))
    })
}

fn picture_of<T: HostFloat, B: HostBackend>(
    (color, radii): (Vec<T>, Vec<f32>),
    taking: &Taking,
    like: &FloatTensor<B>,
) -> Picture<B> {
    let (height, width) = (taking.camera.height, taking.camera.width);
    let rows = radii.len();
    Picture {
        color: tensor::<T, B>(color, [height, width, 3], like),
        radii: tensor::<f32, B>(radii, [rows], like),
    }
}

fn expose_backward_on<T: HostFloat + Float, B: HostBackend>(
    (taking, state): (&Taking, &ExposedState<T>),
    scene: SceneTensors<B>,
    moving: MovingTensors<B>,
    mut gradient: FloatTensor<B>,
    wanted: [bool; EXPOSE_INPUTS],
) -> [Option<FloatTensor<B>>; EXPOSE_INPUTS] {
    let like = gradient.clone();
    let rows = scene.means.shape()[0];
    let shapes = scene.clone().into_array().map(|tensor| tensor.shape());
    let more = moving.clone().into_array().map(|tensor| tensor.shape());
    let shapes = shapes.into_iter().chain(more).chain([Shape::from([rows])]);
    let g = with_exposure::<T, B, _>(scene, moving, taking, |exposure| {
        cpu::expose_backward(
            exposure,
            state,
            &B::elements::<T>(&mut gradient),
            wanted[POSES],
        )
    })
    .expect("shapes were checked by the forward pass");
    let middle = g.middle;
    let mut values = [
        middle.means,
        middle.quats,
        middle.left_rotations,
        middle.log_scales,
        middle.opacity_logits,
        middle.sh,
        middle.cam_from_world.to_vec(),
        g.poses,
        g.moving_means,
        g.left_rotations,
        middle.screen,
    ]
    .into_iter()
    .zip(shapes);
    wanted.map(|is_wanted| {
        let (values, shape) = values.next().expect("a gradient for every input");
        is_wanted.then(|| tensor::<T, B>(values, shape, &like))
    })
}
