//! Operations and bytes of every stage of an iteration, counted by hand: what cannot be done with less.

use splat_core::cpu::{View, project};

use crate::pairs::count_pairs;
use crate::workload::{Blur, SAMPLES, Workload};

/// Floating-point operations and bytes that have to be moved between memory and a core.
#[derive(Clone, Copy, Debug, Default)]
pub struct Work {
    /// Additions, multiplications, comparisons; an exponential counts as 17, a division or root as 1.
    pub operations: f64,
    /// Each input read once and each output written once, f32.
    pub bytes: f64,
}

/// Bytes of an f32.
const F32: f64 = 4.0;
/// Numbers of a Gaussian: mean, quaternion, scales, opacity, 48 SH coefficients.
const PARAMETERS: f64 = 59.0;

/// What the work depends on beside the workload's sizes.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// Gaussians that are drawn.
    pub visible: f64,
    /// Pairs of a Gaussian and a tile.
    pub slots: f64,
    /// Pairs of a Gaussian and a pixel that count.
    pub pairs: f64,
}

impl Counts {
    /// Counts for the Gaussians of a workload as they start.
    #[must_use]
    pub fn new(workload: &Workload) -> Self {
        let g = workload.gaussians();
        let splats = g.slices();
        let view = View::new(&workload.camera(), &glam::DAffine3::IDENTITY, 3);
        let projection = project(&splats, &view).expect("the Gaussians of a workload are good");
        Self {
            visible: projection.num_visible() as f64,
            slots: projection.num_slots() as f64,
            pairs: count_pairs(&g, &workload.camera()) as f64,
        }
    }
}

/// The stages of an iteration that [`work`] counts.
#[must_use]
pub fn stages(blur: Blur) -> Vec<&'static str> {
    let always = [
        "project",
        "rasterize",
        "rasterize backward",
        "image loss",
        "adam",
        "check gradients",
    ];
    let kernels = [
        "conv",
        "instance norm",
        "predict",
        "predict backward",
        "composite",
        "composite backward",
    ];
    let learning = [
        "conv input gradient",
        "conv weight gradient",
        "relu backward",
        "instance norm backward",
    ];
    let half = ["upsample", "upsample backward"];
    // Where the camera is modelled, the loss goes back through the exposure, and not through the sharp render.
    let sharp = ["project backward"];
    let camera = ["expose", "expose backward"];
    let more: &[&[&str]] = match blur {
        Blur::Off => &[&sharp],
        Blur::Trained => &[&sharp, &kernels, &learning],
        Blur::Frozen => &[&sharp, &kernels],
        Blur::Half => &[&sharp, &kernels, &learning, &half],
        Blur::Camera => &[&camera],
    };
    [&always[..], &more.concat()].concat()
}

/// What the stages of an iteration move and compute at least.
#[must_use]
pub fn work_of(workload: &Workload) -> Vec<Work> {
    let counts = Counts::new(workload);
    let names = stages(workload.blur).into_iter();
    names
        .filter_map(|stage| work(stage, workload, &counts))
        .collect()
}

