//! What a run was asked for: scene, backend and settings, from a file, flags and `--set`.

use crate::failure::Failure;
use crate::keys::{Mistake, RUN_KEYS, line_of, typed};
use crate::say::say;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use toml::{Table, Value};
use trainer::{Change, Device, Settings};

/// Name of the file that holds a run's [`Config`].
pub(crate) const CONFIG_FILE: &str = "config.json";

/// Everything needed to repeat a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Config {
    /// What is trained on.
    pub(crate) run: RunOptions,
    /// How.
    pub(crate) settings: Settings,
    /// What of the settings was another before, and since when not.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) changes: Vec<Change>,
}

/// Scene and backend.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RunOptions {
    /// Folder of the scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) scene: Option<PathBuf>,
    /// Training frames from this folder of the scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) images: Option<PathBuf>,
    /// Pictures are made smaller by this factor.
    pub(crate) downscale: Option<usize>,
    /// Movers are ignored.
    #[serde(rename = "static")]
    pub(crate) is_static: bool,
    /// What is done about lens distortion.
    pub(crate) distortion: Distortion,
    /// Where tensors live.
    pub(crate) backend: Backend,
}

/// What is done about lens distortion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Distortion {
    /// Pictures, depth, masks and tracks are undistorted on loading.
    #[default]
    Undistort,
    /// It is an error.
    Refuse,
}

impl Distortion {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Undistort => "undistort",
            Self::Refuse => "refuse",
        }
    }
}

/// Where tensors live.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Backend {
    /// The CPU, pure Rust.
    #[default]
    Flex,
    /// A second CPU backend, slow; needs the feature `ndarray`.
    Ndarray,
    /// Any GPU, by Vulkan, Metal, DX12 or OpenGL; needs the feature `wgpu`.
    Wgpu,
    /// An NVIDIA GPU, by CUDA; needs the feature `cuda`.
    Cuda,
}

impl Backend {
    /// Whether tensors live in main memory.
    pub(crate) fn is_cpu(self) -> bool {
        matches!(self, Self::Flex | Self::Ndarray)
    }

    /// The name that `--backend` takes.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Flex => "flex",
            Self::Ndarray => "ndarray",
            Self::Wgpu => "wgpu",
            Self::Cuda => "cuda",
        }
    }

    /// The device, if this build has it.
    pub(crate) fn device(self) -> Result<Device, Failure> {
        match self {
            #[cfg(feature = "flex")]
            Self::Flex => Ok(Device::flex()),
            #[cfg(feature = "ndarray")]
            Self::Ndarray => {
                #[expect(deprecated, reason = "kept as a second, independent CPU backend")]
                let device = Device::ndarray();
                Ok(device)
            }
            #[cfg(feature = "wgpu")]
            Self::Wgpu => gpu("wgpu"),
            #[cfg(feature = "cuda")]
            Self::Cuda => gpu("cuda"),
            #[allow(unreachable_patterns, reason = "with all features on nothing is left")]
            other => Err(format!(
                "--backend {0}: this build lacks it; build with `--features {0}` (`cargo xtask train --backend {0}` does)",
                other.name()
            )
            .into()),
        }
    }
}

/// The best GPU that a runtime reaches.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn gpu(runtime: &str) -> Result<Device, Failure> {
    let gpu = trainer::Gpu::best(runtime).map_err(|why| {
        format!(
            "--backend {runtime}: {why}; `limpid devices` lists what there is, and --backend flex takes the CPU"
        )
    })?;
    if gpu.is_software {
        crate::say::say!(
            "note: {} is played by the CPU: --backend flex is many times faster",
            gpu.name
        );
    } else {
        crate::say::say!("on {}", gpu.name);
    }
    Ok(gpu.device)
}

impl RunOptions {
    /// Pictures are made so many times smaller.
    pub(crate) fn factor(&self) -> usize {
        self.downscale.unwrap_or(1)
    }
}

impl Config {
    /// What is asked for where nothing is said.
    pub(crate) fn of(settings: Settings) -> Self {
        Self {
            run: RunOptions::default(),
            settings,
            changes: Vec::new(),
        }
    }

