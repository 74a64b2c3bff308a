//! What an iteration launches, moves and waits for, and the bound that follows: `limpid-bench launches`.

use std::fmt::Write as _;

use serde::Serialize;
use trainer::{Gpu, TrainError};

use super::adapter::Adapter;
use super::counted::{Counted, count};
use crate::bound::{Bound, CARDS, WAIT_US, range};
use crate::floor::work_of;
use crate::spans::Stages;
use crate::workload::{Blur, Workload};

/// What iterations of one size launch.
#[derive(Clone, Debug, Serialize)]
pub struct Launches {
    /// What it was counted on. Counts depend on it only where a kernel is picked for a device.
    pub adapter: Adapter,
    /// Width and height of the pictures, px.
    pub size: [usize; 2],
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Iterations with several blur models.
    pub iterations: Vec<Iteration>,
}

/// What an iteration launches, moves and waits for.
#[derive(Clone, Debug, Serialize)]
pub struct Iteration {
    /// The blur model.
    pub blur: &'static str,
    /// Launches and waits.
    pub counted: Counted,
    /// Bytes that its stages move at least, each input read once and each output written once.
    pub bytes: f64,
    /// Operations that they need.
    pub operations: f64,
    /// COMPUTED, NOT MEASURED: its least time on some GPUs.
    pub bounds: Vec<Bound>,
}

/// Counts iterations without a blur model, with kernels and with the camera. `stages` must be the program's subscriber.
///
/// # Errors
/// The trainer refuses the sizes or a step.
pub fn count_launches(
    gpu: &Gpu,
    stages: &Stages,
    size: [usize; 2],
    gaussians: usize,
) -> Result<Launches, TrainError> {
    let mut iterations = Vec::new();
    for blur in [Blur::Off, Blur::Trained, Blur::Camera] {
        eprintln!("{}", blur.name());
        let workload = Workload {
            width: size[0],
            height: size[1],
            gaussians,
            blur,
            kernel_size: 9,
        };
        iterations.push(count_iteration(gpu, stages, &workload)?);
    }
    Ok(Launches {
        adapter: Adapter::of(gpu),
        size,
        gaussians,
        iterations,
    })
}

fn count_iteration(
    gpu: &Gpu,
    spans: &Stages,
    workload: &Workload,
) -> Result<Iteration, TrainError> {
    let mut trainer = workload.trainer_at_work(&gpu.device)?;
    trainer.step()?;
    let (step, counted) = count(spans, || trainer.step());
    step?;
    let work = work_of(workload);
    let bounds = CARDS
        .iter()
        .map(|card| card.bound(&work, counted.launches, counted.waits))
        .collect();
    Ok(Iteration {
        blur: workload.blur.name(),
        counted,
        bytes: work.iter().map(|w| w.bytes).sum(),
        operations: work.iter().map(|w| w.operations).sum(),
        bounds,
    })
}

impl Launches {
    /// All tables in Markdown.
    ///
    /// # Errors
    /// None: writing into a string cannot fail, but its interface says it could.
    pub fn tables(&self) -> Result<String, std::fmt::Error> {
        let mut out = self.adapter.title();
        let [width, height] = self.size;
        write!(
            out,
            "\nAn iteration at {width}x{height} with {} Gaussians\n\n\
             | | launches | waits | MB moved at least | GFLOP |\n|---|---|---|---|---|\n",
            self.gaussians
        )?;
        for i in &self.iterations {
            writeln!(
                out,
                "| {} | {} | {} | {:.0} | {:.2} |",
                i.blur,
                i.counted.launches,
                i.counted.waits,
                i.bytes * 1e-6,
                i.operations * 1e-9
            )?;
        }
        write!(
            out,
            "\nCOMPUTED, NOT MEASURED, ms: the least time of an iteration, if a wait takes {} to {} µs.\n\n\
             | | GPU | runtime | work | launches | waits | at least |\n|---|---|---|---|---|---|---|\n",
            WAIT_US[0], WAIT_US[1]
        )?;
        for i in &self.iterations {
            for b in &i.bounds {
                writeln!(
                    out,
                    "| {} | {} | {} | {:.2} | {} | {} | {} |",
                    i.blur,
                    b.card,
                    b.runtime,
                    b.work_ms,
                    range(b.launch_ms),
                    range(b.wait_ms),
                    range(b.total_ms)
                )?;
            }
        }
        for i in &self.iterations {
            let tables = [("kernel", &i.counted.kernels), ("span", &i.counted.stages)];
            for (what, rows) in tables {
                write!(out, "\n{}\n\n| {what} | launches |\n|---|---|\n", i.blur)?;
                for row in rows {
                    writeln!(out, "| {} | {} |", row.name, row.launches)?;
                }
                writeln!(out, "| all | {} |", i.counted.launches)?;
            }
        }
        Ok(out)
    }
}
