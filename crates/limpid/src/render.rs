//! `limpid render`.

use crate::checkpoints;
use crate::claim::claimed;
use crate::clip::{self, ClipArguments};
use crate::config::{Backend, Config};
use crate::failure::{Failure, refuse_idle};
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
    /// With --aperture: depth that is in focus, in scene units [default: the scene's size].
    #[arg(long, value_name = "DEPTH", requires = "at")]
    focus: Option<f64>,
    /// With --shutter or --aperture: renders that a picture is averaged from [default: 64].
    #[arg(long, value_name = "N", requires = "at")]
    samples: Option<usize>,
    #[command(flatten)]
    clip: ClipArguments,
}

impl RenderArguments {
    /// An error for a flag that changes nothing of the pictures.
    fn check(&self) -> Result<(), Failure> {
        self.clip.check()?;
        let has_lens = self.aperture != 0.0;
        let is_blurred = has_lens || self.shutter != 0.0;
        refuse_idle([
            (("--focus", self.focus.is_some()), (has_lens, "--aperture")),
            (
                ("--samples", self.samples.is_some()),
                (is_blurred, "--shutter and --aperture"),
            ),
        ])
    }

    /// The pictures at moments of the user's own, in a scene of such a size.
    fn shots(&self, scene_size: f64) -> Vec<Shot> {
        let shot = |&time: &f32| Shot {
            time,
            shutter: self.shutter,
            aperture: self.aperture,
            focus: self.focus.unwrap_or(scene_size),
            samples: self.samples.unwrap_or(64),
        };
        self.at.iter().map(shot).collect()
    }
}

pub(crate) fn run(arguments: &RenderArguments) -> Result<ExitCode, Failure> {
    arguments.check()?;
    let config = Config::of_run(&arguments.run)?.on(arguments.backend);
    let run = checkpoints::open(&arguments.run, &config)?;
    let shots = arguments.shots(run.survey().scene_size);
    for shot in &shots {
        within(&run, "--at", shot.time)?;
        shot.check()?;
    }
    let out = claimed(arguments.out.as_deref(), &arguments.run, "renders")?;
    for shot in &shots {
        let picture = out.join(format!("at_{}.png", shot.time));
        io::write_png(&picture, &run.render_shot(shot)?)?;
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
