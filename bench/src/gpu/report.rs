//! All that is timed on a GPU: `cargo xtask bench --backend wgpu`.

use std::fmt::Write as _;
use std::time::Instant;

use bpnet::Extractor;
use serde::Serialize;
use trainer::{Device, Gpu, MemoryUse, Trainer};

use super::adapter::Adapter;
use super::counted::{Counted, count};
use super::parts::{Outcome, Times, time_exposure, time_rasteriser, time_render};
use crate::bound::{Bound, Card, range};
use crate::floor::work_of;
use crate::iteration::time_steps;
use crate::net::time_net;
use crate::spans::Stages;
use crate::workload::{Blur, Workload};

type Failure = Box<dyn std::error::Error>;

/// Everything that was timed.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// What it was timed on.
    pub adapter: Adapter,
    /// Renders, exposures, and extractor, BP-Net and blur with K = 9.
    pub parts: Vec<Tried<Times>>,
    /// Whole iterations.
    pub iterations: Vec<Tried<Iteration>>,
    /// What was hoped for, and what came of it; at full size alone.
    pub goals: Vec<Goal>,
    /// The device's memory at the end.
    pub memory: Option<MemoryUse>,
}

/// Something of a size, and what came of it.
#[derive(Clone, Debug, Serialize)]
pub struct Tried<T> {
    /// What it is, with its size.
    pub name: String,
    /// What came of it.
    pub outcome: Outcome<T>,
}

/// A whole training iteration.
#[derive(Clone, Debug, Serialize)]
pub struct Iteration {
    /// Each by itself: the device has ended one before the next begins.
    pub alone: Times,
    /// Mean of as many in a row, as in training, ms.
    pub in_a_row_ms: f64,
    /// What one launches and waits for.
    pub counted: Counted,
    /// COMPUTED, NOT MEASURED: its least time, on a card that a bound is given for.
    pub bound: Option<Bound>,
    /// The device's memory after the first iterations.
    pub memory_warm: Option<MemoryUse>,
    /// The device's memory after the last.
    pub memory: Option<MemoryUse>,
}

/// Something that was hoped for, as a number.
#[derive(Clone, Debug, Serialize)]
pub struct Goal {
    /// What, and in which unit.
    pub what: &'static str,
    /// What was found; `None` where the device refused.
    pub found: Option<f64>,
    /// What it is held against.
    pub goal: f64,
    /// Whether it was reached.
    pub is_reached: bool,
}

/// Renders a second: ten times those that the paper names.
const RENDERS: f64 = 650.0;
/// Minutes of 40,000 iterations, and seconds of 3,000.
const MINUTES: f64 = 10.0;
const SECONDS: f64 = 40.0;

/// So many iterations compile kernels and find buffers before others are timed.
const WARM: usize = 2;

/// The sizes of a run.
struct Sizes {
    /// Of renders alone, exposures, BP-Net and iterations: width, height, Gaussians.
    scene: (usize, usize, usize),
    /// Of the pictures of the rasteriser.
    pictures: &'static [(usize, usize)],
    /// Of its scenes.
    gaussians: &'static [usize],
    /// Of what is repeated.
    repeats: usize,
}

/// What the paper's renderer is held against.
const FULL: Sizes = Sizes {
    scene: (512, 288, 100_000),
    pictures: &[(512, 288), (1920, 1080)],
    gaussians: &[10_000, 100_000, 1_000_000],
    repeats: 40,
};

/// Small enough for a GPU that a CPU plays.
const QUICK: Sizes = Sizes {
    scene: (32, 18, 500),
    pictures: &[(32, 18), (64, 36)],
    gaussians: &[500, 2_000],
    repeats: 3,
};

