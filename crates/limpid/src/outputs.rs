//! What a run leaves in its folder.

use crate::checkpoints;
use crate::config::{Backend, CONFIG_FILE, Config};
use crate::failure::{Failure, with_causes};
use crate::log;
use crate::numbered::Numbered;
use crate::report::{self, Gallery};
use crate::say::say;
use crate::sheet;
use io::Scene;
use serde::Serialize;
use std::fmt::Write as _;
use std::path::Path;
use trainer::{Change, Evaluation, Run, Scores, Settings, Trainer};

/// A run's scores.
pub(crate) const METRICS_FILE: &str = "metrics.json";

/// The names of a run's results in its folder, in the order in which they are removed: what tells a run goes last, so that a folder
/// that is cleared half-way is still one.
const RESULTS: [&str; 11] = [
    METRICS_FILE,
    log::LOG_FILE,
    report::FILE,
    report::SIDE_FILE,
    checkpoints::FOLDER,
    "renders/test",
    "renders/train",
    "renders/blurred",
    "renders/blur.png",
    "scene.ply",
    CONFIG_FILE,
];

/// `metrics.json`.
#[derive(Serialize)]
pub(crate) struct Metrics<'a> {
    #[serde(flatten)]
    evaluation: &'a Evaluation,
    seconds: f64,
    backend: &'static str,
    seed: u64,
    settings: &'a Settings,
    /// What of the settings was another before, and since when not.
    #[serde(skip_serializing_if = "<[Change]>::is_empty")]
    changes: &'a [Change],
}

/// Refuses a folder that holds another run's results, unless they are to be replaced; one that holds such names and no
/// configuration of ours is left alone in any case.
pub(crate) fn check_folder(out: &Path, replace: bool) -> Result<(), Failure> {
    // Itself, or the nearest of those that it would be made in.
    let there = out.ancestors().find(|at| at.symlink_metadata().is_ok());
    if let Some(file) = there.filter(|at| !at.is_dir()) {
        return Err(format!("{} is no folder; choose another with --out", file.display()).into());
    }
    let Some(name) = RESULTS.iter().find(|name| out.join(name).exists()) else {
        return Ok(());
    };
    let folder = out.display();
    if !is_run(out) {
        return Err(format!(
            "{folder} is no run of ours, and --force would remove files from it ({name}); choose another folder with --out"
        )
        .into());
    }
    if replace {
        return Ok(());
    }
    Err(if checkpoints::are_in(out) {
        format!(
            "{folder} holds the results of another run ({name}); --resume goes on with it, --force replaces it, --out chooses another folder"
        )
    } else {
        format!(
            "{folder} holds a run that ended before its first checkpoint: nothing was saved, and there is nothing to go on from; \
             --force starts anew in its place, --out chooses another folder"
        )
    }
    .into())
}

/// Removes another run's results, but nothing else: clips and exports that were made of it stay.
pub(crate) fn clear_folder(out: &Path) -> Result<(), Failure> {
    for path in RESULTS.map(|name| out.join(name)) {
        let removed = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else if path.exists() {
            std::fs::remove_file(&path)
        } else {
            Ok(())
        };
        removed.map_err(|e| format!("{e}: {}", path.display()))?;
    }
    Ok(())
}

/// Whether a folder holds the configuration of a run, of this version or another.
fn is_run(out: &Path) -> bool {
    std::fs::read_to_string(out.join(CONFIG_FILE))
        .ok()
        .and_then(|text| serde_json::from_str::<serde_json::Value>(&text).ok())
        .is_some_and(|config| config["run"].is_object() && config["settings"].is_object())
}

/// Writes all pictures, the PLY, scores and the report.
pub(crate) fn write_all(
    trainer: &Trainer,
    config: &Config,
    out: &Path,
) -> Result<Evaluation, Failure> {
    let run = trainer.run();
    let gallery = write_renders(run, Some(trainer.scene()), &out.join("renders"))?;
    io::write_ply(&out.join("scene.ply"), &run.gaussians(None)?)?;
    let evaluation = trainer.evaluate()?;
    let metrics = metrics(&evaluation, run, config.run.backend);
    io::write_json(&out.join(METRICS_FILE), &metrics)?;
    let curves = log::read(&out.join(log::LOG_FILE));
    let metrics = serde_json::to_value(&metrics)?;
    report::write(out, run, config, &gallery, (&metrics, &curves))?;
    Ok(evaluation)
}