    /// Run options and settings in one table, as a config file has them.
    fn table(&self) -> Result<Table, Failure> {
        let mut table = Table::try_from(&self.settings)?;
        merge(&mut table, Table::try_from(&self.run)?);
        Ok(table)
    }

    /// Reads a run's configuration from its output folder.
    pub(crate) fn of_run(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(CONFIG_FILE);
        let text = std::fs::read_to_string(&path).map_err(|e| {
            format!(
                "{} holds no finished or started run: {e}: {}",
                folder.display(),
                path.display()
            )
        })?;
        parse_json(&text, &path)
    }

    /// An error if these options ask for other pictures than a run's own; the scene may have moved, to another device too.
    pub(crate) fn check_reading(&self, asked: &RunOptions) -> Result<(), Failure> {
        let said = |options: &RunOptions| {
            let images = options.images.as_deref();
            [
                (
                    "images",
                    images.map_or_else(|| "not set".to_owned(), |path| path.display().to_string()),
                ),
                ("downscale", options.factor().to_string()),
                ("static", options.is_static.to_string()),
                ("distortion", options.distortion.name().to_owned()),
            ]
        };
        for ((key, here), (_, there)) in said(asked).into_iter().zip(said(&self.run)) {
            if here != there {
                return Err(format!(
                    "`{key}` is {here} here and {there} in the run: a run goes on with the pictures that it was started with"
                )
                .into());
            }
        }
        Ok(())
    }

    /// The same with the scene in another place, if one is given.
    pub(crate) fn at(&self, scene: Option<&Path>) -> Self {
        let mut moved = self.clone();
        if let Some(scene) = scene {
            moved.run.scene = Some(scene.to_owned());
        }
        moved
    }

    /// The same on another backend, if one is given.
    pub(crate) fn on(mut self, backend: Option<Backend>) -> Self {
        self.run.backend = backend.unwrap_or(self.run.backend);
        self
    }

    /// The scene of this run, loaded.
    pub(crate) fn open_scene(&self) -> Result<io::Scene, Failure> {
        let dir = self.run.scene.as_deref();
        let dir = dir.ok_or("no scene: give its folder with --scene DIR")?;
        let options = io::LoadOptions {
            downscale: self.run.factor(),
            images: self.run.images.clone(),
            static_scene: self.run.is_static,
            refuse_distortion: self.run.distortion == Distortion::Refuse,
        };
        Ok(io::Scene::open_with(dir, &options)?)
    }
}

fn parse_json(text: &str, path: &Path) -> Result<Config, Failure> {
    io::parse_json(text.as_bytes(), path).map_err(|error| match error {
        io::IoError::Json {
            key, problem, line, ..
        } => {
            let inner = ["settings.", "run."].map(|group| key.strip_prefix(group));
            let key = inner.into_iter().flatten().next().unwrap_or(&key);
            in_file(path, Some(line), &Mistake::new(key, &problem))
        }
        error => error.into(),
    })
}

/// A mistake with its file, and its line where that is known.
fn in_file(path: &Path, line: Option<usize>, mistake: &Mistake) -> Failure {
    let line = line.map_or_else(String::new, |line| format!("line {line}: "));
    format!("{line}{mistake}: {}", path.display()).into()
}

/// Whether a config file is a run's `config.json`, which has all settings.
pub(crate) fn is_of_a_run(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "json")
}

/// A config file (or a run's `config.json`) as a table; a relative scene is relative to the file.
pub(crate) fn read_table(path: &Path) -> Result<Table, Failure> {
    let text = std::fs::read_to_string(path).map_err(|e| format!("{e}: {}", path.display()))?;
    if is_of_a_run(path) {
        let config = parse_json(&text, path)?;
        if !config.changes.is_empty() {
            say!(
                "note: the run of {} was changed on its way (`changes` there); this one has from the beginning what it had in the end",
                path.display()
            );
        }
        return config.table();
    }
    let mut table: Table = toml::from_str(&text).map_err(|e| format!("{e}: {}", path.display()))?;
    split(table.clone()).map_err(|e| in_file(path, line_of(&text, &e.key), &e))?;
    if let Some(Value::String(scene)) = table.get("scene") {
        let joined = path.parent().unwrap_or(Path::new("")).join(scene);
        table.insert(
            "scene".to_owned(),
            Value::String(joined.to_string_lossy().into_owned()),
        );
    }
    Ok(table)
}

