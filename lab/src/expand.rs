//! A study as runs: what each is told, and its name.

use crate::error::LabError;
use crate::hash::{hashed, hex};
use crate::perturb::Perturb;
use crate::study::{BASELINE, Knob, Study, Truth};
use std::collections::BTreeMap;
use std::path::Path;
use toml::{Table, Value};

/// Settings by their dotted names.
type Settings = BTreeMap<String, Value>;

/// One of the things that a study compares: a variant, or a point of a knob.
#[derive(Clone, Debug)]
pub struct Arm {
    /// Name in the report.
    pub name: String,
    /// The arm that it is compared with.
    pub against: Option<String>,
    /// The knob that it is a point of.
    pub knob: Option<String>,
    settings: Settings,
    truth: Vec<Truth>,
    perturb: Perturb,
    except: Vec<String>,
}

/// A run that a study asks for.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// Its name: a hash of all that its result depends on.
    pub id: String,
    /// The scene's name in the study.
    pub scene: String,
    /// Parts of the scene that are replaced by their truth.
    pub replaced: Vec<Truth>,
    /// Parts that are worse than in the scene.
    pub perturb: Perturb,
    /// Seed of every random choice.
    pub seed: u64,
    /// Its length.
    pub iterations: usize,
    /// Arguments of `limpid train` but for `--scene` and `--out`.
    pub arguments: Vec<String>,
}

/// A cell of a study: an arm on a scene with a seed, and the run that fills it. Two arms that say the same share a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Case {
    /// The scene's name.
    pub scene: String,
    /// The arm's name.
    pub arm: String,
    /// What the arm asks for, as a hash (`Arm::asks`).
    pub asks: String,
    /// Seed.
    pub seed: u64,
    /// What is run.
    pub run: Run,
}

/// All that a study compares, in the order of its file.
///
/// # Errors
/// A name that is there twice.
pub fn arms(study: &Study, path: &Path) -> Result<Vec<Arm>, LabError> {
    let mut common = Settings::new();
    flatten("", &study.set, &mut common);
    let mut arms = Vec::new();
    if study.baseline.is_none() {
        arms.push(Arm {
            name: BASELINE.to_owned(),
            against: None,
            knob: None,
            settings: common.clone(),
            truth: Vec::new(),
            perturb: Perturb::default(),
            except: Vec::new(),
        });
    }
    for variant in &study.variants {
        let mut settings = common.clone();
        flatten("", &variant.set, &mut settings);
        let against = variant.against.as_deref().unwrap_or(study.baseline());
        arms.push(Arm {
            against: (against != variant.name).then(|| against.to_owned()),
            name: variant.name.clone(),
            knob: None,
            settings,
            truth: variant.truth.clone(),
            perturb: variant.perturb,
            except: variant.except.clone(),
        });
    }
    let points = if study.crossed {
        crossed(study, &arms)
    } else {
        turned(study, &arms)
    };
    arms.extend(points);
    for (i, arm) in arms.iter().enumerate() {
        if arms[..i].iter().any(|other| other.name == arm.name) {
            return Err(LabError::Study {
                path: path.to_owned(),
                key: "knobs".to_owned(),
                problem: format!("`{}` is there twice", arm.name),
            });
        }
    }
    Ok(arms)
}

/// The arm of a name that the study was checked to have.
fn named<'a>(arms: &'a [Arm], name: &str) -> &'a Arm {
    let found = arms.iter().find(|arm| arm.name == name);
    found.expect("a study names arms that it has")
}

/// One knob at a time.
fn turned(study: &Study, arms: &[Arm]) -> Vec<Arm> {
    let of_knob = |knob: &Knob| {
        let on = named(arms, knob.on.as_deref().unwrap_or(study.baseline()));
        let except: Vec<String> = on.except.iter().chain(&knob.except).cloned().collect();
        let points = knob.values.iter().map(move |value| {
            let mut point = Arm {
                name: String::new(),
                against: Some(on.name.clone()),
                knob: Some(knob.name.clone()),
                except: except.clone(),
                ..on.clone()
            };
            point.turn(knob, value);
            point
        });
        points.collect::<Vec<_>>()
    };
    study.knobs.iter().flat_map(of_knob).collect()
}