/// The work of a stage by the name of its span; `None` for what only moves things about.
#[must_use]
pub fn work(stage: &str, workload: &Workload, counts: &Counts) -> Option<Work> {
    let n = workload.gaussians as f64;
    let pixels = (workload.width * workload.height) as f64;
    // Where features and kernels are computed.
    let half = if workload.blur == Blur::Half {
        4.0
    } else {
        1.0
    };
    let small = pixels / half;
    let entries = (workload.kernel_size * workload.kernel_size) as f64;
    let per_pixel = |operations: f64, floats: f64, pixels: f64| Work {
        operations: operations * pixels,
        bytes: floats * F32 * pixels,
    };
    // Multiply-adds per pixel: of the extractor's three convolutions, and of BP-Net's layers.
    let convolutions = [125.0 * 64.0, 1600.0 * 64.0, 576.0 * 32.0];
    let base = 48.0 * 64.0 + 2.0 * 96.0 * 64.0;
    let heads = 64.0 * (entries + 1.0);
    let work = match stage {
        "project" => Work {
            operations: 470.0 * counts.visible,
            bytes: F32 * (PARAMETERS * n + 13.0 * counts.visible + 2.0 * counts.slots),
        },
        "rasterize" => Work {
            operations: 38.0 * counts.pairs,
            bytes: F32 * (13.0 * counts.slots + 7.0 * pixels),
        },
        "rasterize backward" => {
            // The sharp render, or every sample of an exposure.
            let renders = match workload.blur {
                Blur::Camera => SAMPLES as f64,
                Blur::Off | Blur::Trained | Blur::Frozen | Blur::Half => 1.0,
            };
            Work {
                operations: renders * 65.0 * counts.pairs,
                bytes: renders * F32 * (23.0 * counts.slots + 7.0 * pixels),
            }
        }
        // What the samples share is read once; each projects, blends three channels and turns them into light.
        "expose" => Work {
            operations: SAMPLES as f64
                * (240.0 * counts.visible + 34.0 * counts.pairs + 90.0 * pixels),
            bytes: F32
                * (PARAMETERS * n
                    + SAMPLES as f64
                        * (13.0 * counts.visible + 15.0 * counts.slots + 3.0 * pixels)),
        },
        "expose backward" => Work {
            operations: SAMPLES as f64 * (500.0 * counts.visible + 60.0 * pixels),
            bytes: F32 * (SAMPLES as f64 * 9.0 * counts.slots + 2.0 * PARAMETERS * n),
        },
        "project backward" => Work {
            operations: 900.0 * counts.visible,
            bytes: F32 * (10.0 * counts.slots + 2.0 * PARAMETERS * n),
        },
        "conv" => per_pixel(
            2.0 * convolutions.iter().sum::<f64>(),
            5.0 + 64.0 * 4.0 + 32.0,
            small,
        ),
        "conv input gradient" => per_pixel(
            2.0 * (convolutions[1] + convolutions[2]),
            64.0 * 3.0 + 32.0,
            small,
        ),
        "conv weight gradient" => per_pixel(
            2.0 * convolutions.iter().sum::<f64>(),
            5.0 + 64.0 * 4.0 + 32.0,
            small,
        ),
        "relu backward" => per_pixel(128.0, 3.0 * 128.0, small),
        "instance norm" => per_pixel(2.0 * 64.0 * 8.0, 2.0 * 2.0 * 64.0, small),
        "instance norm backward" => per_pixel(2.0 * 64.0 * 9.0, 2.0 * 3.0 * 64.0, small),
        "predict" => per_pixel(2.0 * (base + heads) + 22.0 * entries, 33.0 + entries, small),
        // The hidden layers are computed again: that is this program's choice, and not in the floor.
        "predict backward" => {
            let first = if workload.blur == Blur::Frozen {
                48.0 * 64.0
            } else {
                16.0 * 64.0
            };
            per_pixel(
                2.0 * (2.0 * (base + heads) - first),
                66.0 + 2.0 * entries,
                small,
            )
        }
        "upsample" | "upsample backward" => per_pixel(
            8.0 * (entries + 1.0),
            (entries + 1.0) * (1.0 + 1.0 / half),
            pixels,
        ),
        "composite" => per_pixel(12.0 * entries, entries + 11.0, pixels),
        "composite backward" => per_pixel(26.0 * entries, 2.0 * entries + 15.0, pixels),
        // Five statistics and three derivatives, each along two axes with 11 taps; three channels.
        "image loss" => per_pixel(3.0 * (8.0 * 44.0 + 60.0), 3.0 * 3.0, pixels),
        "adam" => Work {
            operations: 14.0 * PARAMETERS * n,
            bytes: F32 * 7.0 * PARAMETERS * n,
        },
        "check gradients" => Work {
            operations: PARAMETERS * n,
            bytes: F32 * PARAMETERS * n,
        },
        _ => return None,
    };
    Some(work)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use trainer::Device;

    use super::*;
    use crate::spans::Stages;

    #[test]
    fn the_stages_are_those_that_an_iteration_enters() {
        for blur in Blur::ALL {
            let workload = Workload {
                width: 32,
                height: 24,
                gaussians: 100,
                blur,
                kernel_size: 3,
            };
            let counts = Counts::new(&workload);
            let mut trainer = workload
                .trainer_at_work(&Device::flex())
                .expect("a small trainer");
            let spans = Stages::default();
            tracing::subscriber::with_default(spans.clone(), || trainer.step())
                .expect("an iteration");
            let counted = |stage: &&str| work(stage, &workload, &counts).is_some();
            let entered: BTreeSet<_> = spans.take().into_keys().filter(counted).collect();
            assert_eq!(
                entered,
                BTreeSet::from_iter(stages(blur)),
                "{}",
                blur.name()
            );
        }
    }
}
