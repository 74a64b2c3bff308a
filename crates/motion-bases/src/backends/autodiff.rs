//! The op as a node of a graph: it keeps its inputs, and the way back goes forward once more.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{Autodiff, tensor::FloatTensor};
use host::pass_back;

use crate::ops::{MotionBackwardOps, MotionOps};

#[derive(Debug)]
struct Moved;

impl<B: MotionBackwardOps> Backward<B, 3> for Moved {
    type State = [FloatTensor<B>; 3];

    fn backward(
        self,
        ops: Ops<Self::State, 3>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, B::moved_backward);
    }
}

impl<B: MotionBackwardOps, C: CheckpointStrategy> MotionOps for Autodiff<B, C> {
    fn moved(
        coefficients: FloatTensor<Self>,
        bases: FloatTensor<Self>,
        means: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let (coefficients, coefficients_node) = coefficients.into_parts();
        let (bases, bases_node) = bases.into_parts();
        let (means, means_node) = means.into_parts();
        match Moved
            .prepare::<C>([coefficients_node, bases_node, means_node])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(prep) => {
                let output = B::moved(coefficients.clone(), bases.clone(), means.clone());
                prep.finish([coefficients, bases, means], output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::moved(coefficients, bases, means)),
        }
    }
}