/// Every value of each knob with every value of the others.
fn crossed(study: &Study, arms: &[Arm]) -> Vec<Arm> {
    let on = named(arms, study.baseline());
    let mut points = vec![Arm {
        name: String::new(),
        against: Some(on.name.clone()),
        knob: None,
        ..on.clone()
    }];
    for knob in &study.knobs {
        points = points
            .iter()
            .flat_map(|point| {
                knob.values.iter().map(move |value| {
                    let mut point = point.clone();
                    point.turn(knob, value);
                    point
                })
            })
            .collect();
    }
    points.retain(|point| !point.name.is_empty());
    points
}

/// Every cell of a study; with seeds outermost, so that a study half-way has every arm with some of them.
///
/// `program` is the fingerprint of the program that runs.
///
/// # Errors
/// A name that is there twice, or a run without `iterations`.
pub fn cases(study: &Study, path: &Path, program: &str) -> Result<Vec<Case>, LabError> {
    let arms = arms(study, path)?;
    let mut cases = Vec::new();
    for &seed in &study.seeds {
        for scene in &study.scenes {
            for arm in arms.iter().filter(|arm| !arm.except.contains(scene)) {
                let run = arm.run(scene, seed, program).map_err(|problem| {
                    let (path, key) = (path.to_owned(), "set".to_owned());
                    LabError::Study { path, key, problem }
                })?;
                cases.push(Case {
                    scene: scene.clone(),
                    arm: arm.name.clone(),
                    asks: arm.asks(),
                    seed,
                    run,
                });
            }
        }
    }
    Ok(cases)
}

impl Arm {
    /// Whether it is given something that nobody has outside of a laboratory.
    #[must_use]
    pub fn is_given_truth(&self) -> bool {
        !self.truth.is_empty()
    }

    /// Whether its inputs are worse than there are.
    #[must_use]
    pub fn is_perturbed(&self) -> bool {
        self.perturb.is_any()
    }

    /// Hash of what its runs are told, whatever the scene, the seed and the program: an arm that keeps its name and is something
    /// else now has another.
    pub(crate) fn asks(&self) -> String {
        let (truth, perturbed) = (format!("{:?}", self.truth), self.perturb.names());
        let settings = self.settings.iter();
        let settings: Vec<String> = settings.map(|(k, v)| format!("{k}={}", text(v))).collect();
        let parts = std::iter::once(truth.as_str());
        let more = perturbed.iter().chain(&settings).map(String::as_str);
        hex(&hashed(parts.chain(more))[..8])
    }

    /// Turns a knob to a value, which its name then says.
    fn turn(&mut self, knob: &Knob, value: &Value) {
        match knob.perturbs() {
            Some(part) => {
                let turned = self.perturb.with(part, value);
                self.perturb = turned.expect("a study's values were checked");
            }
            None => insert(&knob.key, value, &mut self.settings),
        }
        if !self.name.is_empty() {
            self.name.push_str(", ");
        }
        self.name += &format!("{} = {}", knob.name, text(value));
    }

