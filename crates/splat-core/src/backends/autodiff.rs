//! The op as a node of a graph.

use burn::backend::autodiff::{
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{Autodiff, AutodiffBackend, tensor::FloatTensor};
use host::pass_back;

use crate::camera::Camera;
use crate::ops::{
    Blended, Collected, EXPOSE_INPUTS, INPUTS, MovingTensors, Picture, PreparedView, Projected,
    SceneTensors, SplatBackwardOps, SplatOps, Taking,
};

#[derive(Debug)]
struct Rasterize;

impl<B: SplatBackwardOps> Backward<B, INPUTS> for Rasterize {
    type State = (B::Saved, SceneTensors<B>, FloatTensor<B>);

    fn backward(
        self,
        ops: Ops<Self::State, INPUTS>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, |(saved, scene, features), gradient, wanted| {
            B::rasterize_backward(saved, scene, features, gradient, wanted)
        });
    }
}

#[derive(Debug)]
struct Expose;

impl<B: SplatBackwardOps> Backward<B, EXPOSE_INPUTS> for Expose {
    type State = (B::SavedExposure, SceneTensors<B>, MovingTensors<B>);

    fn backward(
        self,
        ops: Ops<Self::State, EXPOSE_INPUTS>,
        grads: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        pass_back::<B, _, _>(ops, grads, |(saved, scene, moving), gradient, wanted| {
            B::expose_backward(saved, scene, moving, gradient, wanted)
        });
    }
}

impl<B: SplatBackwardOps, C: CheckpointStrategy> SplatOps for Autodiff<B, C> {
    fn project(
        scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        camera: Camera,
        sh_degree: usize,
    ) -> Projected<Self> {
        let scene = scene.map::<B>(<Self as AutodiffBackend>::inner);
        let features = <Self as AutodiffBackend>::inner(features);
        match B::project(scene, features, camera, sh_degree) {
            Projected::Done(view) => {
                Projected::Done(view.map(<Self as AutodiffBackend>::from_inner))
            }
            Projected::Refused(error) => Projected::Refused(error),
        }
    }

    fn rasterize(
        view: PreparedView<Self>,
        scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        screen_grad: FloatTensor<Self>,
    ) -> Blended<Self> {
        let mut nodes = Vec::with_capacity(INPUTS);
        let mut inner = |tensor: FloatTensor<Self>| {
            let (tensor, node) = tensor.into_parts();
            nodes.push(node);
            tensor
        };
        let scene = scene.map::<B>(&mut inner);
        let features = inner(features);
        let screen_grad = inner(screen_grad);
        let view = view.map::<B>(<Self as AutodiffBackend>::inner);
        let Ok(nodes) = <[_; INPUTS]>::try_from(nodes) else {
            unreachable!("a node for every input");
        };
        match Rasterize.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => match B::rasterize_saved(view, features.clone()) {
                Ok((output, saved)) => Blended::Done(prep.finish((saved, scene, features), output)),
                Err(error) => Blended::Refused(error),
            },
            OpsKind::UnTracked(prep) => match B::rasterize(view, scene, features, screen_grad) {
                Blended::Done(output) => Blended::Done(prep.finish(output)),
                Blended::Refused(error) => Blended::Refused(error),
            },
        }
    }

    fn expose(
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        screen_grad: FloatTensor<Self>,
        taking: Taking,
    ) -> Collected<Self> {
        let mut nodes = Vec::with_capacity(EXPOSE_INPUTS);
        let mut inner = |tensor: FloatTensor<Self>| {
            let (tensor, node) = tensor.into_parts();
            nodes.push(node);
            tensor
        };
        let scene = scene.map::<B>(&mut inner);
        let moving = moving.map::<B>(&mut inner);
        let screen_grad = inner(screen_grad);
        let Ok(nodes) = <[_; EXPOSE_INPUTS]>::try_from(nodes) else {
            unreachable!("a node for every input");
        };
        let picture = |color, radii| Picture {
            color,
            radii: <Self as AutodiffBackend>::from_inner(radii),
        };
        match Expose.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                match B::expose_saved(scene.clone(), moving.clone(), &taking) {
                    Ok((Picture { color, radii }, saved)) => {
                        let color = prep.finish((saved, scene, moving), color);
                        Collected::Done(picture(color, radii))
                    }
                    Err(error) => Collected::Refused(error),
                }
            }
            OpsKind::UnTracked(prep) => match B::expose(scene, moving, screen_grad, taking) {
                Collected::Done(Picture { color, radii }) => {
                    Collected::Done(picture(prep.finish(color), radii))
                }
                Collected::Refused(error) => Collected::Refused(error),
            },
        }
    }
}
