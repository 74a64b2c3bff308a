//! `limpid-bench`: times iterations and how they grow, and writes the results.
#![allow(clippy::print_stdout, reason = "a program that reports times")]

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use bpnet::Extractor;
use clap::{Parser, Subcommand};
use limpid_bench::curves::{Curve, curves, differences, plot};
use limpid_bench::growth::{sweeps, time_point};
use limpid_bench::iteration::{Breakdown, breakdown, time_steps, time_workload};
use limpid_bench::machine::Machine;
use limpid_bench::net::time_net;
use limpid_bench::report::Report;
use limpid_bench::spans::Stages;
use limpid_bench::workload::{Blur, Workload};
use trainer::settings::BlurKind;
use trainer::{Device, Settings, Trainer};

/// As in the program: large buffers are kept for the next iteration.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

type Failure = Box<dyn std::error::Error>;

/// Times training iterations stage by stage, and how they grow; writes tables, JSON and plots.
#[derive(Debug, Parser)]
struct Arguments {
    /// Where the results go.
    #[arg(long, default_value = "out/bench")]
    out: PathBuf,
    /// What runs iterations. With a GPU it is timed part by part, and `gpu.json` written.
    #[arg(long, global = true, value_enum, default_value_t = Backend::Flex)]
    backend: Backend,
    /// Fewer sizes and iterations: a minute instead of several.
    #[arg(long)]
    quick: bool,
    #[command(subcommand)]
    command: Option<Command>,
}

/// What runs iterations.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Backend {
    /// The CPU.
    Flex,
    /// Any GPU; needs the feature `wgpu`.
    Wgpu,
    /// An NVIDIA GPU, by CUDA; needs the feature `cuda`.
    Cuda,
}

impl Backend {
    /// The runtime of a GPU; `None` for the CPU.
    fn runtime(self) -> Option<&'static str> {
        match self {
            Self::Flex => None,
            Self::Wgpu => Some("wgpu"),
            Self::Cuda => Some("cuda"),
        }
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    /// One point of a sweep, as JSON: width, height, Gaussians, K, and 1 for blur.
    #[command(hide = true)]
    Point { sizes: Vec<usize> },
    /// Extractor, BP-Net and blur alone, as JSON.
    Net {
        /// Width of the picture.
        #[arg(long, default_value_t = 256)]
        width: usize,
        /// Height of the picture.
        #[arg(long, default_value_t = 144)]
        height: usize,
        /// Passes that are timed.
        #[arg(long, default_value_t = 10)]
        repeats: usize,
        /// The extractor does not learn.
        #[arg(long)]
        frozen: bool,
        /// On the backend `ndarray` (needs the feature of that name).
        #[arg(long)]
        ndarray: bool,
    },
    /// Counts what an iteration on a GPU launches, moves and waits for, and computes its least time; writes `launches.json`.
    Launches {
        /// Width of the pictures.
        #[arg(long, default_value_t = 512)]
        width: usize,
        /// Height of the pictures.
        #[arg(long, default_value_t = 288)]
        height: usize,
        /// Number of Gaussians.
        #[arg(long, default_value_t = 100_000)]
        gaussians: usize,
        /// Where the counts go.
        #[arg(long, default_value = "out/bench")]
        out: PathBuf,
    },
    /// Trains the demo at 32x18 on the CPU's backends of this build and on wgpu: losses in one plot, `curves.svg`, and scores,
    /// `curves.json`. What another build left there of other backends stays.
    Curves {
        /// Where the results go.
        #[arg(long, default_value = "out/bench")]
        out: PathBuf,
        /// Seed of the first runs.
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// So many seeds, one after the other: what backends differ by on the mean.
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
        seeds: u64,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match &arguments.command {
        Some(Command::Point { sizes }) => point(sizes),
        Some(Command::Net {
            width,
            height,
            repeats,
            frozen,
            ndarray,
        }) => net([*width, *height], *repeats, *frozen, *ndarray),
        Some(Command::Curves { out, seed, seeds }) => {
            all_curves(out, *seed..seed.saturating_add(*seeds))
        }
        Some(Command::Launches {
            width,
            height,
            gaussians,
            out,
        }) => match arguments.backend.runtime() {
            Some(runtime) => launches(runtime, [*width, *height], *gaussians, out),
            None => Err("launches are a GPU's: say --backend wgpu or --backend cuda".into()),
        },
        None => match arguments.backend.runtime() {
            Some(runtime) => all_on_gpu(runtime, &arguments.out, arguments.quick),
            None => all(&arguments),
        },
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("limpid-bench: {error}");
            ExitCode::FAILURE
        }
    }
}