    fn run(&self, scene: &str, seed: u64, program: &str) -> Result<Run, String> {
        let mut settings = self.settings.clone();
        for (key, instead) in [("seed", "seeds"), ("scene", "scenes")] {
            if settings.contains_key(key) {
                return Err(format!(
                    "`{key}` is not a setting of a study: say `{instead}`"
                ));
            }
        }
        let iterations = settings.get("iterations").and_then(Value::as_integer);
        let iterations = iterations.and_then(|n| usize::try_from(n).ok());
        let iterations = iterations.ok_or("`iterations` must be set to a whole number")?;
        let mut arguments = vec!["--seed".to_owned(), seed.to_string()];
        if let Some(profile) = settings.remove("profile") {
            arguments.extend(["--profile".to_owned(), text(&profile)]);
        }
        if self.truth.contains(&Truth::Images) {
            let sharp = Value::String("truth/images_sharp".to_owned());
            settings.insert("images".to_owned(), sharp);
        }
        for (key, value) in &settings {
            arguments.extend(["--set".to_owned(), format!("{key}={}", text(value))]);
        }
        let replaced = self.truth.iter().filter(|t| **t != Truth::Images);
        let mut replaced: Vec<Truth> = replaced.copied().collect();
        replaced.sort_unstable();
        replaced.dedup();
        Ok(Run {
            id: id(program, scene, (&replaced, &self.perturb), &arguments),
            scene: scene.to_owned(),
            replaced,
            perturb: self.perturb,
            seed,
            iterations,
            arguments,
        })
    }
}

/// 16 hexadecimal digits that stand for all that a run's result depends on.
fn id(
    program: &str,
    scene: &str,
    (replaced, perturb): (&[Truth], &Perturb),
    arguments: &[String],
) -> String {
    let replaced = format!("{replaced:?}");
    let perturbed = perturb.names();
    let parts = ["limpid-lab 1", program, scene, &replaced].into_iter();
    let more = perturbed.iter().chain(arguments).map(String::as_str);
    hex(&hashed(parts.chain(more))[..8])
}

/// Adds a table's settings by their dotted names; those that are there already take the new value. What the new ones replace is
/// gone: `a.b.c` where `a.b` becomes a word, and that word where `a.b.c` is set.
fn flatten(prefix: &str, table: &Table, into: &mut Settings) {
    for (key, value) in table {
        insert(&format!("{prefix}{key}"), value, into);
    }
}

fn insert(key: &str, value: &Value, into: &mut Settings) {
    match value {
        Value::Table(inner) => flatten(&format!("{key}."), inner, into),
        value => {
            // Of both, the program would take the dotted one, which stands behind.
            into.retain(|other, _| !is_within(other, key) && !is_within(key, other));
            into.insert(key.to_owned(), value.clone());
        }
    }
}

/// Whether a setting is a part of another, by their dotted names.
fn is_within(key: &str, table: &str) -> bool {
    let rest = key.strip_prefix(table);
    rest.is_some_and(|rest| rest.starts_with('.'))
}

/// A value as `--set` takes it; names go without quotes.
fn text(value: &Value) -> String {
    match value {
        Value::String(name) if is_bare(name) => name.clone(),
        other => other.to_string(),
    }
}

