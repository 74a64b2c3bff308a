//! A study's file.

use crate::error::LabError;
use crate::perturb::Perturb;
use crate::score::Score;
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::Path;
use toml::{Table, Value};

/// Name of the variant that has the common settings and nothing else.
pub const BASELINE: &str = "baseline";

/// What is to be found out: scenes, seeds, what is varied, and what is scored.
///
/// Every scene is trained with every variant and every point of the knobs, once for each seed.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Study {
    /// Heading of the report.
    pub title: String,
    /// What is asked, in a few sentences; stands in the report.
    pub about: String,
    /// Folders below `--scenes`; `demo` is that of the repository.
    pub scenes: Vec<String>,
    /// Seeds of the runs.
    pub seeds: Vec<u64>,
    /// Settings that all runs share, as in a config file of `limpid train`; `profile = "paper"` is its flag.
    #[serde(default)]
    pub set: Table,
    /// The variant that others are compared with; without it, the common settings by themselves.
    pub baseline: Option<String>,
    /// The variant that could not be better. With it the report says how much of the way from the baseline each variant
    /// closes.
    pub bound: Option<String>,
    /// What is compared.
    #[serde(default)]
    pub variants: Vec<Variant>,
    /// Single settings and the values that each takes.
    #[serde(default)]
    pub knobs: Vec<Knob>,
    /// Whether every value of each knob meets every value of the others; else one at a time is turned.
    #[serde(default)]
    pub crossed: bool,
    /// The report's columns: names that [`Score`] knows, or dotted names of `metrics.json`.
    pub score: Vec<Score>,
    /// The picture.
    pub plot: Option<Plot>,
}

/// A bundle of settings with a name.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Name in the report.
    pub name: String,
    /// Settings on top of the common ones.
    #[serde(default)]
    pub set: Table,
    /// What of the scene is as in truth.
    #[serde(default)]
    pub truth: Vec<Truth>,
    /// What of the scene is worse than it is there.
    #[serde(default)]
    pub perturb: Perturb,
    /// The variant that this one is compared with; without it, the study's baseline.
    pub against: Option<String>,
    /// Scenes that it is not run on.
    #[serde(default)]
    pub except: Vec<String>,
}

/// A setting that is turned.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Knob {
    /// Name in the report.
    pub name: String,
    /// Dotted name of the setting, or `perturb.` and a field of [`Perturb`].
    pub key: String,
    /// Its values.
    pub values: Vec<Value>,
    /// The variant that it is turned on, and compared with; without it, the study's baseline.
    pub on: Option<String>,
    /// Scenes that it is not turned on.
    #[serde(default)]
    pub except: Vec<String>,
}

/// A part of a scene that can be as in truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Truth {
    /// Sharp training frames, `truth/images_sharp`.
    Images,
    /// Exact depth of the training frames, `truth/depth`.
    Depth,
}

/// The picture of a study.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plot {
    /// What to the right, on a logarithmic axis, every knob a curve; without it, variants stand side by side.
    pub x: Option<Score>,
    /// What upwards…
    pub y: Score,
    /// … and on scenes that have none of it.
    pub otherwise: Option<Score>,
    /// Whether the Pareto front is drawn: what nothing beats in both.
    #[serde(default)]
    pub front: bool,
}

impl Plot {
    /// All that it shows.
    fn scores(&self) -> impl Iterator<Item = (&'static str, &Score)> {
        let [x, otherwise] = [&self.x, &self.otherwise].map(Option::as_ref);
        let all = [("x", x), ("y", Some(&self.y)), ("otherwise", otherwise)];
        all.into_iter()
            .filter_map(|(key, score)| Some((key, score?)))
    }
}

impl Knob {
    /// The field of [`Perturb`] that it turns, where it does not turn a setting.
    pub(crate) fn perturbs(&self) -> Option<&str> {
        self.key.strip_prefix("perturb.")
    }

    fn check_values(&self, key: &str) -> Result<(), (String, String)> {
        if self.values.is_empty() {
            let problem = "at least one is needed".to_owned();
            return Err((format!("{key}.values"), problem));
        }
        let Some(part) = self.perturbs() else {
            return Ok(());
        };
        if !Perturb::PARTS.contains(&part) {
            let there = Perturb::PARTS.join("`, `");
            let problem = format!("nothing is perturbed by `{part}`; there are `{there}`");
            return Err((format!("{key}.key"), problem));
        }
        for (i, value) in self.values.iter().enumerate() {
            let checked = Perturb::default().with(part, value);
            checked.map_err(|problem| (format!("{key}.values[{i}]"), problem))?;
        }
        Ok(())
    }
}

impl Study {
    /// Reads a study's file and checks that what it names is there.
    ///
    /// # Errors
    /// The file cannot be read, is not TOML, has a key that there is not, or names a variant that it has not.
    pub fn read(path: &Path) -> Result<Self, LabError> {
        let text = std::fs::read_to_string(path).map_err(LabError::file(path))?;
        Self::parse(&text, path)
    }