/// Sets a dotted key (`blur.kernel_size`) to a value in TOML's notation; text needs no quotes.
pub(crate) fn set(table: &mut Table, assignment: &str) -> Result<(), Failure> {
    let (key, text) = assignment.split_once('=').ok_or_else(|| {
        format!("--set {assignment}: write key=value, for example blur.kernel_size=7")
    })?;
    let value = format!("v = {text}")
        .parse::<Table>()
        .ok()
        .and_then(|mut t| t.remove("v"))
        .unwrap_or_else(|| Value::String(text.to_owned()));
    // By itself first, where it is known who said it.
    let mut alone = Table::new();
    insert(&mut alone, key.trim(), value.clone());
    split(alone).map_err(|e| format!("--set {assignment}: {e}"))?;
    insert(table, key.trim(), value);
    Ok(())
}

/// Inserts a value under a dotted key.
pub(crate) fn insert(table: &mut Table, key: &str, value: Value) {
    let (first, value) = match key.split_once('.') {
        None => (key, value),
        Some((first, rest)) => {
            // A choice by its name alone, such as `srgb`, gives way to one with a number.
            let mut inner = match table.remove(first) {
                Some(Value::Table(inner)) => inner,
                _ => Table::new(),
            };
            insert(&mut inner, rest, value);
            (first, Value::Table(inner))
        }
    };
    table.insert(first.to_owned(), value);
}

/// Lays `over` on `base`, group by group.
pub(crate) fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(inner)), Value::Table(value)) => merge(inner, value),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// Run options and settings; what the table leaves out has its default.
fn split(mut table: Table) -> Result<Config, Mistake> {
    let mut run = Table::new();
    for key in RUN_KEYS {
        if let Some(value) = table.remove(key) {
            run.insert(key.to_owned(), value);
        }
    }
    Ok(Config {
        run: typed(run)?,
        settings: typed(table)?,
        changes: Vec::new(),
    })
}