/// Whether text without quotes is not taken for something else by TOML.
fn is_bare(name: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-/.".contains(c);
    name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.chars().all(plain)
        && !["true", "false", "inf", "nan"].contains(&name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn study(text: &str) -> Study {
        let head = "title = \"T\"\nabout = \"A.\"\nscore = [\"all\"]\n";
        Study::parse(&format!("{head}{text}"), Path::new("s.toml")).expect("a study")
    }

    fn all(study: &Study) -> Vec<Case> {
        cases(study, Path::new("s.toml"), "p").expect("cases")
    }

    fn arguments(cases: &[Case], arm: &str) -> String {
        let case = cases.iter().find(|case| case.arm == arm);
        case.expect("an arm of the study").run.arguments.join(" ")
    }

    const TWO: &str = r#"
scenes = ["a", "b"]
seeds = [1, 2]
baseline = "off"
[set]
iterations = 300
blur.model = "off"
[[variants]]
name = "off"
[[variants]]
name = "bound"
truth = ["images"]
except = ["b"]
[[variants]]
name = "kernels"
set = { profile = "paper", blur.model = "kernels", blur.gauge_cells = [2, 4], camera.transfer.power = 2.2 }
[[knobs]]
name = "K"
key = "blur.kernel_size"
values = [5, 7]
on = "kernels"
"#;

    #[test]
    fn a_study_expands_to_arguments_of_train() {
        let cases = all(&study(TWO));
        assert_eq!(cases.len(), 2 * (5 + 4), "bound is left out on b");
        assert_eq!(
            arguments(&cases, "off"),
            "--seed 1 --set blur.model=off --set iterations=300"
        );
        assert_eq!(
            arguments(&cases, "bound"),
            "--seed 1 --set blur.model=off --set images=truth/images_sharp --set iterations=300"
        );
        assert_eq!(
            arguments(&cases, "K = 7"),
            "--seed 1 --profile paper --set blur.gauge_cells=[2, 4] --set blur.kernel_size=7 --set blur.model=kernels \
             --set camera.transfer.power=2.2 --set iterations=300"
        );
        assert!(
            cases[..9].iter().all(|case| case.seed == 1),
            "seeds outermost"
        );
        assert!(cases.iter().all(|case| case.run.iterations == 300));

        let arms = arms(&study(TWO), Path::new("s.toml")).expect("arms");
        let against: Vec<_> = arms.iter().map(|arm| arm.against.as_deref()).collect();
        let kernels = Some("kernels");
        let off = Some("off");
        assert_eq!(against, [None, off, off, kernels, kernels]);
    }

    #[test]
    fn what_is_set_last_replaces_a_table_or_a_part_of_it() {
        let text = r#"
scenes = ["a"]
seeds = [1]
baseline = "power"
[set]
iterations = 300
camera.transfer.power = 2.2
camera.transfer_px = 1
[[variants]]
name = "power"
[[variants]]
name = "word"
set.camera.transfer = "linear"
[[knobs]]
name = "t"
key = "camera.transfer"
values = ["linear"]
[[knobs]]
name = "p"
key = "camera.transfer.power"
values = [2.0]
on = "word"
"#;
        let cases = all(&study(text));
        let others = "--set camera.transfer_px=1 --set iterations=300";
        for (arm, set) in [
            ("power", "camera.transfer.power=2.2"),
            ("word", "camera.transfer=linear"),
            ("t = linear", "camera.transfer=linear"),
            ("p = 2.0", "camera.transfer.power=2.0"),
        ] {
            assert_eq!(
                arguments(&cases, arm),
                format!("--seed 1 --set {set} {others}"),
                "{arm}"
            );
        }
    }

    #[test]
    fn knobs_are_turned_one_at_a_time_or_crossed() {
        let text = "scenes = [\"a\"]\nseeds = [1]\nset.iterations = 200\n\
                    knobs = [{ name = \"K\", key = \"x.k\", values = [1, 2] }, { name = \"m\", key = \"m\", values = [\"a\", \"b\", \"c\"] }]\n";
        let names = |text: &str| -> Vec<String> {
            all(&study(text)).into_iter().map(|case| case.arm).collect()
        };
        assert_eq!(
            names(text),
            ["baseline", "K = 1", "K = 2", "m = a", "m = b", "m = c"]
        );
        let crossed = format!("crossed = true\n{text}");
        assert_eq!(names(&crossed).len(), 1 + 2 * 3);
        assert_eq!(
            arguments(&all(&study(&crossed)), "K = 2, m = c"),
            "--seed 1 --set iterations=200 --set m=c --set x.k=2"
        );
    }

    #[test]
    fn a_name_stands_for_what_the_result_depends_on_and_for_nothing_else() {
        let ids = |text: &str, program: &str| -> Vec<String> {
            let cases = cases(&study(text), Path::new("s.toml"), program).expect("cases");
            cases.into_iter().map(|case| case.run.id).collect()
        };
        let here = ids(TWO, "p");
        assert_eq!(
            here.iter().collect::<std::collections::BTreeSet<_>>().len(),
            18
        );
        assert_eq!(
            here,
            ids(
                &TWO.replace("\"kernels\"\nset", "\"kerne1s\"\nset")
                    .replace("on = \"kernels\"", "on = \"kerne1s\""),
                "p"
            ),
            "not the variant's name"
        );
        assert_eq!(
            here,
            ids(&format!("bound = \"bound\"\n{TWO}"), "p"),
            "not the report"
        );
        for (from, to) in [("300", "301"), ("\"a\"", "\"c\""), ("[1, 2]", "[3, 4]")] {
            let there = ids(&TWO.replacen(from, to, 1), "p");
            assert!(
                here.iter().zip(there).any(|(a, b)| *a != b),
                "{from} is {to}"
            );
        }
        let there = ids(TWO, "q");
        assert!(here.iter().all(|id| !there.contains(id)), "another program");
    }

    #[test]
    fn two_arms_that_say_the_same_share_a_run() {
        let text = "scenes = [\"a\"]\nseeds = [1]\nset = { iterations = 200, k = 3 }\n\
                    knobs = [{ name = \"k\", key = \"k\", values = [3] }]\n";
        let cases = all(&study(text));
        assert_eq!(cases[0].run, cases[1].run);
        let depth = "scenes = [\"a\"]\nseeds = [1]\nset = { iterations = 200 }\n\
                     variants = [{ name = \"d\", truth = [\"depth\"] }]\n";
        let cases = all(&study(depth));
        assert_eq!(cases[0].run.arguments, cases[1].run.arguments);
        assert_ne!(cases[0].run.id, cases[1].run.id, "another scene");
    }

    #[test]
    fn what_is_perturbed_is_in_a_runs_name_and_in_no_argument() {
        let study = study(
            "scenes = [\"a\"]\nseeds = [1]\nset = { iterations = 200 }\n\
             variants = [{ name = \"v\", perturb = { depth = 0.1, poses_px = 2 } }]\n\
             knobs = [{ name = \"d\", key = \"perturb.depth\", values = [0, 0.1, 0.2], on = \"v\" },\
                      { name = \"m\", key = \"perturb.mask_squares\", values = [0, 2] }]\n",
        );
        let cases = all(&study);
        let ids: Vec<_> = cases.iter().map(|case| case.run.id.as_str()).collect();
        for (a, b) in [(1, 3), (0, 5)] {
            assert_eq!(ids[a], ids[b], "the same inputs");
        }
        let others = [0, 1, 2, 4, 6].map(|i| ids[i]);
        let others = std::collections::BTreeSet::from(others);
        assert_eq!(others.len(), 5, "{ids:?}");
        let same = |case: &Case| case.run.arguments == cases[0].run.arguments;
        assert!(cases.iter().all(same), "limpid is told nothing of it");
        let turned = cases[4].run.perturb;
        assert_eq!((turned.depth, turned.poses_px), (0.2, 2.0), "on `v`");
        let arms = arms(&study, Path::new("s.toml")).expect("arms");
        let perturbed: Vec<_> = arms.iter().map(Arm::is_perturbed).collect();
        assert_eq!(perturbed, [false, true, true, true, true, false, true]);
    }

    #[test]
    fn what_the_laboratory_says_itself_is_no_setting() {
        for (set, told) in [
            ("{}", "iterations"),
            ("{ iterations = 200, seed = 1 }", "`seeds`"),
        ] {
            let text = format!("scenes = [\"a\"]\nseeds = [1]\nset = {set}\n");
            let failed = cases(&study(&text), Path::new("s.toml"), "p");
            let said = failed.expect_err("a mistake").to_string();
            assert!(said.contains(told) && said.contains("s.toml"), "{said}");
        }
    }

    #[test]
    fn text_that_toml_would_take_for_something_else_keeps_its_quotes() {
        for (value, written) in [
            ("off", "off"),
            ("truth/images_sharp", "truth/images_sharp"),
            ("true", "\"true\""),
            ("12", "\"12\""),
            ("two words", "\"two words\""),
            ("", "\"\""),
        ] {
            assert_eq!(text(&Value::String(value.to_owned())), written);
        }
    }
}
