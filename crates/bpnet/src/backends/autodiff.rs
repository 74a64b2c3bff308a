use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{Autodiff, Backend, tensor::FloatTensor};

use crate::ops::{BlurBackwardOps, BlurOps};

#[derive(Debug)]
struct Blur;

impl<B: Backend + BlurBackwardOps> Backward<B, 2> for Blur {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let (image, kernel) = ops.state;
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let gradients = B::blur_backward(image, kernel, gradient, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(gradients) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<B>(parent.id, gradient);
            }
        }
    }
}

impl<B: Backend + BlurOps + BlurBackwardOps, C: CheckpointStrategy> BlurOps for Autodiff<B, C> {
    fn blur(image: FloatTensor<Self>, kernel: FloatTensor<Self>) -> FloatTensor<Self> {
        let (image, image_node) = image.into_parts();
        let (kernel, kernel_node) = kernel.into_parts();
        match Blur
            .prepare::<C>([image_node, kernel_node])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(prep) => {
                let output = B::blur(image.clone(), kernel.clone());
                prep.finish((image, kernel), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::blur(image, kernel)),
        }
    }
}
