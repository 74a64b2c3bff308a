//! `limpid render`.

use crate::checkpoints;
use crate::claim::claimed;
use crate::clip::{self, ClipArguments};
use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::moments::within;
use crate::outputs;
use crate::refresh;
use crate::say::conclude;
use std::path::PathBuf;
use std::process::ExitCode;
use trainer::Shot;

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
    /// Folder for the pictures, new, empty or of an earlier time [default: RUN/renders].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Take a picture at this time (training frames, may be fractional), from where the camera was then, instead of all
    /// pictures; may be given more than once. Sharp unless --shutter or --aperture says otherwise.
    #[arg(long, value_name = "TIME", allow_negative_numbers = true)]
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
    #[command(flatten)]
    clip: ClipArguments,
}

pub(crate) fn run(arguments: &RenderArguments) -> Result<ExitCode, Failure> {
    arguments.clip.check()?;
    let config = Config::of_run(&arguments.run)?.on(arguments.backend);
    let run = checkpoints::open(&arguments.run, &config)?;
    arguments
        .at
        .iter()
        .try_for_each(|time| within(&run, "--at", *time))?;
    let out = claimed(arguments.out.as_deref(), &arguments.run, "renders")?;
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
    if let Some(path) = &arguments.clip.path {
        clip::render(&run, path, &arguments.clip, &out)?;
    } else if arguments.at.is_empty() {
        let scene = outputs::frames(&run, &config, arguments.scene.as_deref())?;
        let gallery = outputs::write_renders(&run, scene.as_ref(), &out)?;
        // Pictures for another folder are not the run's own.
        if arguments.out.is_none() && !refresh::stays(&arguments.run, &run, scene.is_some()) {
            refresh::write_with(&arguments.run, &run, &gallery)?;
        }
    }
    conclude!("written to {}", out.display());
    Ok(ExitCode::SUCCESS)
}