fn point(sizes: &[usize]) -> Result<(), Failure> {
    let &[width, height, gaussians, kernel_size, blur] = sizes else {
        return Err("a point is width, height, Gaussians, K and 0 or 1 for blur".into());
    };
    let blur = if blur == 0 { Blur::Off } else { Blur::Trained };
    let point = time_point(&Workload {
        width,
        height,
        gaussians,
        blur,
        kernel_size,
    })?;
    println!("{}", serde_json::to_string(&point)?);
    Ok(())
}

fn net(size: [usize; 2], repeats: usize, frozen: bool, ndarray: bool) -> Result<(), Failure> {
    let extractor = if frozen {
        Extractor::Frozen
    } else {
        Extractor::Trained
    };
    let times = time_net(size, extractor, &net_device(ndarray)?, repeats)?;
    println!("{}", serde_json::to_string(&times)?);
    Ok(())
}

#[cfg_attr(
    feature = "ndarray",
    allow(deprecated, reason = "kept as a second, independent CPU backend")
)]
fn ndarray_device() -> Option<Device> {
    #[cfg(feature = "ndarray")]
    return Some(Device::ndarray());
    #[cfg(not(feature = "ndarray"))]
    None
}

fn net_device(ndarray: bool) -> Result<Device, Failure> {
    if !ndarray {
        return Ok(Device::flex());
    }
    ndarray_device().ok_or_else(|| "build with `--features ndarray`".into())
}

fn all_curves(out: &Path, seeds: Range<u64>) -> Result<(), Failure> {
    let mut devices = vec![("flex", Device::flex(), 300)];
    devices.extend(ndarray_device().map(|device| ("ndarray", device, 300)));
    if let Ok(gpu) = trainer::Gpu::best("wgpu") {
        // A GPU that a CPU plays takes minutes for a third of it.
        let iterations = if gpu.is_software { 100 } else { 300 };
        devices.push(("wgpu", gpu.device, iterations));
    }
    let file = out.join("curves.json");
    let mut all: Vec<Curve> = match std::fs::read_to_string(&file) {
        Ok(text) => serde_json::from_str(&text)?,
        Err(_) => Vec::new(),
    };
    std::fs::create_dir_all(out)?;
    for seed in seeds {
        for (backend, device, iterations) in &devices {
            eprintln!("{backend}, seed {seed}, {iterations} iterations");
            let found = curves(backend, device, *iterations, seed)?;
            all.retain(|curve| (curve.backend.as_str(), curve.seed) != (*backend, seed));
            all.extend(found);
        }
        // What is there stays, should a later seed be stopped.
        std::fs::write(&file, serde_json::to_string(&all)?)?;
    }
    for curve in &all {
        println!(
            "{} {} seed {} {:?}",
            curve.backend, curve.model, curve.seed, curve.psnr
        );
    }
    for of in differences(&all) {
        let error = of
            .standard_error
            .map_or_else(String::new, |error| format!(" ± {error:.2}"));
        println!(
            "{} against flex, {}, {} iterations, {} seeds: {:+.2}{error} dB",
            of.backend, of.model, of.iterations, of.seeds, of.mean
        );
    }
    plot(&all, &out.join("curves.svg"))
}

