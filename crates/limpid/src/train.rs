//! `limpid train`.

use crate::check;
use crate::config::{self, Backend, CONFIG_FILE, Config};
use crate::failure::{Failure, with_causes};
use crate::lock::Lock;
use crate::outputs;
use crate::say::say;
use crate::stop::{INTERRUPTED, Stop};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;
use toml::{Table, Value};
use trainer::{Run, Settings, StepReport, TrainError, Trainer};

/// Arguments of `limpid train`.
#[derive(Debug, clap::Args)]
#[command(args_override_self = true)]
pub(crate) struct TrainArguments {
    /// Folder of the scene.
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Folder for the results [default: out/SCENE].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Number of iterations [default: 40000].
    #[arg(long, value_name = "N")]
    iterations: Option<usize>,
    /// Make pictures smaller by this factor.
    #[arg(long, value_name = "F")]
    downscale: Option<usize>,
    /// What explains blur [default: auto].
    #[arg(long)]
    blur: Option<Blur>,
    /// Take the training frames from this folder of the scene.
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Ignore movers: no masks, no tracks.
    #[arg(long = "static")]
    is_static: bool,
    /// Where tensors live [default: flex].
    #[arg(long)]
    backend: Option<Backend>,
    /// Start from other defaults.
    #[arg(long)]
    profile: Option<Profile>,
    /// Settings from a TOML file, or from the config.json of another run; flags win over it.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Seed of every random choice [default: 1].
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: Option<u64>,
    /// Go on from the checkpoint in the results' folder.
    #[arg(long)]
    resume: bool,
    /// Replace the results of an earlier run, and train on files that cannot be right (see `limpid check`).
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    /// Set any setting, for example `--set blur.kernel_size=7`.
    #[arg(long = "set", value_name = "key=value")]
    set: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Blur {
    /// The camera where frames differ in sharpness, nothing where they do not.
    Auto,
    /// The camera.
    On,
    /// Nothing: frames are taken to be sharp.
    Off,
    /// A kernel for every pixel, as in the paper.
    Kernels,
    /// The camera's path and lens.
    Camera,
    /// The camera, and kernels for what it leaves.
    Both,
}

impl Blur {
    /// The value of `blur.model`.
    fn model(self) -> Value {
        let name = match self {
            Self::Auto => "auto",
            Self::Off => "off",
            Self::Kernels => "kernels",
            Self::On | Self::Camera => "camera",
            Self::Both => "both",
        };
        Value::String(name.to_owned())
    }
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum Profile {
    /// The paper's text.
    Paper,
}

pub(crate) fn run(arguments: &TrainArguments) -> Result<ExitCode, Failure> {
    let asked = arguments.config()?;
    let out = match &arguments.out {
        Some(out) => out.clone(),
        None => default_out(&asked)?,
    };
    let checkpoint = out.join("checkpoint");
    let (config, mut trainer, mut seconds, _lock) = if arguments.resume {
        let mut config = Config::of_run(&out)?;
        let lock = Lock::of(&out)?;
        if let Some(scene) = &arguments.scene {
            config.run.scene = Some(absolute(scene)?);
        }
        if let Some(backend) = arguments.backend {
            config.run.backend = backend;
        }
        let device = config.run.backend.device()?;
        let run = Run::open(&checkpoint, &device)?;
        config.check_trained(&out, run.settings())?;
        let trainer = Trainer::resume(run, config.open_scene()?)?;
        say!(
            "going on after iteration {} of {}",
            trainer.iteration(),
            trainer.settings().iterations
        );
        let seconds = outputs::read_seconds(&checkpoint);
        (config, trainer, seconds, lock)
    } else {
        let device = asked.run.backend.device()?;
        outputs::check_folder(&out, arguments.force)?;
        // A folder that is not there yet is made once it is clear that there will be a run.
        let early = out.is_dir().then(|| Lock::of(&out)).transpose()?;
        let scene = asked.open_scene()?;
        // What it is scored against is read at the end: better to fail now.
        scene.truth()?;
        for note in &scene.notes {
            say!("note: {note}");
        }
        check::before_training(&scene, arguments.force)?;
        let trainer = Trainer::new(scene, asked.settings.clone(), &device)?;
        std::fs::create_dir_all(&out).map_err(|e| format!("{e}: {}", out.display()))?;
        let lock = match early {
            Some(lock) => lock,
            None => Lock::of(&out)?,
        };
        // Another run may have come and gone since.
        outputs::check_folder(&out, arguments.force)?;
        // Only now: a mistake in the arguments or the scene costs no earlier results.
        outputs::clear_folder(&out)?;
        io::write_json(&out.join(CONFIG_FILE), &asked)?;
        (asked, trainer, 0.0, lock)
    };
    for note in &trainer.survey().notes {
        say!("{note}");
    }

    let stop = Stop::listen()?;
    let every = trainer.settings().checkpoint_every;
    let mut progress = Progress::new(trainer.iteration(), trainer.settings().iterations);
    while !trainer.is_done() && !stop.is_asked() {
        let started = Instant::now();
        let step = trainer.step();
        seconds += started.elapsed().as_secs_f64();
        let report = match step {
            Ok(report) => report,
            Err(error) => {
                progress.finish();
                // Where the renderer refuses a parameter, the state is no good any more: the checkpoint on disk stays.
                let is_whole = matches!(error, TrainError::NotFinite { .. });
                if is_whole && let Err(problem) = outputs::save(&trainer, &checkpoint, seconds) {
                    say!("the checkpoint cannot be saved: {}", with_causes(&*problem));
                }
                return Err(error.into());
            }
        };
        progress.show(&report);
        if every > 0
            && report.iteration.is_multiple_of(every)
            && !trainer.is_done()
            && let Err(problem) = outputs::save(&trainer, &checkpoint, seconds)
        {
            let problem = with_causes(&*problem);
            say!(
                "warning: no checkpoint after iteration {}: {problem}; training goes on, and tries again",
                report.iteration
            );
        }
    }
    progress.finish();
    outputs::save(&trainer, &checkpoint, seconds)?;
    stop.saved();
    if !trainer.is_done() {
        say!(
            "stopped after iteration {}; the same command with --resume --out {} and no settings goes on",
            trainer.iteration(),
            out.display()
        );
        return Ok(ExitCode::from(INTERRUPTED));
    }
    let evaluation = outputs::write_all(&trainer, &out)?;
    let metrics = outputs::metrics(&evaluation, trainer.run(), config.run.backend, seconds);
    io::write_json(&out.join("metrics.json"), &metrics)?;
    say!("{}", outputs::summary(&evaluation));
    say!("{seconds:.0} s of training; results in {}", out.display());
    Ok(ExitCode::SUCCESS)
}

impl TrainArguments {
    /// File, then flags, then `--set`, over the profile's defaults.
    fn config(&self) -> Result<Config, Failure> {
        let changes_settings = self.iterations.is_some()
            || self.downscale.is_some()
            || self.blur.is_some()
            || self.images.is_some()
            || self.is_static
            || self.profile.is_some()
            || self.seed.is_some()
            || !self.set.is_empty();
        if self.resume && changes_settings {
            return Err("--resume goes on with the settings that the run was started with; leave the other flags out \
                (only --out, --scene, --config and --backend go with it)"
                .into());
        }
        let defaults = match self.profile {
            Some(Profile::Paper) => Settings::paper(),
            None => Settings::default(),
        };
        let mut table = match &self.config {
            Some(path) => config::read_table(path)?,
            None => Table::new(),
        };
        let number = |n: usize| Value::Integer(i64::try_from(n).unwrap_or(i64::MAX));
        let path = |p: &Path| Value::String(p.to_string_lossy().into_owned());
        let flags = [
            ("scene", self.scene.as_deref().map(path)),
            ("images", self.images.as_deref().map(path)),
            ("iterations", self.iterations.map(number)),
            ("downscale", self.downscale.map(number)),
            ("static", self.is_static.then_some(Value::Boolean(true))),
            (
                "backend",
                self.backend.map(|b| Value::String(b.name().to_owned())),
            ),
            (
                "seed",
                self.seed
                    .map(|s| Value::Integer(i64::try_from(s).unwrap_or(i64::MAX))),
            ),
            ("blur.model", self.blur.map(Blur::model)),
        ];
        for (key, value) in flags {
            if let Some(value) = value {
                config::insert(&mut table, key, value)?;
            }
        }
        for assignment in &self.set {
            config::set(&mut table, assignment)?;
        }
        let mut config = config::from_table(table, &defaults)?;
        // An absolute path, so that the run can be repeated from anywhere.
        if let Some(scene) = &mut config.run.scene {
            *scene = absolute(scene)?;
        }
        Ok(config)
    }
}

fn absolute(scene: &Path) -> Result<PathBuf, Failure> {
    let found = scene.canonicalize();
    Ok(found.map_err(|e| format!("{e}: {}", scene.display()))?)
}

fn default_out(config: &Config) -> Result<PathBuf, Failure> {
    let scene = config.run.scene.as_deref();
    let name = scene.and_then(Path::file_name).ok_or(
        "no scene: give --scene DIR, or --config FILE with a line `scene = \"DIR\"` (and --out DIR for where the results go)",
    )?;
    Ok(Path::new("out").join(name))
}

/// A bar on a terminal, a line now and then elsewhere.
struct Progress {
    bar: ProgressBar,
    plain: bool,
    started: Instant,
    from: usize,
    iterations: usize,
    psnr: f64,
}

impl Progress {
    fn new(from: usize, iterations: usize) -> Self {
        let plain = !std::io::stderr().is_terminal();
        let target = if plain {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        };
        let bar = ProgressBar::with_draw_target(Some(iterations as u64), target);
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg} · {eta} left");
        bar.set_style(style.expect("the template is valid"));
        bar.set_position(from as u64);
        bar.reset_eta();
        Self {
            bar,
            plain,
            started: Instant::now(),
            from,
            iterations,
            psnr: f64::NAN,
        }
    }

    fn show(&mut self, report: &StepReport) {
        self.psnr = if self.psnr.is_nan() {
            report.psnr
        } else {
            0.9 * self.psnr + 0.1 * report.psnr
        };
        let text = format!(
            "loss {:.4} · PSNR {:.1} dB · {} Gaussians",
            report.loss, report.psnr, report.gaussians
        );
        self.bar.set_position(report.iteration as u64);
        let every = (self.iterations / 20).max(1);
        if self.plain
            && (report.iteration.is_multiple_of(every) || report.iteration == self.iterations)
        {
            let done = (report.iteration - self.from) as f64;
            let left = self.started.elapsed().as_secs_f64() / done
                * (self.iterations - report.iteration) as f64;
            say!(
                "{}/{} {text} · mean PSNR {:.1} dB · {left:.0} s left",
                report.iteration,
                self.iterations,
                self.psnr
            );
        }
        self.bar.set_message(text);
    }

    fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
