//! The ops as nodes of a graph. Moved Gaussians keep their inputs, and the way back goes forward once more; the first fit keeps
//! its gradients, which it makes on the way there.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{Autodiff, tensor::FloatTensor};
use burn::tensor::Shape;
use host::pass_back;

use crate::fit_data::FitStep;
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

#[derive(Debug)]
struct FirstFit;

impl<B: MotionBackwardOps> Backward<B, 4> for FirstFit {
    type State = [FloatTensor<B>; 4];

    fn backward(
        self,
        ops: Ops<Self::State, 4>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, |gradients, of_loss, wanted| {
            let factor = B::float_reshape(of_loss, Shape::new([1, 1]));
            let mut wanted = wanted.into_iter();
            gradients.map(|gradient| {
                let is_wanted = wanted.next().expect("one for every input");
                is_wanted.then(|| B::float_mul(gradient, factor.clone()))
            })
        });
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

    fn fit(
        rots: FloatTensor<Self>,
        transls: FloatTensor<Self>,
        coefficients: FloatTensor<Self>,
        means: FloatTensor<Self>,
        step: FitStep,
    ) -> FloatTensor<Self> {
        let (rots, rots_node) = rots.into_parts();
        let (transls, transls_node) = transls.into_parts();
        let (coefficients, coefficients_node) = coefficients.into_parts();
        let (means, means_node) = means.into_parts();
        let nodes = [rots_node, transls_node, coefficients_node, means_node];
        match FirstFit.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let inputs = [rots, transls, coefficients, means];
                let (loss, gradients) = B::fit_slope(inputs, &step);
                prep.finish(gradients, loss)
            }
            OpsKind::UnTracked(prep) => {
                prep.finish(B::fit(rots, transls, coefficients, means, step))
            }
        }
    }
}