/// Times all. `stages` must be the program's subscriber. What the device refuses is noted, and the rest goes on.
#[must_use]
pub fn time_all(gpu: &Gpu, stages: &Stages, quick: bool) -> Report {
    let sizes = if quick { QUICK } else { FULL };
    let (device, repeats) = (&gpu.device, sizes.repeats);
    let scene = |blur| workload(sizes.scene, blur);
    let mut parts = vec![
        tried("render without a graph", scene(Blur::Off), |w| {
            time_render(w, device, repeats)
        }),
        tried("exposure of 8 samples and back", scene(Blur::Off), |w| {
            time_exposure(w, device, repeats)
        }),
    ];
    for &(width, height) in sizes.pictures {
        for &gaussians in sizes.gaussians {
            let size = workload((width, height, gaussians), Blur::Off);
            for (name, back) in [("forward", false), ("forward and backward", true)] {
                parts.push(tried(name, size, |w| {
                    time_rasteriser(w, device, repeats, back)
                }));
            }
        }
    }
    parts.push(tried("BP-Net and back", scene(Blur::Trained), |w| {
        let times = time_net([w.width, w.height], Extractor::Trained, device, repeats)?;
        Ok(Times {
            median_ms: times.median_ms,
            fastest_ms: times.fastest_ms,
            repeats,
        })
    }));
    let iterations = [Blur::Off, Blur::Trained, Blur::Camera].map(|blur| {
        let name = format!("iteration, {}", blur.name());
        tried(&name, scene(blur), |w| {
            time_iteration(gpu, stages, w, repeats)
        })
    });
    let goals = if quick {
        Vec::new()
    } else {
        goals(&parts[0], &iterations)
    };
    Report {
        adapter: Adapter::of(gpu),
        parts,
        iterations: iterations.into(),
        goals,
        memory: gpu.memory_use(),
    }
}

/// Goals of a render and of iterations without a blur model, with kernels and with the camera. Of a training only its iterations
/// count: its start, its trials and density control are left out.
fn goals(render: &Tried<Times>, iterations: &[Tried<Iteration>; 3]) -> Vec<Goal> {
    let renders = render.outcome.timed().map(|times| 1e3 / times.median_ms);
    let [_, kernels, camera] = iterations.each_ref().map(|i| {
        let timed = i.outcome.timed();
        timed.map(|i| i.in_a_row_ms)
    });
    let at_most = |what, found: Option<f64>, goal: f64| Goal {
        what,
        found,
        goal,
        is_reached: found.is_some_and(|found| found <= goal),
    };
    let minutes = |ms: Option<f64>| ms.map(|ms| ms * 40_000.0 / 60e3);
    let seconds = |ms: Option<f64>| ms.map(|ms| ms * 3.0);
    vec![
        Goal {
            what: "renders a second, at least",
            found: renders,
            goal: RENDERS,
            is_reached: renders.is_some_and(|found| found >= RENDERS),
        },
        at_most(
            "40,000 iterations with kernels, minutes",
            minutes(kernels),
            MINUTES,
        ),
        at_most(
            "40,000 iterations with the camera, minutes",
            minutes(camera),
            MINUTES,
        ),
        at_most(
            "3,000 iterations with kernels, s",
            seconds(kernels),
            SECONDS,
        ),
        at_most(
            "3,000 iterations with the camera, s",
            seconds(camera),
            SECONDS,
        ),
    ]
}

fn workload((width, height, gaussians): (usize, usize, usize), blur: Blur) -> Workload {
    Workload {
        width,
        height,
        gaussians,
        blur,
        kernel_size: 9,
    }
}

fn tried<T>(
    name: &str,
    workload: Workload,
    piece: impl FnOnce(&Workload) -> Result<T, Failure>,
) -> Tried<T> {
    let Workload {
        width,
        height,
        gaussians,
        ..
    } = workload;
    let name = format!("{name}, {width}x{height}, {gaussians} Gaussians");
    eprintln!("{name}");
    let outcome = Outcome::of(|| piece(&workload));
    Tried { name, outcome }
}

/// A trainer on the device that has done its first whole iterations.
fn warm_trainer(workload: &Workload, device: &Device) -> Result<Trainer, Failure> {
    let mut trainer = workload.trainer_at_work(device)?;
    for _ in 0..WARM {
        trainer.step()?;
    }
    device.sync()?;
    Ok(trainer)
}

