//! `limpid render`.

use crate::checkpoints;
use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::outputs;
use crate::say::say;
use std::path::PathBuf;
use std::process::ExitCode;
use trainer::{Run, Shot};

/// Arguments of `limpid render`.
#[derive(Debug, clap::Args)]
pub(crate) struct RenderArguments {
    /// Folder with a run's results.
    run: PathBuf,
    /// Folder of the scene, where it is no longer at the place it was trained from.
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Where tensors live [default: where they did in training].
    #[arg(long)]
    backend: Option<Backend>,
    /// Folder for the pictures and PLY files [default: RUN/renders].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the scene at this time (training frames, may be fractional) as PLY instead of pictures; may be given more than once.
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
    ply_at: Vec<f32>,
    /// Write the scene at every training frame as a numbered PLY sequence (`ply/frame_0000.ply` …) instead of pictures.
    #[arg(long)]
    ply_sequence: bool,
    /// Take a picture at this time (training frames, may be fractional), from where the camera was then, instead of all
    /// pictures; may be given more than once. Sharp unless --shutter or --aperture says otherwise.
    #[arg(long, value_name = "TIME", allow_negative_numbers = true, conflicts_with_all = ["ply_at", "ply_sequence"])]
    at: Vec<f32>,
    /// With --at: the shutter is open for so many training frames.
    #[arg(long, value_name = "FRAMES", requires = "at", default_value_t = 0.0)]
    shutter: f64,
    /// With --at: radius of the lens in scene units.
    #[arg(long, value_name = "RADIUS", requires = "at", default_value_t = 0.0)]
    aperture: f64,
    /// With --at: depth that is in focus, in scene units [default: the scene's size].
    #[arg(long, value_name = "DEPTH", requires = "at")]
    focus: Option<f64>,
    /// With --at: renders that a blurred picture is averaged from.
    #[arg(long, value_name = "N", requires = "at", default_value_t = 64)]
    samples: usize,
}

pub(crate) fn run(arguments: &RenderArguments) -> Result<ExitCode, Failure> {
    let config = Config::of_run(&arguments.run)?.on(arguments.backend);
    let run = checkpoints::open(&arguments.run, &config)?;
    for (flag, times) in [("--at", &arguments.at), ("--ply-at", &arguments.ply_at)] {
        times
            .iter()
            .try_for_each(|time| within(&run, flag, *time))?;
    }
    let out = arguments
        .out
        .clone()
        .unwrap_or_else(|| arguments.run.join("renders"));
    std::fs::create_dir_all(&out).map_err(|e| format!("{e}: {}", out.display()))?;
    for &time in &arguments.at {
        let shot = Shot {
            time,
            shutter: arguments.shutter,
            aperture: arguments.aperture,
            focus: arguments.focus.unwrap_or(run.survey().scene_size),
            samples: arguments.samples,
        };
        io::write_png(
            &out.join(format!("at_{time}.png")),
            &run.render_shot(&shot)?,
        )?;
    }
    let pictures = arguments.at.is_empty() && arguments.ply_at.is_empty();
    if pictures && !arguments.ply_sequence {
        let scene = outputs::frames(&run, &config, arguments.scene.as_deref())?;
        outputs::write_renders(&run, scene.as_ref(), &out)?;
    }
    let model = run.model();
    for &time in &arguments.ply_at {
        io::write_ply(
            &out.join(format!("scene_at_{time}.ply")),
            &model.gaussians(Some(time)),
        )?;
    }
    if arguments.ply_sequence {
        // A folder of its own: viewers take a folder with nothing but numbered PLY files as a sequence.
        let folder = out.join("ply");
        std::fs::create_dir_all(&folder).map_err(|e| format!("{e}: {}", folder.display()))?;
        for (index, view) in run.views().train.iter().enumerate() {
            let path = folder.join(format!("frame_{index:04}.ply"));
            io::write_ply(&path, &model.gaussians(Some(view.time)))?;
        }
    }
    say!("written to {}", out.display());
    Ok(ExitCode::SUCCESS)
}

/// An error for a time outside of the video, where nothing is known of the scene.
fn within(run: &Run, flag: &str, time: f32) -> Result<(), Failure> {
    let views = run.views().train.iter();
    let (from, to) = views.fold((f32::INFINITY, f32::NEG_INFINITY), |(from, to), view| {
        (from.min(view.time), to.max(view.time))
    });
    if time >= from && time <= to {
        return Ok(());
    }
    Err(format!("{flag} {time}: the video goes from {from} to {to}, in training frames").into())
}
