//! What a run is asked for on the command line.

use crate::config::{self, Backend, Distortion};
use crate::failure::Failure;
use crate::preset::Preset;
use crate::watch::WatchArguments;
use std::path::{Path, PathBuf};
use toml::{Table, Value};
use trainer::Settings;

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
    /// Number of iterations [default: 3000, with `--profile paper` 40000].
    #[arg(long, value_name = "N")]
    pub(crate) iterations: Option<usize>,
    /// Train as many iterations as fit into so many minutes on this machine, start and end included; no more than otherwise.
    #[arg(long, value_name = "M", value_parser = minutes, conflicts_with = "resume")]
    pub(crate) minutes: Option<f64>,
    /// Train in runs that double in length, from 750 iterations to the number given, until one gains hardly anything on pixels
    /// that are held back (`frames.held_back`, 0.03 of each frame): takes up to four times as long as the one that it keeps.
    #[arg(long, conflicts_with_all = ["minutes", "resume"])]
    pub(crate) until_done: bool,
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
    /// What to do about lens distortion [default: undistort].
    #[arg(long)]
    distortion: Option<Distortion>,
    /// Where tensors live [default: flex].
    #[arg(long)]
    backend: Option<Backend>,
    /// Start from other defaults.
    #[arg(long)]
    profile: Option<Profile>,
    /// What the run may cost; wins over the file of --config, and other flags win over it.
    #[arg(long)]
    preset: Option<Preset>,
    /// Settings from a TOML file, or from the config.json of another run; flags win over it.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Seed of every random choice [default: 1].
    #[arg(long, value_name = "S", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: Option<u64>,
    /// Go on from the checkpoint in the results' folder, with the settings of the run; --iterations may make it longer.
    #[arg(long)]
    pub(crate) resume: bool,
    /// With --resume: let learning rates change on the way (`--set learning_rates.…`).
    #[arg(long, requires = "resume")]
    pub(crate) allow_change: bool,
    /// Replace the results of an earlier run.
    #[arg(long, conflicts_with = "resume")]
    pub(crate) force: bool,
    /// Train on files that cannot be right (see `limpid check`).
    #[arg(long, conflicts_with = "resume")]
    pub(crate) unchecked: bool,
    /// Say as JSON with which settings it would be trained, and do no more.
    #[arg(long, conflicts_with_all = ["resume", "minutes", "until_done"])]
    pub(crate) dry_run: bool,
    /// Set any setting, for example `--set blur.kernel_size=7`.
    #[arg(long = "set", value_name = "key=value")]
    set: Vec<String>,
    #[command(flatten)]
    pub(crate) watch: WatchArguments,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Blur {
    /// Nothing where frames are alike in sharpness, else the camera.
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

impl TrainArguments {
    /// The folder of the results of a run on this scene.
    pub(crate) fn out(&self, scene: Option<&Path>) -> Result<PathBuf, Failure> {
        if let Some(out) = &self.out {
            return Ok(out.clone());
        }
        let name = scene.and_then(Path::file_name).ok_or(
            "no scene: give --scene DIR, or --config FILE with a line `scene = \"DIR\"` (and --out DIR for where the results go)",
        )?;
        Ok(Path::new("out").join(name))
    }

    /// What is taken where nothing is said.
    pub(crate) fn defaults(&self) -> Settings {
        match self.profile {
            Some(Profile::Paper) => Settings::paper(),
            None => Settings::default(),
        }
    }

    /// What is asked for: file, then preset, then flags, then `--set`.
    pub(crate) fn table(&self) -> Result<Table, Failure> {
        let mut table = match &self.config {
            Some(path) => config::read_table(path)?,
            None => Table::new(),
        };
        if let Some(path) = &self.config
            && self.profile.is_some()
            && config::is_of_a_run(path)
        {
            return Err(format!(
                "{} says every setting, and nothing would be left of --profile, which are other defaults: leave one of the two out",
                path.display()
            )
            .into());
        }
        if let Some(preset) = self.preset {
            config::merge(&mut table, preset.table()?);
        }
        let number = |n: usize| Value::Integer(i64::try_from(n).unwrap_or(i64::MAX));
        let path = |p: &Path| Value::String(p.to_string_lossy().into_owned());
        let flags = [
            ("scene", self.scene.as_deref().map(path)),
            ("images", self.images.as_deref().map(path)),
            ("iterations", self.iterations.map(number)),
            ("downscale", self.downscale.map(number)),
            ("static", self.is_static.then_some(Value::Boolean(true))),
            (
                "distortion",
                self.distortion.map(|d| Value::String(d.name().to_owned())),
            ),
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
                config::insert(&mut table, key, value);
            }
        }
        self.set_by_name(&mut table)?;
        Ok(table)
    }

    /// Whether a flag says how many iterations there are to be.
    pub(crate) fn says_a_length(&self) -> Result<bool, Failure> {
        let mut named = Table::new();
        self.set_by_name(&mut named)?;
        Ok(self.iterations.is_some() || named.contains_key("iterations"))
    }

    fn set_by_name(&self, table: &mut Table) -> Result<(), Failure> {
        let mut all = self.set.iter();
        all.try_for_each(|assignment| config::set(table, assignment))
    }
}

fn minutes(text: &str) -> Result<f64, String> {
    let minutes: f64 = text.parse().map_err(|e| format!("{e}"))?;
    if minutes.is_finite() && minutes > 0.0 {
        Ok(minutes)
    } else {
        Err("must be a positive number of minutes, such as 5 or 0.5".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, from_table};
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        train: TrainArguments,
    }

    #[test]
    fn a_preset_wins_over_a_file_and_flags_win_over_both() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("limpid.toml");
        std::fs::write(
            &file,
            "iterations = 1000\nseed = 7\n[camera]\nsamples = 6\nspacing_px = 1.0\n",
        )
        .expect("a file");
        let of = |more: &[&str]| {
            let file = file.to_str().expect("UTF-8");
            let line = Line::parse_from([&["train", "--config", file], more].concat());
            let table = line.train.table().expect("a table");
            let config = from_table(table, &Config::of(line.train.defaults()));
            config.expect("settings").settings
        };
        let draft = of(&["--preset", "draft"]);
        assert!(draft.iterations < 1000 && draft.camera.samples < 6);
        assert_eq!(draft.seed, 7);
        let longer = of(&["--preset", "draft", "--iterations", "700"]);
        assert_eq!((longer.iterations, longer.camera), (700, draft.camera));
        let full = of(&["--preset", "full"]);
        let defaults = Settings::default();
        assert_eq!(full.iterations, defaults.iterations);
        assert_eq!(full.camera.samples, defaults.camera.samples);
        assert_eq!(full.camera.spacing_px, 1.0, "a preset says nothing of it");
        let set = of(&["--preset", "full", "--set", "camera.samples=5"]);
        assert_eq!(set.camera.samples, 5);
    }
}