fn time_iteration(
    gpu: &Gpu,
    stages: &Stages,
    workload: &Workload,
    repeats: usize,
) -> Result<Iteration, Failure> {
    let device = &gpu.device;
    let mut trainer = warm_trainer(workload, device)?;
    let memory_warm = gpu.memory_use();
    let (step, counted) = count(stages, || trainer.step());
    step?;
    let (times, _) = time_steps(&mut trainer, device, stages, repeats)?;
    // From the same place again: further on the camera has its trial. Only one of the two is on the device at a time.
    drop(trainer);
    let mut trainer = warm_trainer(workload, device)?;
    let start = Instant::now();
    for _ in 0..repeats {
        trainer.step()?;
    }
    device.sync()?;
    let in_a_row_ms = start.elapsed().as_secs_f64() * 1e3 / repeats as f64;
    Ok(Iteration {
        alone: Times::of(times).ok_or("nothing was timed")?,
        in_a_row_ms,
        bound: Card::of(&gpu.name, gpu.runtime)
            .map(|card| card.bound(&work_of(workload), counted.launches, counted.waits)),
        counted,
        memory_warm,
        memory: gpu.memory_use(),
    })
}

impl Report {
    /// All tables in Markdown.
    ///
    /// # Errors
    /// None: writing into a string cannot fail, but its interface says it could.
    pub fn tables(&self) -> Result<String, std::fmt::Error> {
        let mut out = self.adapter.title();
        write!(
            out,
            "\n| | median ms | fastest ms | a second |\n|---|---|---|---|\n"
        )?;
        for Tried { name, outcome } in &self.parts {
            match outcome {
                Outcome::Timed(times) => writeln!(
                    out,
                    "| {name} | {:.2} | {:.2} | {:.1} |",
                    times.median_ms,
                    times.fastest_ms,
                    1e3 / times.median_ms
                )?,
                Outcome::Refused(why) => writeln!(out, "| {name} | refused: {why} | | |")?,
            }
        }
        write!(
            out,
            "\n| | alone, median ms | fastest ms | in a row, ms | at least (computed) | launches | waits | MiB in use, warm and at the end | MiB reserved |\n\
             |---|---|---|---|---|---|---|---|---|\n"
        )?;
        for Tried { name, outcome } in &self.iterations {
            match outcome {
                Outcome::Timed(i) => writeln!(
                    out,
                    "| {name} | {:.2} | {:.2} | {:.2} | {} | {} | {} | {}, {} | {}, {} |",
                    i.alone.median_ms,
                    i.alone.fastest_ms,
                    i.in_a_row_ms,
                    i.bound
                        .as_ref()
                        .map_or_else(|| "–".to_owned(), |b| range(b.total_ms)),
                    i.counted.launches,
                    i.counted.waits,
                    mib(i.memory_warm, |m| m.in_use),
                    mib(i.memory, |m| m.in_use),
                    mib(i.memory_warm, |m| m.reserved),
                    mib(i.memory, |m| m.reserved),
                )?,
                Outcome::Refused(why) => {
                    writeln!(out, "| {name} | refused: {why} | | | | | | | |")?;
                }
            }
        }
        if !self.goals.is_empty() {
            write!(
                out,
                "\nOf a training its iterations alone, without its start, trials and density control:\n\n\
                 | goal | found | reached |\n|---|---|---|\n"
            )?;
        }
        for Goal {
            what,
            found,
            goal,
            is_reached,
        } in &self.goals
        {
            let found = found.map_or_else(|| "–".to_owned(), |found| format!("{found:.1}"));
            let reached = if *is_reached { "yes" } else { "no" };
            writeln!(out, "| {what}: {goal} | {found} | {reached} |")?;
        }
        Ok(out)
    }
}

fn mib(memory: Option<MemoryUse>, of: impl Fn(MemoryUse) -> u64) -> String {
    memory.map_or_else(
        || "–".to_owned(),
        |m| format!("{:.0}", of(m) as f64 / 1_048_576.0),
    )
}

#[cfg(test)]
mod tests {
    use super::{FULL, QUICK, WARM};
    use crate::workload::ALIKE;

    #[test]
    fn iterations_that_are_timed_do_the_same_work() {
        for sizes in [FULL, QUICK] {
            // One is counted before others are timed.
            assert!(WARM + 1 + sizes.repeats <= ALIKE, "{}", sizes.repeats);
        }
    }
}
