//! What a run leaves in its folder.

use crate::checkpoints;
use crate::config::{Backend, CONFIG_FILE};
use crate::failure::Failure;
use crate::sheet;
use io::Scene;
use serde::Serialize;
use std::fmt::Write as _;
use std::path::Path;
use trainer::{Change, Evaluation, Run, Scores, Settings, Trainer};

/// The names of a run's results in its folder.
const RESULTS: [&str; 5] = [
    CONFIG_FILE,
    "metrics.json",
    checkpoints::FOLDER,
    "renders",
    "scene.ply",
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

/// Removes another run's results, but nothing else.
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

/// Writes all pictures and the PLY, and scores.
pub(crate) fn write_all(trainer: &Trainer, out: &Path) -> Result<Evaluation, Failure> {
    let frames = Some(trainer.scene());
    write_renders(trainer.run(), frames, &out.join("renders"))?;
    io::write_ply(&out.join("scene.ply"), &trainer.model().gaussians(None))?;
    Ok(trainer.evaluate()?)
}

/// Writes `test/`, `train/`, `blurred/` and `blur.png`, whose blurry frames are those of `scene`.
pub(crate) fn write_renders(
    run: &Run,
    scene: Option<&Scene>,
    folder: &Path,
) -> Result<(), Failure> {
    let [test, train, blurred] = ["test", "train", "blurred"].map(|name| folder.join(name));
    for made in [&test, &train, &blurred] {
        std::fs::create_dir_all(made).map_err(|e| format!("{e}: {}", made.display()))?;
    }
    let views = run.views();
    for (index, view) in views.test.iter().enumerate() {
        let image = run.render_view(&view.camera, &view.cam_from_world, view.time)?;
        io::write_png(&test.join(format!("{index:05}.png")), &image)?;
    }
    let shown = sheet::frames(views.train.len());
    let mut rows = Vec::new();
    for index in 0..views.train.len() {
        let view = run.render_training_view(index)?;
        io::write_png(&train.join(format!("{index:05}.png")), &view.sharp)?;
        io::write_png(&blurred.join(format!("{index:05}.png")), &view.seen)?;
        let blurry = scene.and_then(|scene| Some(&scene.frames.get(index)?.view.image));
        if shown.contains(&index)
            && let Some(row) = sheet::row(blurry, &view)
        {
            rows.push(row);
        }
    }
    if let Some(sheet) = sheet::stack(&rows) {
        io::write_png(&folder.join("blur.png"), &sheet)?;
    }
    Ok(())
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
