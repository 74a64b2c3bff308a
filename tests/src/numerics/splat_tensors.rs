//! The splatting ops as tensors on a device, on the inputs of `splat.rs`, whose other runs call the CPU's kernels.

use super::case::{Place, Results, weigh};
use crate::{tensor, values};
use burn::tensor::Tensor;
use splat_core::{Camera, Exposure, Extra, Movers, Splats, Transfer, Viewpoint};

/// Seed of the gradient that goes back.
pub(super) const WEIGHTS: u64 = 8;
/// Samples of an exposure.
pub(super) const SAMPLES: usize = 3;

/// A tensor with gradients for each of the inputs, as a table of so many columns.
fn tables(inputs: &[Vec<f64>], columns: &[usize], place: &Place) -> Vec<Tensor<2>> {
    let (device, dtype) = place.options();
    let table = |(values, columns): (&Vec<f64>, &usize)| {
        tensor(values, [values.len() / columns, *columns], &device, dtype).require_grad()
    };
    inputs.iter().zip(columns).map(table).collect()
}

/// A picture's sum with the fixed weights goes back.
fn results<const D: usize>(
    forward: Vec<(&'static str, Vec<f64>)>,
    output: Tensor<D>,
    inputs: Vec<(&'static str, &Tensor<2>)>,
) -> Results {
    let gradients = weigh(output, WEIGHTS).backward();
    let gradient = |(name, tensor): (&'static str, &Tensor<2>)| {
        let zeros = || vec![0.0; tensor.dims().iter().product()];
        (name, tensor.grad(&gradients).map_or_else(zeros, values))
    };
    Results {
        forward,
        backward: inputs.into_iter().map(gradient).collect(),
    }
}

pub(super) fn render(inputs: &[Vec<f64>], camera: &Camera, place: &Place) -> Results {
    let t = tables(inputs, &[3, 4, 9, 3, 1, 48, 1, 4], place);
    let [moving, _] = t[2].dims();
    let splats = Splats {
        means: t[0].clone(),
        quats: t[1].clone(),
        left_rotations: (moving > 0).then(|| t[2].clone().reshape([moving, 3, 3])),
        log_scales: t[3].clone(),
        opacity_logits: t[4].clone(),
        sh: t[5].clone(),
    };
    let view = Viewpoint {
        camera: camera.clone(),
        cam_from_world: t[7].clone(),
        sh_degree: 3,
    };
    let extra = Extra {
        features: Some(t[6].clone()),
        screen_grad: None,
    };
    let rendered = splat_core::render(splats, &view, extra).expect("finite input");
    let forward = vec![
        ("colour", values(rendered.color())),
        ("alpha", values(rendered.alpha())),
        ("depth", values(rendered.depth())),
        ("feature", values(rendered.features().expect("one"))),
    ];
    let names = [
        "means",
        "quats",
        "left_rotations",
        "log_scales",
        "opacity_logits",
        "sh",
        "features",
        "pose",
    ];
    let inputs = names.into_iter().zip(&t).collect();
    results(forward, rendered.output().clone(), inputs)
}

pub(super) fn expose(inputs: &[Vec<f64>], camera: &Camera, place: &Place) -> Results {
    let t = tables(inputs, &[3, 4, 3, 1, 48, 4, 4, 3, 9], place);
    let splats = Splats {
        means: t[0].clone(),
        quats: t[1].clone(),
        left_rotations: None,
        log_scales: t[2].clone(),
        opacity_logits: t[3].clone(),
        sh: t[4].clone(),
    };
    let view = Viewpoint {
        camera: camera.clone(),
        cam_from_world: t[5].clone(),
        sh_degree: 3,
    };
    let moving = t[7].dims()[0] / SAMPLES;
    let exposure = Exposure {
        poses: t[6].clone().reshape([SAMPLES, 3, 4]),
        movers: (moving > 0).then(|| Movers {
            means: t[7].clone().reshape([SAMPLES, moving, 3]),
            left_rotations: t[8].clone().reshape([SAMPLES, moving, 3, 3]),
        }),
        transfer: Transfer::Srgb,
    };
    let exposed = splat_core::expose(splats, &view, exposure, None).expect("finite input");
    let forward = vec![("colour", values(exposed.color.clone()))];
    let names = [
        "means",
        "quats",
        "log_scales",
        "opacity_logits",
        "sh",
        "pose",
        "poses",
        "moving_means",
        "left_rotations",
    ];
    let inputs = names.into_iter().zip(&t).collect();
    results(forward, exposed.color, inputs)
}
