//! Writes the report of a run that is there, anew.

use crate::checkpoints;
use crate::config::Config;
use crate::failure::Failure;
use crate::log;
use crate::outputs;
use crate::report::{self, Gallery};
use crate::say::say;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;
use std::path::{Path, PathBuf};
use trainer::Run;

/// Whether the report is there and not older than the checkpoint.
pub(crate) fn is_current(out: &Path) -> bool {
    let written = |path: PathBuf| path.metadata().and_then(|data| data.modified()).ok();
    let checkpoint = written(checkpoints::file(out));
    written(out.join(report::FILE))
        .is_some_and(|report| checkpoint.is_none_or(|saved| saved <= report))
}

/// Renders a run's last checkpoint and writes its report, unless one [`stays`]; `scene` is where the scene is now, if it has moved.
pub(crate) fn write(out: &Path, config: &Config, scene: Option<&Path>) -> Result<(), Failure> {
    let run = checkpoints::open(out, config)?;
    let scene = outputs::frames(&run, config, scene)?;
    if stays(out, &run, scene.is_some()) {
        return Ok(());
    }
    say!("writing {} …", out.join(report::FILE).display());
    let gallery = outputs::write_renders(&run, scene.as_ref(), &out.join("renders"))?;
    write_with(out, &run, &gallery)
}

/// Whether the report that is there is the better one: where the scene is not at hand, one of the same iteration has blurry frames that
/// a new one would lack.
pub(crate) fn stays(out: &Path, run: &Run, has_scene: bool) -> bool {
    !has_scene && reported(out) == Some(run.iteration())
}

/// After how many iterations the report was written.
fn reported(out: &Path) -> Option<usize> {
    #[derive(Deserialize)]
    struct Age {
        iterations: usize,
    }
    report::read::<Age, IgnoredAny>(out).map(|(facts, _)| facts.iterations)
}

/// Writes the report with these pictures.
pub(crate) fn write_with(out: &Path, run: &Run, gallery: &Gallery) -> Result<(), Failure> {
    // As it was trained, wherever it is rendered.
    let config = Config::of_run(out)?;
    // Scores of an earlier state are none of this one.
    let metrics = io::read_json::<Value>(&out.join(outputs::METRICS_FILE)).unwrap_or(Value::Null);
    let metrics = if metrics["iterations"] == run.iteration() {
        metrics
    } else {
        Value::Null
    };
    let mut curves = log::read(&out.join(log::LOG_FILE));
    curves.retain(|line| line.iteration <= run.iteration());
    report::write(out, run, &config, gallery, (&metrics, &curves))
}
