//! `limpid devices`.

use crate::config::{Config, RunOptions};
use crate::failure::Failure;
use crate::memory::mib;
use crate::say::print;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use trainer::{Gpu, Settings, Table};

/// Arguments of `limpid devices`.
#[derive(Debug, clap::Args)]
pub(crate) struct DevicesArguments {
    /// Say whether this scene fits, with the settings that it would be trained with.
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Make its pictures smaller by this factor.
    #[arg(long, value_name = "F", requires = "scene")]
    downscale: Option<usize>,
    /// Ignore its movers.
    #[arg(long = "static", requires = "scene")]
    is_static: bool,
}

/// The largest table of a training, and for how many Gaussians.
type Need = (Table, usize);

/// What the scene that is asked about may need at most.
fn need(arguments: &DevicesArguments) -> Result<Option<Need>, Failure> {
    if arguments.scene.is_none() {
        return Ok(None);
    }
    let mut config = Config::of(Settings::default());
    config.run = RunOptions {
        scene: arguments.scene.clone(),
        downscale: arguments.downscale,
        is_static: arguments.is_static,
        ..RunOptions::default()
    };
    let scene = config.open_scene()?;
    let frame = scene.frames.first().ok_or("the scene has no frame")?;
    let pixels = frame.view.camera.num_pixels();
    let settings = &config.settings;
    let gaussians = settings.gaussians.most(pixels);
    let table = Gpu::largest_table(settings, gaussians, pixels);
    Ok(Some((table, gaussians)))
}

pub(crate) fn run(arguments: &DevicesArguments) -> Result<ExitCode, Failure> {
    let need = need(arguments)?;
    let mut out = String::new();
    for (backend, is_here) in [
        ("flex", cfg!(feature = "flex")),
        ("ndarray", cfg!(feature = "ndarray")),
        ("cuda", cfg!(feature = "cuda")),
        ("wgpu", cfg!(feature = "wgpu")),
    ] {
        if !is_here {
            writeln!(
                out,
                "{backend:8} not in this build: build with `--features {backend}`"
            )?;
        } else if ["flex", "ndarray"].contains(&backend) {
            writeln!(out, "{backend:8} the CPU")?;
        } else {
            list_gpus(&mut out, backend, need)?;
        }
    }
    print(out.trim_end())?;
    Ok(ExitCode::SUCCESS)
}

/// Those that a runtime reaches.
fn list_gpus(out: &mut String, backend: &str, need: Option<Need>) -> Result<(), Failure> {
    let gpus: Vec<Gpu> = Gpu::found();
    let mut listed = gpus.iter().filter(|gpu| gpu.runtime == backend).peekable();
    if listed.peek().is_none() {
        writeln!(out, "{backend:8} no adapter on this machine")?;
    }
    for gpu in listed {
        let played = if gpu.is_software {
            ", played by the CPU"
        } else {
            ""
        };
        writeln!(out, "{backend:8} {}{played}", gpu.name)?;
        let memory = gpu.memory.map_or("of unknown size".to_owned(), |bytes| {
            format!("{} MiB", mib(bytes))
        });
        writeln!(
            out,
            "         memory {memory}; a buffer {} MiB; {} buffers a kernel; {} KiB and {} units a cube",
            mib(gpu.largest_buffer),
            gpu.buffers,
            gpu.shared_memory >> 10,
            gpu.units
        )?;
        match (gpu.refusal(), need) {
            (Some(why), _) => writeln!(out, "         of no use here: {why}")?,
            (None, None) => {}
            (None, Some((table, gaussians))) => writeln!(
                out,
                "         the scene {}: with {gaussians} Gaussians at most, the largest table has about {} MiB ({})",
                if table.bytes <= gpu.largest_buffer {
                    "fits"
                } else {
                    "may not fit"
                },
                mib(table.bytes),
                table.name
            )?,
        }
    }
    Ok(())
}