#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn launches(runtime: &str, size: [usize; 2], gaussians: usize, out: &Path) -> Result<(), Failure> {
    let gpu = limpid_bench::gpu::open(runtime)?;
    let stages = Stages::default();
    tracing::subscriber::set_global_default(stages.clone())?;
    let counted = limpid_bench::gpu::launches::count_launches(&gpu, &stages, size, gaussians)?;
    limpid_bench::gpu::write(&counted, out, "launches.json")?;
    print!("{}", counted.tables()?);
    println!("\nwritten to {}", out.display());
    Ok(())
}

#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn all_on_gpu(runtime: &str, out: &Path, quick: bool) -> Result<(), Failure> {
    let gpu = limpid_bench::gpu::open(runtime)?;
    let stages = Stages::default();
    tracing::subscriber::set_global_default(stages.clone())?;
    let report = limpid_bench::gpu::report::time_all(&gpu, &stages, quick);
    limpid_bench::gpu::write(&report, out, "gpu.json")?;
    print!("{}", report.tables()?);
    println!("\nwritten to {}", out.display());
    Ok(())
}

#[cfg(not(any(feature = "wgpu", feature = "cuda")))]
fn launches(runtime: &str, _: [usize; 2], _: usize, _: &Path) -> Result<(), Failure> {
    all_on_gpu(runtime, Path::new(""), false)
}

#[cfg(not(any(feature = "wgpu", feature = "cuda")))]
fn all_on_gpu(runtime: &str, _: &Path, _: bool) -> Result<(), Failure> {
    let how = format!("`cargo xtask bench --backend {runtime}` makes one that has it");
    Err(format!("--backend {runtime}: this build lacks it; {how}").into())
}

fn all(arguments: &Arguments) -> Result<(), Failure> {
    let stages = Stages::default();
    tracing::subscriber::set_global_default(stages.clone())?;
    let machine = Machine::measure();
    let (device, count) = (Device::flex(), if arguments.quick { 10 } else { 40 });
    let mut iterations = Vec::new();
    let sizes: &[_] = if arguments.quick {
        &[(256, 144, 20_000)]
    } else {
        &[(256, 144, 20_000), (512, 288, 100_000)]
    };
    for &(width, height, gaussians) in sizes {
        for blur in Blur::ALL {
            let workload = Workload {
                width,
                height,
                gaussians,
                blur,
                kernel_size: 9,
            };
            eprintln!("{width}x{height}, {gaussians} Gaussians, {}", blur.name());
            iterations.push(time_workload(&workload, &device, &machine, &stages, count)?);
        }
    }
    if !arguments.quick {
        eprintln!("the demo");
        iterations.push(demo(&device, &stages)?);
    }
    eprintln!("growth");
    let report = Report {
        machine,
        iterations,
        growth: sweeps(arguments.quick)?,
    };
    report.write(&arguments.out)?;
    print!("{}", report.tables()?);
    println!("\nwritten to {}", arguments.out.display());
    Ok(())
}

/// Iterations of the demo in which all parts of the paper's method are on: kernels, movers, unseen views, depth and masks.
fn demo(device: &Device, stages: &Stages) -> Result<Breakdown, Failure> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../demo");
    let scene = io::Scene::open(folder.as_ref())?;
    let mut settings = Settings {
        iterations: 1200,
        ..Settings::default()
    };
    settings.blur.model = BlurKind::Kernels;
    let mut trainer = Trainer::new(scene, settings, device)?;
    // Blur from 251 on, its penalty from 551 on.
    while trainer.iteration() < 560 {
        trainer.step()?;
    }
    let (times, spans) = time_steps(&mut trainer, device, stages, 100)?;
    let name = format!(
        "the demo, 160x90, {} Gaussians, iterations 561 to 660",
        trainer.model().num_gaussians()
    );
    Ok(breakdown(name, times, &spans, |_, _| None))
}
