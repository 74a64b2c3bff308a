//! `limpid eval`.

use crate::checkpoints;
use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::outputs;
use crate::say::print;
use std::path::PathBuf;
use std::process::ExitCode;
use trainer::ColorMap;

/// Arguments of `limpid eval`.
#[derive(Debug, clap::Args)]
pub(crate) struct EvalArguments {
    /// Folder with a run's results.
    run: PathBuf,
    /// Folder of the scene, where it is no longer at the place it was trained from.
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// JSON file with `gain` and `offset` (8-bit units) per channel that bring the test pictures' colours to the training camera's.
    /// A relative path that is not found is looked for in the scene's folder.
    #[arg(long, value_name = "FILE")]
    colour_map: Option<PathBuf>,
    /// Where tensors live [default: where they did in training].
    #[arg(long)]
    backend: Option<Backend>,
    /// Write the scores in the form of metrics.json: to this file, or without one to standard output in the place of text.
    #[arg(long, value_name = "FILE", num_args = 0..=1)]
    json: Option<Option<PathBuf>>,
}

/// What of a colour map's file counts.
#[derive(serde::Deserialize)]
struct ColorMapFile {
    gain: [f64; 3],
    offset: [f64; 3],
}

pub(crate) fn run(arguments: &EvalArguments) -> Result<ExitCode, Failure> {
    let config = Config::of_run(&arguments.run)?.on(arguments.backend);
    let run = checkpoints::open(&arguments.run, &config)?;
    let scene = config.at(arguments.scene.as_deref()).open_scene()?;
    let colors = match &arguments.colour_map {
        None => None,
        Some(given) => {
            let path = if given.exists() {
                given.clone()
            } else {
                scene.root.join(given)
            };
            let file: ColorMapFile = io::read_json(&path)?;
            Some(ColorMap {
                gain: file.gain,
                offset: file.offset,
            })
        }
    };
    let evaluation = run.evaluate(&scene, colors.as_ref())?;
    let metrics = outputs::metrics(&evaluation, &run, config.run.backend);
    let text = match &arguments.json {
        Some(None) => serde_json::to_string_pretty(&metrics)?,
        Some(Some(_)) | None => outputs::summary(&evaluation),
    };
    print(&text)?;
    if let Some(Some(path)) = &arguments.json {
        io::write_json(path, &metrics)?;
    }
    Ok(ExitCode::SUCCESS)
}
