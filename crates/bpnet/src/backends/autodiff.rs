//! The ops as nodes of a graph: each saves what its backward needs.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind, unary},
};
use burn::backend::{Autodiff, tensor::FloatTensor};
use host::pass_back;

use crate::cpu::conv::ConvSize;
use crate::cpu::predict::PredictSize;
use crate::cpu::upsample::UpsampleSize;
use crate::ops::{BpNetBackwardOps, BpNetOps, PREDICTOR, Predictor};

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
        pass_back::<B, _, _>(
            ops,
            grads,
            |(input, weight, output, size), gradient, wanted| {
                B::conv_backward(input, weight, output, gradient, size, wanted)
            },
        );
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
struct Predict;

impl<B: BpNetBackwardOps> Backward<B, PREDICTOR> for Predict {
    type State = (Predictor<B>, FloatTensor<B>, PredictSize);

    fn backward(
        self,
        ops: Ops<Self::State, PREDICTOR>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, |(predictor, output, size), gradient, wanted| {
            B::predict_backward(predictor, output, gradient, size, wanted)
        });
    }
}

#[derive(Debug)]
struct Upsample;

impl<B: BpNetBackwardOps> Backward<B, 1> for Upsample {
    type State = UpsampleSize;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let size = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |gradient| {
            B::upsample_backward(gradient, size)
        });
    }
}

#[derive(Debug)]
struct Composite;

impl<B: BpNetBackwardOps> Backward<B, 2> for Composite {
    type State = [FloatTensor<B>; 2];

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, |[image, field], gradient, wanted| {
            B::composite_backward(image, field, gradient, wanted)
        });
    }
}

impl<B: BpNetBackwardOps, C: CheckpointStrategy> BpNetOps for Autodiff<B, C> {
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

    fn predict(predictor: Predictor<Self>, size: PredictSize) -> FloatTensor<Self> {
        let mut nodes = Vec::with_capacity(PREDICTOR);
        let mut inner = |tensor: FloatTensor<Self>| {
            let (tensor, node) = tensor.into_parts();
            nodes.push(node);
            tensor
        };
        // In the order of `Predictor::into_array`.
        let predictor = Predictor::<B> {
            features: inner(predictor.features),
            weight0: inner(predictor.weight0),
            bias0: inner(predictor.bias0),
            weight1: inner(predictor.weight1),
            bias1: inner(predictor.bias1),
            weight2: inner(predictor.weight2),
            bias2: inner(predictor.bias2),
            kernel_weight: inner(predictor.kernel_weight),
            kernel_bias: inner(predictor.kernel_bias),
            intensity_weight: inner(predictor.intensity_weight),
            intensity_bias: inner(predictor.intensity_bias),
        };
        let Ok(nodes) = <[_; PREDICTOR]>::try_from(nodes) else {
            unreachable!("a node for every tensor");
        };
        match Predict.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = B::predict(predictor.clone(), size);
                prep.finish((predictor, output.clone(), size), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::predict(predictor, size)),
        }
    }

    fn upsample(input: FloatTensor<Self>, size: UpsampleSize) -> FloatTensor<Self> {
        let (input, node) = input.into_parts();
        match Upsample.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(size, B::upsample(input, size)),
            OpsKind::UnTracked(prep) => prep.finish(B::upsample(input, size)),
        }
    }

    fn composite(image: FloatTensor<Self>, field: FloatTensor<Self>) -> FloatTensor<Self> {
        let (image, image_node) = image.into_parts();
        let (field, field_node) = field.into_parts();
        match Composite
            .prepare::<C>([image_node, field_node])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(prep) => {
                let output = B::composite(image.clone(), field.clone());
                prep.finish([image, field], output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::composite(image, field)),
        }
    }
}
