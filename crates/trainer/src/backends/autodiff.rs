//! The image loss as a node of a graph: its gradient comes with its value, and is saved.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind, unary},
};
use burn::backend::{Autodiff, TensorMetadata as _, tensor::FloatTensor};

use crate::ops::{ImageLossBackwardOps, ImageLossOps};

#[derive(Debug)]
struct ImageLoss;

impl<B: ImageLossBackwardOps> Backward<B, 1> for ImageLoss {
    type State = FloatTensor<B>;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let saved = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |gradient| {
            let shape = saved.shape();
            B::float_mul(saved, B::float_expand(gradient, shape))
        });
    }
}

impl<B: ImageLossBackwardOps, C: CheckpointStrategy> ImageLossOps for Autodiff<B, C> {
    fn image_loss(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> FloatTensor<Self> {
        let (a, node) = a.into_parts();
        let b = b.into_primitive();
        match ImageLoss.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (value, gradient) = B::image_loss_and_gradient(a, b, weights);
                prep.finish(gradient, value)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::image_loss(a, b, weights)),
        }
    }
}
