//! Losses of pictures as nodes of a graph: their gradient comes with their value, and is saved.

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

/// A loss of a picture: `value` makes it, or `slope` with its gradient where that is tracked.
fn loss_of<B: ImageLossBackwardOps, C: CheckpointStrategy>(
    picture: FloatTensor<Autodiff<B, C>>,
    value: impl FnOnce(FloatTensor<B>) -> FloatTensor<B>,
    slope: impl FnOnce(FloatTensor<B>) -> (FloatTensor<B>, FloatTensor<B>),
) -> FloatTensor<Autodiff<B, C>> {
    let (picture, node) = picture.into_parts();
    match ImageLoss.prepare::<C>([node]).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let (value, gradient) = slope(picture);
            prep.finish(gradient, value)
        }
        OpsKind::UnTracked(prep) => prep.finish(value(picture)),
    }
}

impl<B: ImageLossBackwardOps, C: CheckpointStrategy> ImageLossOps for Autodiff<B, C> {
    fn image_loss(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> FloatTensor<Self> {
        let b = b.into_primitive();
        loss_of::<B, C>(
            a,
            |a| B::image_loss(a, b.clone(), weights),
            |a| B::image_loss_and_gradient(a, b.clone(), weights),
        )
    }

    fn detail_loss(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self> {
        let b = b.into_primitive();
        loss_of::<B, C>(
            a,
            |a| B::detail_loss(a, b.clone()),
            |a| B::detail_loss_and_gradient(a, b.clone()),
        )
    }
}
