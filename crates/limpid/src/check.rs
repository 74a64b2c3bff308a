//! `limpid check`: what a scene holds, and whether that can be right.

use crate::budget;
use crate::config::{Config, Distortion, RunOptions};
use crate::failure::{Failure, with_causes};
use crate::memory;
use crate::preset::Preset;
use crate::progress::duration;
use crate::say::{conclude, print, say};
use clap::ValueEnum as _;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use trainer::check::{Finding, Verdict, check};
use trainer::{Settings, Trainer};

/// Exit codes beside success.
const DOUBTFUL: u8 = 1;
const WRONG: u8 = 2;

/// Arguments of `limpid check`.
#[derive(Debug, clap::Args)]
pub(crate) struct CheckArguments {
    /// Folder of the scene.
    scene: PathBuf,
    /// Make pictures smaller by this factor.
    #[arg(long, value_name = "F")]
    downscale: Option<usize>,
    /// Take the training frames from this folder of the scene.
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Ignore movers: no masks, no tracks.
    #[arg(long = "static")]
    is_static: bool,
    /// What to do about lens distortion [default: undistort].
    #[arg(long)]
    distortion: Option<Distortion>,
    /// Also say how long training would take on this machine, and how much memory: tries a run's first iterations.
    #[arg(long)]
    time: bool,
}

pub(crate) fn run(arguments: &CheckArguments) -> Result<ExitCode, Failure> {
    let (text, code) = report(arguments).unwrap_or_else(|error| {
        let text = format!("{:>14}  {}", Verdict::Wrong, with_causes(&*error));
        (text, WRONG)
    });
    print(&text)?;
    Ok(ExitCode::from(code))
}

fn report(arguments: &CheckArguments) -> Result<(String, u8), Failure> {
    let run = RunOptions {
        scene: Some(arguments.scene.clone()),
        images: arguments.images.clone(),
        downscale: arguments.downscale,
        is_static: arguments.is_static,
        distortion: arguments.distortion.unwrap_or_default(),
        ..RunOptions::default()
    };
    let config = Config {
        run,
        ..Config::of(Settings::default())
    };
    let scene = config.open_scene()?;
    let mut text = inventory(&scene)?;
    let findings = check(&scene, config.settings.motion.when);
    for finding in &findings {
        writeln!(text, "{}", line(finding))?;
    }
    let worst = findings.iter().map(|f| f.verdict).max();
    let mut code = match worst {
        Some(Verdict::Wrong) => WRONG,
        Some(Verdict::Doubtful) => DOUBTFUL,
        _ => 0,
    };
    match prospects(scene, &config, arguments.time && code != WRONG) {
        Ok(prospects) => {
            text += &prospects;
            if arguments.time && code == WRONG {
                text += "what training would take is not told while something is wrong\n";
            }
        }
        Err(error) => {
            let (verdict, why) = (Verdict::Wrong, with_causes(&*error));
            writeln!(text, "{verdict:>14}  training cannot begin: {why}")?;
            code = WRONG;
        }
    }
    Ok((text.trim_end().to_owned(), code))
}

/// What training would go by and, if that is asked, what it would take.
fn prospects(mut scene: io::Scene, config: &Config, of_cost: bool) -> Result<String, Failure> {
    let settings = &config.settings;
    if !of_cost {
        let survey = trainer::survey(&mut scene, settings.motion.when)?;
        let decided = survey.decided(settings);
        return decisions(survey.notes.iter().chain(&decided));
    }
    let device = config.run.backend.device()?;
    let mut trainer = Trainer::new(scene, settings.clone(), &device)?;
    Ok(decisions(&trainer.survey().notes)? + &cost(&mut trainer, config)?)
}

/// What was found in the scene, and what is decided from it.
fn decisions<'a>(notes: impl IntoIterator<Item = &'a String>) -> Result<String, Failure> {
    let mut text = "training would go by this:\n".to_owned();
    for note in notes {
        writeln!(text, "  {note}")?;
    }
    Ok(text)
}

/// What training would take of time and memory on this machine, by its first iterations.
fn cost(trainer: &mut Trainer, config: &Config) -> Result<String, Failure> {
    memory::warn(trainer, config);
    let memory = memory::expected(trainer, config);
    let presets = Preset::value_variants();
    let settings = presets.iter().map(|preset| preset.over(config));
    let settings = settings.collect::<Result<Vec<_>, _>>()?;
    let seconds = budget::foretell(trainer, &settings)?;
    let mut text = format!(
        "training itself would take, about, on {} threads of this machine:\n",
        rayon::current_num_threads()
    );
    for ((preset, settings), seconds) in presets.iter().zip(settings).zip(seconds) {
        let name = preset
            .to_possible_value()
            .expect("a name that can be given");
        writeln!(
            text,
            "  --preset {}, {} iterations: {}",
            name.get_name(),
            settings.iterations,
            duration(seconds)
        )?;
    }
    if let Some(bytes) = memory {
        writeln!(
            text,
            "and about {} MiB of memory at its peak",
            memory::mib(bytes)
        )?;
    }
    Ok(text)
}

/// What was found, and what is missing and makes it.
fn inventory(scene: &io::Scene) -> Result<String, Failure> {
    let mut text = String::new();
    let first = scene.frames.first().ok_or("the scene has no frame")?;
    let camera = &first.view.camera;
    writeln!(
        text,
        "{}: {} frames of {}x{} in the layout of {}, {} test views",
        scene.root.display(),
        scene.frames.len(),
        camera.width,
        camera.height,
        scene.layout,
        scene.test.len()
    )?;
    for note in &scene.notes {
        writeln!(text, "note: {note}")?;
    }
    let tracks = scene.tracks.as_ref().map_or(0, io::Tracks::num_tracks);
    let parts = [
        (
            "sparse points",
            scene.points.len(),
            "COLMAP or GLOMAP makes them; without them depth is used as it is",
        ),
        (
            "depth maps",
            scene.frames.iter().filter(|f| f.depth.is_some()).count(),
            "Depth Anything or another estimator makes them; without them Gaussians start at the sparse points, and nothing moves",
        ),
        (
            "masks",
            scene.frames.iter().filter(|f| f.mask.is_some()).count(),
            "SAM 2 or another segmenter makes them; without them the scene is static",
        ),
        (
            "tracks",
            tracks,
            "TAPIR, BootsTAPIR or CoTracker makes them; without them the scene is static",
        ),
    ];
    for (what, count, advice) in parts {
        if count > 0 {
            writeln!(text, "  {what}: {count}")?;
        } else {
            writeln!(text, "  {what}: none; {advice}")?;
        }
    }
    Ok(text)
}

fn line(finding: &Finding) -> String {
    format!(
        "{:>14}  {}: {}",
        finding.verdict, finding.what, finding.text
    )
}

/// Looks at the inputs of a training, and stops it where they cannot be right, unless it is to go on all the same.
pub(crate) fn before_training(
    scene: &io::Scene,
    settings: &Settings,
    goes_on: bool,
) -> Result<(), Failure> {
    let findings = check(scene, settings.motion.when);
    for finding in &findings {
        if finding.verdict == Verdict::Wrong {
            conclude!("{}", line(finding));
        } else {
            say!("{}", line(finding));
        }
    }
    let is_wrong = findings.iter().any(|f| f.verdict == Verdict::Wrong);
    if is_wrong && !goes_on {
        return Err(
            "inputs that cannot be right, see above; mend them, or train on them all the same with --unchecked"
                .into(),
        );
    }
    Ok(())
}
