//! The ops as nodes of a graph: each saves what its backward needs.

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind, unary},
};
use burn::backend::{Autodiff, tensor::FloatTensor};

use crate::cpu::conv::ConvSize;
use crate::ops::{BpNetBackwardOps, BpNetOps};

#[derive(Debug)]
struct Blur;

impl<B: BpNetBackwardOps> Backward<B, 2> for Blur {
    type State = [FloatTensor<B>; 2];

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|node| node.id));
        let [image, kernel] = ops.state;
        let wanted = parents.each_ref().map(Option::is_some);
        let gradients = B::blur_backward(image, kernel, gradient, wanted);
        register::<B, 2>(grads, parents, gradients);
    }
}

#[derive(Debug)]
struct Conv;

impl<B: BpNetBackwardOps> Backward<B, 3> for Conv {
    type State = (
        FloatTensor<B>,
        FloatTensor<B>,
        Option<FloatTensor<B>>,
        ConvSize,
    );

    fn backward(
        self,
        ops: Ops<Self::State, 3>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|node| node.id));
        let (input, weight, output, size) = ops.state;
        let wanted = parents.each_ref().map(Option::is_some);
        let gradients = B::conv_backward(input, weight, output, gradient, size, wanted);
        register::<B, 3>(grads, parents, gradients);
    }
}

#[derive(Debug)]
struct InstanceNorm;

impl<B: BpNetBackwardOps> Backward<B, 1> for InstanceNorm {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let (output, scale) = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |gradient| {
            B::instance_norm_backward(output, scale, gradient)
        });
    }
}

#[derive(Debug)]
struct SoftmaxRows;

impl<B: BpNetBackwardOps> Backward<B, 1> for SoftmaxRows {
    type State = FloatTensor<B>;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let output = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |gradient| {
            B::softmax_rows_backward(output, gradient)
        });
    }
}

/// Adds each gradient to that of its parent.
fn register<B: BpNetBackwardOps, const N: usize>(
    grads: &mut Gradients,
    parents: [Option<NodeId>; N],
    gradients: [Option<FloatTensor<B>>; N],
) {
    for (parent, gradient) in parents.into_iter().zip(gradients) {
        if let (Some(parent), Some(gradient)) = (parent, gradient) {
            grads.register::<B>(parent, gradient);
        }
    }
}

impl<B: BpNetBackwardOps, C: CheckpointStrategy> BpNetOps for Autodiff<B, C> {
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
                prep.finish([image, kernel], output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::blur(image, kernel)),
        }
    }

    fn conv(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        size: ConvSize,
        relu: bool,
    ) -> FloatTensor<Self> {
        let (input, input_node) = input.into_parts();
        let (weight, weight_node) = weight.into_parts();
        let (bias, bias_node) = bias.into_parts();
        match Conv
            .prepare::<C>([input_node, weight_node, bias_node])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(prep) => {
                let output = B::conv(input.clone(), weight.clone(), bias, size, relu);
                let state = (input, weight, relu.then(|| output.clone()), size);
                prep.finish(state, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::conv(input, weight, bias, size, relu)),
        }
    }

    fn instance_norm(input: FloatTensor<Self>) -> FloatTensor<Self> {
        let (input, node) = input.into_parts();
        match InstanceNorm.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (output, scale) = B::instance_norm_saved(input);
                prep.finish((output.clone(), scale), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::instance_norm(input)),
        }
    }

    fn softmax_rows(logits: FloatTensor<Self>) -> FloatTensor<Self> {
        let (logits, node) = logits.into_parts();
        match SoftmaxRows.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = B::softmax_rows(logits);
                prep.finish(output.clone(), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::softmax_rows(logits)),
        }
    }
}
