//! The splatting op as a backend extension: adapters of a few lines around [`crate::cpu`].

#![cfg_attr(
    feature = "ndarray",
    expect(
        deprecated,
        reason = "NdArray is kept as a second, independent CPU backend"
    )
)]

use std::sync::Arc;

#[cfg(feature = "flex")]
use burn::backend::Flex;
#[cfg(feature = "ndarray")]
use burn::backend::NdArray;
use burn::backend::autodiff::{
    Autodiff,
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients as Grads,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{
    Backend, ExtensionType, TensorMetadata, backend_extension, ops::FloatTensorOps,
    tensor::FloatTensor,
};
use burn::tensor::{TensorData, read_sync};

use crate::SplatError;
use crate::cpu::{self, BASE_CHANNELS, BackwardOptions, RasterState};
use crate::host::{HostArray, HostFloat};
use crate::render::{Precision, Prepared, Scene};

/// A blended image on its way into the graph. The CPU kernels have run before the op is called,
/// because an op cannot return an error.
#[derive(Clone, Debug)]
pub(crate) struct RasterJob {
    prepared: Prepared,
    features: Option<HostArray>,
    num_features: usize,
    state: Arc<State>,
    output: TensorData,
}

#[derive(Debug)]
enum State {
    F32(RasterState<f32>),
    F64(RasterState<f64>),
}

impl RasterJob {
    pub(crate) fn new(
        prepared: Prepared,
        features: Option<HostArray>,
        num_features: usize,
    ) -> Result<Self, SplatError> {
        fn run<T: HostFloat>(
            scene: &Scene<T>,
            features: Option<&HostArray>,
            num_features: usize,
        ) -> Result<(TensorData, RasterState<T>), SplatError> {
            let features = features.map_or(&[][..], HostArray::as_slice);
            let raster = cpu::rasterize(&scene.projection, features, num_features)?;
            let camera = &scene.projection.view().camera;
            let shape = [camera.height, camera.width, BASE_CHANNELS + num_features];
            Ok((TensorData::new(raster.output, shape), raster.state))
        }
        let (output, state) = match &*prepared.0 {
            Precision::F32(scene) => {
                let (output, state) = run(scene, features.as_ref(), num_features)?;
                (output, State::F32(state))
            }
            Precision::F64(scene) => {
                let (output, state) = run(scene, features.as_ref(), num_features)?;
                (output, State::F64(state))
            }
        };
        Ok(Self {
            prepared,
            features,
            num_features,
            state: Arc::new(state),
            output,
        })
    }

    /// Gradients as data, in the order of the op's float parents.
    fn backward(&self, v_output: &TensorData, pose: bool) -> [Option<TensorData>; PARENTS] {
        match (&*self.prepared.0, &*self.state) {
            (Precision::F32(scene), State::F32(state)) => self.run(scene, state, v_output, pose),
            (Precision::F64(scene), State::F64(state)) => self.run(scene, state, v_output, pose),
            _ => unreachable!("the state was made from this scene"),
        }
    }

    fn run<T: HostFloat>(
        &self,
        scene: &Scene<T>,
        state: &RasterState<T>,
        v_output: &TensorData,
        pose: bool,
    ) -> [Option<TensorData>; PARENTS] {
        let slices = scene.slices();
        let g = cpu::backward(
            &slices,
            &scene.projection,
            self.features.as_ref().map_or(&[], HostArray::as_slice),
            state,
            v_output.as_slice().expect("the type of the output"),
            BackwardOptions {
                pose,
                ..BackwardOptions::default()
            },
        )
        .expect("shapes were checked by the forward pass");
        let (n, left) = (slices.len(), slices.num_left());
        [
            Some(TensorData::new(g.means, [n, 3])),
            Some(TensorData::new(g.quats, [n, 4])),
            Some(TensorData::new(g.left_rotations, [left, 3, 3])),
            Some(TensorData::new(g.log_scales, [n, 3])),
            Some(TensorData::new(g.opacity_logits, [n, 1])),
            Some(TensorData::new(g.sh, [n, scene.sh_width()])),
            pose.then(|| TensorData::new(g.cam_from_world.to_vec(), [3, 4])),
            Some(TensorData::new(g.features, [n, self.num_features])),
            Some(TensorData::new(g.screen, [n])),
        ]
    }
}

/// Float parents of the op.
const PARENTS: usize = 9;
/// Place of the pose among them.
const POSE: usize = 6;

/// The float parents of the op; an absent input is any untracked tensor.
#[derive(Debug, ExtensionType)]
pub(crate) struct Parents<B: Backend> {
    pub(crate) means: FloatTensor<B>,
    pub(crate) quats: FloatTensor<B>,
    pub(crate) left_rotations: FloatTensor<B>,
    pub(crate) log_scales: FloatTensor<B>,
    pub(crate) opacity_logits: FloatTensor<B>,
    pub(crate) sh: FloatTensor<B>,
    pub(crate) cam_from_world: FloatTensor<B>,
    pub(crate) features: FloatTensor<B>,
    pub(crate) screen_grad: FloatTensor<B>,
}

/// The op. Tensors are parents only: values come with the job.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Autodiff: cfg(feature = "burn"),
)]
pub(crate) trait SplatOps: Backend {
    /// Puts the job's image, [H, W, 5 + F], into the graph.
    fn rasterize_splats(
        #[extension_type] parents: Parents<Self>,
        job: RasterJob,
    ) -> FloatTensor<Self>;
}

#[cfg(feature = "flex")]
impl SplatOps for Flex {
    fn rasterize_splats(parents: Parents<Self>, job: RasterJob) -> FloatTensor<Self> {
        Self::float_from_data(job.output, &parents.means.device())
    }
}

#[cfg(feature = "ndarray")]
impl SplatOps for NdArray {
    fn rasterize_splats(parents: Parents<Self>, job: RasterJob) -> FloatTensor<Self> {
        Self::float_from_data(job.output, &parents.means.device())
    }
}

#[derive(Debug)]
struct Rasterize;

impl<B: Backend> Backward<B, PARENTS> for Rasterize {
    type State = (RasterJob, B::Device);

    fn backward(
        self,
        ops: Ops<Self::State, PARENTS>,
        grads: &mut Grads,
        _checkpointer: &mut Checkpointer,
    ) {
        let (job, device) = ops.state;
        let v_output = grads.consume::<B>(&ops.node);
        let v_output = read_sync(B::float_into_data(v_output)).expect("reading host memory");
        let computed = job.backward(&v_output, ops.parents[POSE].is_some());
        for (parent, gradient) in ops.parents.into_iter().zip(computed) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<B>(parent.id, B::float_from_data(gradient, &device));
            }
        }
    }
}

impl<B: SplatOps, C: CheckpointStrategy> SplatOps for Autodiff<B, C> {
    fn rasterize_splats(parents: Parents<Self>, mut job: RasterJob) -> FloatTensor<Self> {
        let device = parents.means.primitive().device();
        let nodes = [
            parents.means.node(),
            parents.quats.node(),
            parents.left_rotations.node(),
            parents.log_scales.node(),
            parents.opacity_logits.node(),
            parents.sh.node(),
            parents.cam_from_world.node(),
            parents.features.node(),
            parents.screen_grad.node(),
        ];
        // The image goes to the graph, not into the saved state.
        let output = std::mem::replace(&mut job.output, TensorData::new(Vec::<f32>::new(), [0]));
        let output = B::float_from_data(output, &device);
        match Rasterize.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish((job, device), output),
            OpsKind::UnTracked(prep) => prep.finish(output),
        }
    }
}
