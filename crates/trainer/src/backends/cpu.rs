//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use burn::backend::{TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::Shape;
use host::{HostBackend, HostFloat, Real as _, tensor, with_float};

use crate::cpu::adam::{self, AdamUpdate};
use crate::cpu::{depth, detail, mask, reduce, ssim};
use crate::ops::{AdamTensors, DepthTargets, ImageLossBackwardOps, ImageLossOps, TrainerOps};

macro_rules! host_ops {
    ($backend:ty) => {
        impl TrainerOps for $backend {
            fn adam(
                tensors: AdamTensors<Self>,
                gradient: FloatTensor<Self>,
                update: AdamUpdate,
            ) -> AdamTensors<Self> {
                with_float!(gradient.dtype(), T => adam_on::<T, Self>(tensors, gradient, &update))
            }

            fn depth_targets(
                depth: FloatTensor<Self>,
                alpha: FloatTensor<Self>,
                given: FloatTensor<Self>,
                scene_size: f64,
            ) -> DepthTargets<Self> {
                with_float!(depth.dtype(), T => depth_targets_on::<T, Self>(depth, alpha, given, scene_size))
            }

            fn mask_weights(
                rendered: FloatTensor<Self>,
                target: FloatTensor<Self>,
                valid: Option<&[bool]>,
                band: usize,
            ) -> FloatTensor<Self> {
                with_float!(rendered.dtype(), T => mask_weights_on::<T, Self>(rendered, target, valid, band))
            }

            fn squared_error(
                mut a: FloatTensor<Self>,
                mut b: FloatTensor<Self>,
                valid: Option<&[bool]>,
            ) -> FloatTensor<Self> {
                with_float!(a.dtype(), T => {
                    let sums = reduce::squared_error(
                        &Self::elements::<T>(&mut a),
                        &Self::elements::<T>(&mut b),
                        valid,
                    );
                    tensor::<T, Self>(sums.map(T::of).to_vec(), [2], &a)
                })
            }
        }

        impl ImageLossOps for $backend {
            fn image_loss(
                a: FloatTensor<Self>,
                b: FloatTensor<Self>,
                weights: [f64; 2],
            ) -> FloatTensor<Self> {
                with_float!(a.dtype(), T => image_loss_on::<T, Self>(a, b, weights, false)).0
            }

            fn detail_loss(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(a.dtype(), T => detail_loss_on::<T, Self>(a, b, false)).0
            }
        }

        impl ImageLossBackwardOps for $backend {
            fn image_loss_and_gradient(
                a: FloatTensor<Self>,
                b: FloatTensor<Self>,
                weights: [f64; 2],
            ) -> (FloatTensor<Self>, FloatTensor<Self>) {
                let (value, gradient) =
                    with_float!(a.dtype(), T => image_loss_on::<T, Self>(a, b, weights, true));
                (value, gradient.expect("it was wanted"))
            }

            fn detail_loss_and_gradient(
                a: FloatTensor<Self>,
                b: FloatTensor<Self>,
            ) -> (FloatTensor<Self>, FloatTensor<Self>) {
                let (value, gradient) =
                    with_float!(a.dtype(), T => detail_loss_on::<T, Self>(a, b, true));
                (value, gradient.expect("it was wanted"))
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

fn adam_on<T: HostFloat, B: HostBackend>(
    tensors: AdamTensors<B>,
    mut gradient: FloatTensor<B>,
    update: &AdamUpdate,
) -> AdamTensors<B> {
    let mut parameter = B::into_elements::<T>(tensors.parameter);
    let mut moment1 = B::into_elements::<T>(tensors.moment1);
    let mut moment2 = B::into_elements::<T>(tensors.moment2);
    let values = B::elements::<T>(&mut gradient);
    adam::adam(
        &mut parameter,
        &values,
        [&mut moment1, &mut moment2],
        update,
    );
    drop(values);
    let tensor = |values| tensor::<T, B>(values, gradient.shape(), &gradient);
    AdamTensors {
        parameter: tensor(parameter),
        moment1: tensor(moment1),
        moment2: tensor(moment2),
    }
}

fn depth_targets_on<T: HostFloat, B: HostBackend>(
    mut depth: FloatTensor<B>,
    mut alpha: FloatTensor<B>,
    mut given: FloatTensor<B>,
    scene_size: f64,
) -> DepthTargets<B> {
    let targets = depth::depth_targets(
        &B::elements::<T>(&mut depth),
        &B::elements::<T>(&mut alpha),
        &B::elements::<T>(&mut given),
        scene_size,
    );
    let [per_alpha, wanted, weight] =
        targets.map(|values| tensor::<T, B>(values, depth.shape(), &depth));
    DepthTargets {
        per_alpha,
        wanted,
        weight,
    }
}

fn mask_weights_on<T: HostFloat, B: HostBackend>(
    mut rendered: FloatTensor<B>,
    mut target: FloatTensor<B>,
    valid: Option<&[bool]>,
    band: usize,
) -> FloatTensor<B> {
    let shape = rendered.shape();
    let weights = mask::mask_weights(
        &B::elements::<T>(&mut rendered),
        &B::elements::<T>(&mut target),
        valid,
        [shape[0], shape[1]],
        band,
    );
    tensor::<T, B>(weights, shape, &rendered)
}

fn image_loss_on<T: HostFloat, B: HostBackend>(
    mut a: FloatTensor<B>,
    mut b: FloatTensor<B>,
    weights: [f64; 2],
    wanted: bool,
) -> (FloatTensor<B>, Option<FloatTensor<B>>) {
    let shape = a.shape();
    let loss = ssim::image_loss(
        &B::elements::<T>(&mut a),
        &B::elements::<T>(&mut b),
        [shape[0], shape[1]],
        weights,
        wanted,
    );
    as_tensors::<T, B>(loss, &a)
}

fn detail_loss_on<T: HostFloat, B: HostBackend>(
    mut a: FloatTensor<B>,
    mut b: FloatTensor<B>,
    wanted: bool,
) -> (FloatTensor<B>, Option<FloatTensor<B>>) {
    let shape = a.shape();
    let loss = detail::detail_loss(
        &B::elements::<T>(&mut a),
        &B::elements::<T>(&mut b),
        [shape[0], shape[1]],
        wanted,
    );
    as_tensors::<T, B>(loss, &a)
}

/// A loss `[1]`, and its gradient, which has the shape of `like`.
fn as_tensors<T: HostFloat, B: HostBackend>(
    (value, gradient): (f64, Option<Vec<T>>),
    like: &FloatTensor<B>,
) -> (FloatTensor<B>, Option<FloatTensor<B>>) {
    (
        tensor::<T, B>(vec![T::of(value)], Shape::from([1]), like),
        gradient.map(|values| tensor::<T, B>(values, like.shape(), like)),
    )
}