/// Writes `test/`, `train/`, `blurred/` and `blur.png`, whose blurry frames are those of `scene`. Gives the pictures back for the
/// report.
pub(crate) fn write_renders(
    run: &Run,
    scene: Option<&Scene>,
    folder: &Path,
) -> Result<Gallery, Failure> {
    let views = run.views();
    let [test, train, blurred] = [
        ("test", views.test.len()),
        ("train", views.train.len()),
        ("blurred", views.train.len()),
    ]
    .map(|(name, count)| Numbered::new(folder.join(name), ("", "png"), (5, count)));
    // Those of an earlier time may be more, or of another run.
    for pictures in [&test, &train, &blurred] {
        pictures.clear()?;
    }
    // Training looked at it before; here what is not whole is only not shown.
    let truth = scene.and_then(|scene| scene.truth().ok());
    let truth = truth.unwrap_or_default();
    let mut gallery = Gallery::new(&views.train, &views.test);
    let shown = sheet::frames(views.train.len());
    let mut rows = Vec::new();
    for index in 0..views.train.len() {
        let view = run.render_training_view(index)?;
        io::write_png(&train.path(index), &view.sharp)?;
        io::write_png(&blurred.path(index), &view.seen)?;
        let blurry = scene.and_then(|scene| Some(&scene.frames.get(index)?.view.image));
        let sharp = truth.sharp.as_ref().and_then(|sharp| sharp.get(index));
        gallery.add_frame(blurry, &view, sharp);
        if shown.contains(&index)
            && let Some(row) = sheet::row(blurry, &view)
        {
            rows.push(row);
        }
    }
    for (index, view) in views.test.iter().enumerate() {
        let image = run.render_view(&view.camera, &view.cam_from_world, view.time)?;
        io::write_png(&test.path(index), &image)?;
        // The scene may have other test views than when the run began.
        let same = |other: &&io::View| other.name == view.name;
        let taken = scene.and_then(|scene| scene.test.iter().find(same));
        gallery.add_test(&image, taken.map(|view| &view.image));
    }
    let sheet_file = folder.join("blur.png");
    if let Some(sheet) = sheet::stack(&rows) {
        io::write_png(&sheet_file, &sheet)?;
    } else if sheet_file.exists() {
        std::fs::remove_file(&sheet_file).map_err(|e| format!("{e}: {}", sheet_file.display()))?;
    }
    Ok(gallery)
}

/// The scene, for its blurry frames: where the user says it is, or where it was if it still is there.
pub(crate) fn frames(
    run: &Run,
    config: &Config,
    given: Option<&Path>,
) -> Result<Option<Scene>, Failure> {
    let scene = config.at(given).open_scene().and_then(|scene| {
        run.check_scene(&scene)?;
        Ok(scene)
    });
    match scene {
        Err(problem) if given.is_none() => {
            let problem = with_causes(&*problem);
            say!("note: the pictures of blur go without the blurry frames: {problem}");
            Ok(None)
        }
        scene => scene.map(Some),
    }
}

/// What `metrics.json` holds.
pub(crate) fn metrics<'a>(
    evaluation: &'a Evaluation,
    run: &'a Run,
    backend: Backend,
) -> Metrics<'a> {
    let settings = run.settings();
    Metrics {
        evaluation,
        seconds: run.seconds(),
        backend: backend.name(),
        seed: settings.seed,
        settings,
        changes: run.changes(),
    }
}

/// The scores in a few lines.
pub(crate) fn summary(evaluation: &Evaluation) -> String {
    let mut text = String::new();
    let mut line = |name: &str, scores: &Scores| {
        let figures = [
            ("PSNR", Some(scores.mean.psnr)),
            ("mPSNR", scores.mean.mpsnr),
            ("static", scores.mean.mpsnr_static),
            ("movers", scores.mean.mpsnr_dynamic),
        ];
        write!(text, "{name}:").expect("a string takes text");
        for (label, value) in figures {
            if let Some(value) = value {
                write!(text, " {label} {value:.2} dB").expect("a string takes text");
            }
        }
        if let Some(ssim) = scores.mean.ssim {
            write!(text, " SSIM {ssim:.4}").expect("a string takes text");
        }
        text.push('\n');
    };
    if let Some(scores) = &evaluation.test {
        line("test views", scores);
    }
    if let Some(scores) = &evaluation.train_sharp {
        line("sharp training views", scores);
    }
    if let Some(kernels) = &evaluation.kernels {
        let (found, centred) = (kernels.as_found, kernels.centred);
        writeln!(
            text,
            "kernels against the true ones: PSNR {:.2} dB, KL divergence {:.3}; each around its middle: {:.2} dB, {:.3}",
            found.psnr, found.kl, centred.psnr, centred.kl
        )
        .expect("a string takes text");
    }
    let counts = evaluation.gaussians;
    write!(
        text,
        "{} static and {} dynamic Gaussians",
        counts.fixed, counts.dynamic
    )
    .expect("a string takes text");
    if let Some(figures) = &evaluation.blur {
        write!(text, "; {figures}").expect("a string takes text");
    }
    text
}
