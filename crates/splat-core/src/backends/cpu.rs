//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::sync::Arc;

use burn::backend::{TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::Shape;
use host::{HostBackend, HostFloat, Real as _, tensor, with_float};

use crate::camera::Camera;
use crate::cpu::{
    self, BASE_CHANNELS, BackwardOptions, Float, Forward, Projection, RasterState, SplatSlices,
    View,
};
use crate::error::SplatError;
use crate::ops::{
    Blended, HostProjection, INPUTS, POSE, PreparedView, Projected, SceneTensors, SplatBackwardOps,
    SplatOps,
};

macro_rules! host_ops {
    ($backend:ty) => {
        impl SplatOps for $backend {
            fn project(
                scene: SceneTensors<Self>,
                camera: Camera,
                sh_degree: usize,
            ) -> Projected<Self> {
                match project_on::<Self>(scene, camera, sh_degree) {
                    Ok(view) => Projected::Done(view),
                    Err(error) => Projected::Refused(error),
                }
            }

            fn rasterize(
                view: PreparedView<Self>,
                _scene: SceneTensors<Self>,
                features: FloatTensor<Self>,
                _screen_grad: FloatTensor<Self>,
            ) -> Blended<Self> {
                match Self::rasterize_saved(view, features) {
                    Ok((output, _)) => Blended::Done(output),
                    Err(error) => Blended::Refused(error),
                }
            }
        }

        impl SplatBackwardOps for $backend {
            type Saved = Arc<Saved>;

            fn rasterize_saved(
                view: PreparedView<Self>,
                features: FloatTensor<Self>,
            ) -> Result<(FloatTensor<Self>, Self::Saved), SplatError> {
                let (output, saved) = match view {
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
