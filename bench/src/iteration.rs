//! Whole iterations, and where their time goes.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::Serialize;
use trainer::{Device, Trainer};

use crate::floor::{Counts, work};
use crate::machine::Machine;
use crate::spans::{Stage, Stages};
use crate::workload::{Blur, Workload};

type Failure = Box<dyn std::error::Error>;

/// Time of an iteration and its parts.
#[derive(Clone, Debug, Serialize)]
pub struct Breakdown {
    /// What was timed.
    pub name: String,
    /// Iterations that were timed.
    pub iterations: usize,
    /// Median of an iteration, ms.
    pub median_ms: f64,
    /// Fastest iteration, ms.
    pub fastest_ms: f64,
    /// Share of what is neither splatting nor BP-Net with its extractor and blur.
    pub rest_share: f64,
    /// The least time of all counted stages together, ms; `None` where nothing was counted.
    pub floor_ms: Option<f64>,
    /// The stages, longest first.
    pub stages: Vec<StageRow>,
}

/// One stage of an iteration.
#[derive(Clone, Debug, Serialize)]
pub struct StageRow {
    /// Name of its span.
    pub name: &'static str,
    /// Mean over the iterations, ms.
    pub ms: f64,
    /// Share of all stages.
    pub share: f64,
    /// Floating-point operations of an iteration.
    pub operations: Option<f64>,
    /// Bytes of an iteration.
    pub bytes: Option<f64>,
    /// The least time these take on the machine, as a share of the time taken.
    pub of_floor: Option<f64>,
}

/// Stages of splatting and of the blur model.
const MAIN: [&str; 18] = [
    "project",
    "rasterize",
    "rasterize backward",
    "project backward",
    "conv",
    "conv input gradient",
    "conv weight gradient",
    "relu backward",
    "instance norm",
    "instance norm backward",
    "predict",
    "predict backward",
    "upsample",
    "upsample backward",
    "composite",
    "composite backward",
    "expose",
    "expose backward",
];

/// Times `iterations` iterations of a workload, all doing the same work.
///
/// # Errors
/// The trainer refuses a step.
pub fn time_workload(
    workload: &Workload,
    device: &Device,
    machine: &Machine,
    stages: &Stages,
    iterations: usize,
) -> Result<Breakdown, Failure> {
    let mut trainer = workload.trainer(device)?;
    while trainer.iteration() + 1 < workload.first_full_iteration() {
        trainer.step()?;
    }
    let (times, spans) = time_steps(&mut trainer, device, stages, iterations)?;
    let counts = Counts::new(workload);
    let name = format!(
        "{}x{}, {} Gaussians, {}{}",
        workload.width,
        workload.height,
        workload.gaussians,
        workload.blur.name(),
        match workload.blur {
            Blur::Off | Blur::Camera => String::new(),
            Blur::Trained | Blur::Frozen | Blur::Half => format!(", K = {}", workload.kernel_size),
        }
    );
    Ok(breakdown(name, times, &spans, |stage, ms| {
        let work = work(stage, workload, &counts)?;
        let floor = machine.floor_ms(work.operations, work.bytes);
        Some((work.operations, work.bytes, floor / ms))
    }))
}

/// Steps a trainer and takes the time of every iteration, ms, and of the stages. The device has done all of an iteration when
/// its time is taken.
///
/// # Errors
/// The trainer refuses a step, or the device fails.
pub fn time_steps(
    trainer: &mut Trainer,
    device: &Device,
    stages: &Stages,
    iterations: usize,
) -> Result<(Vec<f64>, BTreeMap<&'static str, Stage>), Failure> {
    device.sync()?;
    drop(stages.take());
    let mut times = Vec::with_capacity(iterations);
    for _ in 0..iterations {
        let start = Instant::now();
        trainer.step()?;
        device.sync()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok((times, stages.take()))
}

/// A table from times. `floor` gives a stage's operations, bytes and share of the floor from its time in ms.
#[must_use]
pub fn breakdown(
    name: String,
    mut times: Vec<f64>,
    spans: &BTreeMap<&'static str, Stage>,
    floor: impl Fn(&str, f64) -> Option<(f64, f64, f64)>,
) -> Breakdown {
    times.sort_by(f64::total_cmp);
    let iterations = times.len();
    let total: f64 = spans.values().map(|s| s.time.as_secs_f64()).sum();
    let mut stages: Vec<StageRow> = spans
        .iter()
        .map(|(&name, stage)| {
            let seconds = stage.time.as_secs_f64();
            let ms = seconds * 1e3 / iterations as f64;
            let counted = floor(name, ms);
            StageRow {
                name,
                ms,
                share: seconds / total,
                operations: counted.map(|c| c.0),
                bytes: counted.map(|c| c.1),
                of_floor: counted.map(|c| c.2),
            }
        })
        .collect();
    stages.sort_by(|a, b| b.ms.total_cmp(&a.ms));
    let floors: Vec<f64> = stages
        .iter()
        .filter_map(|s| Some(s.of_floor? * s.ms))
        .collect();
    Breakdown {
        name,
        iterations,
        median_ms: times[iterations / 2],
        fastest_ms: times[0],
        rest_share: stages
            .iter()
            .filter(|s| !MAIN.contains(&s.name))
            .map(|s| s.share)
            .sum(),
        floor_ms: (!floors.is_empty()).then(|| floors.iter().sum()),
        stages,
    }
}