    /// A study from the text of its file.
    ///
    /// # Errors
    /// See [`Study::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, LabError> {
        let wrong = |key: String, problem: String| LabError::Study {
            path: path.to_owned(),
            key,
            problem,
        };
        let parsed = toml::Deserializer::parse(text);
        let parsed = parsed.map_err(|e| wrong(String::new(), e.to_string()))?;
        let study: Self = serde_path_to_error::deserialize(parsed).map_err(|e| {
            let line = e.inner().span().map_or_else(String::new, |span| {
                let line = 1 + text[..span.start].matches('\n').count();
                format!(" (line {line})")
            });
            let key = e.path().to_string();
            // Without a place serde says `.`.
            let key = if key == "." { String::new() } else { key };
            wrong(key, format!("{}{line}", e.inner().message()))
        })?;
        study
            .check()
            .map_err(|(key, problem)| wrong(key, problem))?;
        Ok(study)
    }

    /// Name of the variant that others are compared with.
    #[must_use]
    pub fn baseline(&self) -> &str {
        self.baseline.as_deref().unwrap_or(BASELINE)
    }

    fn check(&self) -> Result<(), (String, String)> {
        let wrong = |key: &str, problem: String| Err((key.to_owned(), problem));
        for (key, is_empty) in [
            ("scenes", self.scenes.is_empty()),
            ("seeds", self.seeds.is_empty()),
            ("score", self.score.is_empty()),
        ] {
            if is_empty {
                return wrong(key, "at least one is needed".to_owned());
            }
        }
        for (key, score) in self.plot.iter().flat_map(Plot::scores) {
            if !self.score.contains(score) {
                let problem = format!("`{}` is not in `score`", score.name());
                return wrong(&format!("plot.{key}"), problem);
            }
        }
        for (i, scene) in self.scenes.iter().enumerate() {
            if self.scenes[..i].contains(scene) {
                return wrong("scenes", format!("`{scene}` is there twice"));
            }
        }
        for (i, seed) in self.seeds.iter().enumerate() {
            if self.seeds[..i].contains(seed) {
                return wrong("seeds", format!("{seed} is there twice"));
            }
        }
        let mut names = BTreeSet::new();
        if self.baseline.is_none() {
            names.insert(BASELINE);
        }
        for (i, variant) in self.variants.iter().enumerate() {
            if !names.insert(&variant.name) {
                let key = format!("variants[{i}].name");
                return wrong(&key, format!("there are two variants `{}`", variant.name));
            }
        }
        let known = |key: String, name: Option<&String>| match name {
            Some(name) if !names.contains(name.as_str()) => {
                let there: Vec<_> = names.iter().map(|n| format!("`{n}`")).collect();
                let there = there.join(", ");
                Err((key, format!("no variant `{name}`; there are {there}")))
            }
            _ => Ok(()),
        };
        known("baseline".to_owned(), self.baseline.as_ref())?;
        known("bound".to_owned(), self.bound.as_ref())?;
        for (i, variant) in self.variants.iter().enumerate() {
            known(format!("variants[{i}].against"), variant.against.as_ref())?;
            let checked = variant.perturb.check();
            checked
                .map_err(|(part, problem)| (format!("variants[{i}].perturb.{part}"), problem))?;
            self.check_scenes(&format!("variants[{i}].except"), &variant.except)?;
        }
        for (i, knob) in self.knobs.iter().enumerate() {
            known(format!("knobs[{i}].on"), knob.on.as_ref())?;
            self.check_scenes(&format!("knobs[{i}].except"), &knob.except)?;
            knob.check_values(&format!("knobs[{i}]"))?;
            if self.crossed && (knob.on.is_some() || !knob.except.is_empty()) {
                let problem = "knobs that are crossed have neither `on` nor `except`";
                return wrong(&format!("knobs[{i}]"), problem.to_owned());
            }
        }
        Ok(())
    }

    fn check_scenes(&self, key: &str, scenes: &[String]) -> Result<(), (String, String)> {
        match scenes.iter().find(|scene| !self.scenes.contains(scene)) {
            Some(scene) => Err((key.to_owned(), format!("the study has no scene `{scene}`"))),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = r#"
title = "T"
about = "A."
scenes = ["demo"]
seeds = [1]
score = ["all"]
"#;

    fn mistake(more: &str) -> String {
        let text = format!("{SMALL}{more}");
        let study = Study::parse(&text, Path::new("s.toml"));
        study.expect_err("a mistake").to_string()
    }

    #[test]
    fn mistakes_name_file_and_key() {
        for (more, told) in [
            ("sead = [1]", &["`sead`", "line 7"][..]),
            (
                "bound = \"b\"",
                &["`bound`", "no variant `b`", "`baseline`"],
            ),
            (
                "[[variants]]\nname = \"a\"\nsett = {}",
                &["`variants[0].sett`", "line 9", "unknown field"],
            ),
            (
                "[[variants]]\nname = \"a\"\ntruth = [\"poses\"]",
                &["`variants[0].truth[0]`", "`images`", "`depth`"],
            ),
            (
                "[[variants]]\nname = \"a\"\n[[variants]]\nname = \"a\"",
                &["`variants[1].name`", "two variants `a`"],
            ),
            (
                "[[variants]]\nname = \"a\"\nexcept = [\"dema\"]",
                &["`variants[0].except`", "no scene `dema`"],
            ),
            (
                "[[knobs]]\nname = \"K\"\nkey = \"blur.kernel_size\"\nvalues = []",
                &["`knobs[0].values`"],
            ),
            (
                "[[variants]]\nname = \"a\"\nperturb.tracks = 1",
                &["`variants[0].perturb.tracks`", "`tracks_px`"],
            ),
            (
                "[[variants]]\nname = \"a\"\nperturb.depth = 1.0",
                &["`variants[0].perturb.depth`", "below 1"],
            ),
            (
                "[[variants]]\nname = \"a\"\nperturb.poses_px = -1",
                &["`variants[0].perturb.poses_px`", "at least 0"],
            ),
            (
                "[[variants]]\nname = \"a\"\nperturb.tracks_px = nan",
                &["`variants[0].perturb.tracks_px`", "at least 0"],
            ),
            (
                "[[variants]]\nname = \"a\"\nperturb.mask_squares = 1.5",
                &["`variants[0].perturb.mask_squares`"],
            ),
            (
                "[[knobs]]\nname = \"t\"\nkey = \"perturb.tracks\"\nvalues = [1]",
                &["`knobs[0].key`", "`tracks_px`"],
            ),
            (
                "[[knobs]]\nname = \"d\"\nkey = \"perturb.depth\"\nvalues = [0.1, \"much\"]",
                &["`knobs[0].values[1]`", "much"],
            ),
            (
                "[[knobs]]\nname = \"m\"\nkey = \"perturb.mask_squares\"\nvalues = [70000]",
                &["`knobs[0].values[0]`", "70000"],
            ),
            ("[plot]\ny = \"all\"\nz = 1", &["`plot.z`"]),
            ("[plot]\ny = \"ssim\"", &["`plot.y`", "`ssim`", "`score`"]),
            ("about", &["line 7"]),
        ] {
            let said = mistake(more);
            for part in told.iter().chain(&["s.toml"]) {
                assert!(said.contains(part), "{more}: {said}");
            }
        }
    }

    #[test]
    fn no_scene_and_no_seed_counts_twice() {
        for (once, twice, key, told) in [
            ("[1]", "[2, 1, 2]", "`seeds`", "2 is there twice"),
            (
                "[\"demo\"]",
                "[\"demo\", \"a\", \"demo\"]",
                "`scenes`",
                "`demo` is there twice",
            ),
        ] {
            let text = SMALL.replace(once, twice);
            let said = Study::parse(&text, Path::new("s.toml")).expect_err("a mistake");
            let said = said.to_string();
            assert!(said.contains(key) && said.contains(told), "{said}");
        }
    }

    #[test]
    fn the_repositorys_studies_can_be_read() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("studies");
        let mut names = Vec::new();
        for entry in std::fs::read_dir(folder).expect("lab/studies/ can be read") {
            let path = entry.expect("an entry").path();
            Study::read(&path).unwrap_or_else(|e| panic!("{e}"));
            names.push(path.file_stem().expect("a name").to_owned());
        }
        assert!(names.iter().any(|n| n == "demo-study"), "{names:?}");
    }

    #[test]
    fn presets_in_studies_are_those_of_the_program() {
        let here = Path::new(env!("CARGO_MANIFEST_DIR"));
        let preset = |name: &str| -> Table {
            let file = here.join("../crates/limpid/presets").join(name);
            let text = std::fs::read_to_string(file.with_extension("toml")).expect("a preset");
            toml::from_str(&text).expect("TOML")
        };
        let defaults = preset("full");
        for (study, before) in [("presets", ""), ("trade", "preset ")] {
            let path = here.join("studies").join(study).with_extension("toml");
            let study = Study::read(&path).unwrap_or_else(|e| panic!("{e}"));
            for named in ["draft", "balanced", "full"] {
                let mut said = preset(named);
                // Groups of settings that are the defaults are said to take back another preset's, of which a study has none.
                said.retain(|group, values| !values.is_table() || defaults[group] != *values);
                let name = format!("{before}{named}");
                let variant = study.variants.iter().find(|v| v.name == name);
                let mut set = variant.expect("a variant").set.clone();
                // The blur model is the study's own choice.
                set.remove("blur");
                said.remove("blur");
                assert_eq!(set, said, "{name} in {}", path.display());
            }
        }
    }
}
