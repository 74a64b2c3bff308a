//! The splatting ops as tensors on a device, on the inputs of `splat.rs`, whose other runs call the CPU's kernels.

use super::case::{Place, Results, weigh};
use crate::{tensor, values};
use burn::tensor::Tensor;
use splat_core::{Camera, Exposure, Extra, Movers, Splats, Transfer, Viewpoint};

/// Seed of the gradient that goes back.
pub(super) const WEIGHTS: u64 = 8;
/// Samples of an exposure.
pub(super) const SAMPLES: usize = 3;

/// The inputs of a render by name, and how many columns they have as tables.
const RENDER: [(&str, usize); 8] = [
    ("means", 3),
    ("quats", 4),
    ("left_rotations", 9),
    ("log_scales", 3),
    ("opacity_logits", 1),
    ("sh", 48),
    ("features", 1),
    ("pose", 4),
];
/// The same of an exposure.
const EXPOSURE: [(&str, usize); 9] = [
    ("means", 3),
    ("quats", 4),
    ("log_scales", 3),
    ("opacity_logits", 1),
    ("sh", 48),
    ("pose", 4),
    ("poses", 4),
    ("moving_means", 3),
    ("left_rotations", 9),
];

/// A table with gradients for each of the inputs.
fn tables(inputs: &[Vec<f64>], of: &[(&str, usize)], place: &Place) -> Vec<Tensor<2>> {
    let (device, dtype) = place.options();
    let table = |(values, (_, columns)): (&Vec<f64>, &(&str, usize))| {
        tensor(values, [values.len() / columns, *columns], &device, dtype).require_grad()
    };
    inputs.iter().zip(of).map(table).collect()
}

/// A picture's sum with the fixed weights goes back to the tables.
fn results<const D: usize>(
    forward: Vec<(&'static str, Vec<f64>)>,
    output: Tensor<D>,
    of: &[(&'static str, usize)],
    tables: &[Tensor<2>],
) -> Results {
    let gradients = weigh(output, WEIGHTS).backward();
    let gradient = |((name, _), table): (&(&'static str, usize), &Tensor<2>)| {
        let zeros = || vec![0.0; table.dims().iter().product()];
        (*name, table.grad(&gradients).map_or_else(zeros, values))
    };
    Results {
        forward,
        backward: of.iter().zip(tables).map(gradient).collect(),
    }
}

pub(super) fn render(inputs: &[Vec<f64>], camera: &Camera, place: &Place) -> Results {
    let t = tables(inputs, &RENDER, place);
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
    results(forward, rendered.output().clone(), &RENDER, &t)
}

pub(super) fn expose(inputs: &[Vec<f64>], camera: &Camera, place: &Place) -> Results {
    let t = tables(inputs, &EXPOSURE, place);
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
    results(forward, exposed.color, &EXPOSURE, &t)
}