/// Run options and settings; what the table leaves out is as in `base`.
pub(crate) fn from_table(table: Table, base: &Config) -> Result<Config, Failure> {
    let mut all = base.table()?;
    merge(&mut all, table);
    let config = Config {
        changes: base.changes.clone(),
        ..split(all).map_err(|e| e.to_string())?
    };
    config.settings.validate()?;
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;
    use trainer::settings::TransferKind;

    fn table(text: &str) -> Table {
        text.parse().expect("toml")
    }

    #[test]
    fn files_flags_and_set_are_laid_on_the_defaults() {
        let mut t = table("downscale = 2\niterations = 500\n[blur]\nkernel_size = 7\n");
        set(&mut t, "blur.kernel_size=5").expect("set");
        set(&mut t, "loss.gauge=0.5").expect("set");
        set(&mut t, "backend=ndarray").expect("text without quotes");
        set(&mut t, "distortion=refuse").expect("text without quotes");
        let config = from_table(t, &Config::of(Settings::default())).expect("config");
        assert_eq!(config.run.downscale, Some(2));
        assert_eq!(config.run.backend, Backend::Ndarray);
        assert_eq!(config.run.distortion, Distortion::Refuse);
        assert_eq!(config.settings.iterations, 500);
        assert_eq!(config.settings.blur.kernel_size, 5);
        assert_eq!(config.settings.loss.gauge, 0.5);
        assert_eq!(config.settings.unseen, Settings::default().unseen);
    }

    #[test]
    fn a_choice_with_a_number_takes_the_place_of_one_by_its_name_and_the_other_way_round() {
        let settings = |table: Table| {
            let config = from_table(table, &Config::of(Settings::default()));
            config.expect("settings").settings.camera.transfer
        };
        // As a run's config.json has it.
        let mut t = Config::of(Settings::default()).table().expect("a table");
        set(&mut t, "camera.transfer.power=2.2").expect("a transfer");
        assert_eq!(settings(t.clone()), TransferKind::Power(2.2));
        set(&mut t, "camera.transfer=srgb").expect("a transfer");
        assert_eq!(settings(t), TransferKind::Srgb);
    }

    #[test]
    fn mistakes_are_named() {
        for (assignment, told) in [
            ("blur", &["key=value"][..]),
            ("blur.kernel_size=8", &["blur.kernel_size"]),
            (
                "blur.kernel_size=abc",
                &[
                    "--set blur.kernel_size=abc",
                    "`blur.kernel_size`",
                    "\"abc\"",
                    "a whole number",
                    "such as 9",
                ],
            ),
            ("blur.kernal_size=7", &["did you mean `blur.kernel_size`?"]),
            ("blur=7", &["`blur`", "a group of settings"]),
            ("iterations.more=7", &["`iterations`", "a whole number"]),
            ("loss.gauge=true", &["`loss.gauge`", "expected a number"]),
            ("blur.model=camara", &["`blur.model`", "camara", "`camera`"]),
            ("downscale=-1", &["`downscale`", "-1"]),
            ("backend=gpu", &["`backend`", "`wgpu`"]),
        ] {
            let mut t = Table::new();
            let failed = set(&mut t, assignment)
                .and_then(|()| from_table(t, &Config::of(Settings::default())));
            let text = failed.expect_err("a mistake").to_string();
            for part in told {
                assert!(text.contains(part), "{assignment}: {text}");
            }
        }
    }

    #[test]
    fn mistakes_in_files_are_named_with_their_line() {
        let folder = tempfile::tempdir().expect("a folder");
        let whole = Config {
            run: RunOptions::default(),
            settings: Settings::default(),
            changes: Vec::new(),
        };
        let json = serde_json::to_string_pretty(&whole).expect("json");
        let at = json
            .lines()
            .position(|line| line.contains("\"kernel_size\""));
        let line = format!("line {}: ", at.expect("it has all settings") + 1);
        let size = format!("\"kernel_size\": {}", whole.settings.blur.kernel_size);
        let in_json = |with: &str| json.replace(&size, with);
        for (name, text, told) in [
            (
                "a.toml",
                "iterations = 500\n[blur]\nkernel_size = \"abc\"\n".to_owned(),
                [
                    "line 3: ",
                    "`blur.kernel_size`",
                    "\"abc\"",
                    "a whole number",
                ],
            ),
            (
                "a.toml",
                "\n[blur]\nkernal_size = 7\n".to_owned(),
                [
                    "line 3: ",
                    "`blur.kernal_size`",
                    "did you mean",
                    "`blur.kernel_size`",
                ],
            ),
            (
                "a.toml",
                "backend = 3\n".to_owned(),
                ["line 1: ", "`backend`", "expected a name", ""],
            ),
            (
                "a.toml",
                "[blur]\nkernel_size = \n".to_owned(),
                ["line 2", "kernel_size", "", ""],
            ),
            (
                "a.json",
                in_json("\"kernel_size\": \"abc\""),
                [&line, "`blur.kernel_size`", "\"abc\"", "a whole number"],
            ),
            (
                "a.json",
                in_json("\"kernal_size\": 7"),
                [
                    &line,
                    "`blur.kernal_size`",
                    "did you mean",
                    "`blur.kernel_size`",
                ],
            ),
            (
                "a.json",
                in_json("\"kernel_size\": NaN"),
                [&line, "`blur.kernel_size`", "NaN", "no number"],
            ),
            (
                "a.json",
                "{}".to_owned(),
                ["line 1: ", "missing", "run", ""],
            ),
        ] {
            let path = folder.path().join(name);
            std::fs::write(&path, text).expect("a file");
            let failed = read_table(&path).expect_err("a mistake").to_string();
            for part in told.into_iter().chain([name]) {
                assert!(failed.contains(part), "{part}: {failed}");
            }
        }
    }

    #[test]
    fn a_config_survives_json() {
        let base = Config::of(Settings::paper());
        let mut config = from_table(table("scene = \"a\"\nstatic = true"), &base).expect("config");
        config.run.images = Some("truth/images_sharp".into());
        let text = serde_json::to_string(&config).expect("json");
        assert_eq!(serde_json::from_str::<Config>(&text).expect("json"), config);
    }
}
