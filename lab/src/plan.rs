//! `runs.json`: all runs of a study, for any scheduler: one command a run, in any order.

use crate::error::LabError;
use crate::expand::{Case, Run, cases};
use crate::files::{json, write_json, write_whole};
use crate::hash::{hex, name_of};
use crate::scenes::Scenes;
use crate::study::Study;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How names of earlier plans of a study begin.
const EARLIER: &str = "runs-";

/// All runs of a study and what runs them.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Plan {
    /// The study's name.
    pub study: String,
    /// What trains.
    pub program: Program,
    /// The runs, in the order in which they are best begun.
    pub runs: Vec<PlannedRun>,
}

/// The program that trains, a copy of its own, so that a build in the middle of a study does not change it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Program {
    /// Where the copy is.
    pub path: PathBuf,
    /// Hash of its bytes. The commit would not do: what changes nothing in the program costs no new runs, and what is not
    /// committed does.
    pub fingerprint: String,
    /// What it calls itself.
    pub version: String,
    /// The commit it was built from, where git knows.
    pub commit: Option<String>,
    /// Whether files of the checkout differed from that commit.
    pub changed: bool,
}

/// A run and its command.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PlannedRun {
    /// Name of its folder, a hash of all that its result depends on.
    pub id: String,
    /// The scene's name.
    pub scene: String,
    /// The study's names for what is run.
    pub arms: Vec<String>,
    /// Seed.
    pub seed: u64,
    /// Length.
    pub iterations: usize,
    /// The results' folder.
    pub folder: PathBuf,
    /// Arguments of the program.
    pub arguments: Vec<String>,
    /// What a scheduler starts: trains, goes on from a checkpoint where there is one, measures, and does nothing where all is
    /// there.
    pub command: Vec<String>,
}

/// Where the laboratory keeps what it makes.
#[derive(Clone, Debug)]
pub struct Places {
    /// The folder of everything.
    pub out: PathBuf,
}

impl Places {
    /// Names that no study can have.
    pub const OURS: [&str; 3] = ["runs", "programs", "scenes"];

    /// All runs, of all studies: what two of them ask for is run once.
    #[must_use]
    pub fn runs(&self) -> PathBuf {
        self.out.join("runs")
    }

    /// Copies of programs.
    fn programs(&self) -> PathBuf {
        self.out.join("programs")
    }

    /// Scenes in which something is as in truth, or perturbed.
    #[must_use]
    pub fn links(&self) -> PathBuf {
        self.out.join("scenes")
    }

    /// What belongs to a study alone.
    #[must_use]
    pub fn study(&self, name: &str) -> PathBuf {
        self.out.join(name)
    }

    /// `runs.json` of a study.
    #[must_use]
    pub fn plan(&self, name: &str) -> PathBuf {
        self.study(name).join("runs.json")
    }
}

impl Program {
    /// Keeps a copy of the program that is to train, and finds out what it is. `checkout` is where it was built; without it, its
    /// commit is what was known when it was kept before.
    ///
    /// # Errors
    /// It cannot be read, copied or started.
    pub fn keep(
        program: &Path,
        places: &Places,
        checkout: Option<&Path>,
    ) -> Result<Self, LabError> {
        let bytes = fs::read(program).map_err(LabError::file(program))?;
        let fingerprint = hex(&Sha256::digest(&bytes)[..8]);
        let folder = places.programs();
        fs::create_dir_all(&folder).map_err(LabError::file(&folder))?;
        let folder = fs::canonicalize(&folder).map_err(LabError::file(&folder))?;
        let suffix = std::env::consts::EXE_SUFFIX;
        let copy = folder.join(format!("limpid-{fingerprint}{suffix}"));
        if !copy.exists() {
            let half = folder.join(format!(".{}{suffix}", std::process::id()));
            // What was hashed: a build may have put another one there since.
            fs::write(&half, &bytes).map_err(LabError::file(&half))?;
            let metadata = fs::metadata(program).map_err(LabError::file(program))?;
            let set = fs::set_permissions(&half, metadata.permissions());
            set.map_err(LabError::file(&half))?;
            fs::rename(&half, &copy).map_err(LabError::file(&copy))?;
        }
        let asked = Command::new(&copy).arg("--version").output();
        let answer = asked.map_err(LabError::file(&copy))?;
        if !answer.status.success() {
            return Err(LabError::content(program, "it does not say its version"));
        }
        let known = folder.join(format!("limpid-{fingerprint}.json"));
        let before = || -> Option<Self> { serde_json::from_slice(&fs::read(&known).ok()?).ok() };
        let source = match checkout.and_then(source) {
            // Without changes, this commit makes this program, whichever commits made it before.
            Some((commit, false)) => Some((commit, false)),
            now => before()
                .and_then(|before| Some((before.commit?, before.changed)))
                .or(now),
        };
        let (commit, changed) = source.unzip();
        let kept = Self {
            path: copy,
            fingerprint,
            version: String::from_utf8_lossy(&answer.stdout).trim().to_owned(),
            commit,
            changed: changed.unwrap_or(false),
        };
        write_json(&known, &kept)?;
        Ok(kept)
    }

    /// What it has against these arguments, before anything is trained.
    fn objection(&self, arguments: &[String]) -> Result<Option<String>, LabError> {
        let asked = Command::new(&self.path)
            .args(arguments)
            .arg("--dry-run")
            .output();
        let answer = asked.map_err(LabError::file(&self.path))?;
        let said = String::from_utf8_lossy(&answer.stderr).trim().to_owned();
        // An earlier program does not know the flag.
        let refused = match answer.status.code() {
            Some(1) => true,
            Some(2) => !said.contains("'--dry-run'"),
            _ => false,
        };
        Ok(refused.then_some(said))
    }
}

/// The commit of a checkout, where git knows, and whether what the program is built from differs from it.
fn source(checkout: &Path) -> Option<(String, bool)> {
    let git = |args: &[&str]| {
        let output = Command::new("git")
            .args(args)
            .current_dir(checkout)
            .output();
        let output = output.ok().filter(|output| output.status.success())?;
        Some(String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["rev-parse", "--short=7", "HEAD"])?;
    let built_from = ["crates", "Cargo.toml", "Cargo.lock"];
    let changes = git(&[&["status", "--porcelain", "--"], &built_from[..]].concat())?;
    Some((commit, !changes.is_empty()))
}

impl Plan {
    /// The runs of a study but for those that are kept elsewhere; `lab` is this program, which schedulers start.
    ///
    /// # Errors
    /// The study cannot be expanded, a scene lacks what it asks for, or the program does not know a setting.
    pub fn new(
        study: (&str, &Study, &Path),
        program: Program,
        scenes: &Scenes,
        places: &Places,
        is_kept: impl Fn(&Case) -> bool,
        lab: &Path,
    ) -> Result<Self, LabError> {
        let (name, study, path) = study;
        let absolute = |path: PathBuf| std::path::absolute(&path).map_err(LabError::file(&path));
        let plan = absolute(places.plan(name))?;
        let runs = absolute(places.runs())?;
        let mut planned: Vec<PlannedRun> = Vec::new();
        let mut asked = BTreeSet::new();
        for case in cases(study, path, &program.fingerprint)? {
            if is_kept(&case) {
                continue;
            }
            if let Some(there) = planned.iter_mut().find(|run| run.id == case.run.id) {
                there.arms.push(case.arm);
                continue;
            }
            let Run {
                id,
                scene,
                replaced,
                perturb,
                seed,
                iterations,
                arguments,
            } = case.run;
            let folder = scenes.find(&scene, seed, &replaced, &perturb)?;
            scenes.check_truth(&folder, &arguments)?;
            let out = runs.join(&id);
            let words = |path: &Path| path.to_string_lossy().into_owned();
            let mut all = vec!["train".to_owned()];
            all.extend(["--scene".to_owned(), words(&folder)]);
            all.extend(["--out".to_owned(), words(&out)]);
            all.extend(arguments);
            if asked.insert(case.asks)
                && let Some(problem) = program.objection(&all)?
            {
                let (path, key) = (path.to_owned(), case.arm);
                return Err(LabError::Study { path, key, problem });
            }
            planned.push(PlannedRun {
                command: vec![words(lab), "one".to_owned(), words(&plan), id.clone()],
                id,
                scene,
                arms: vec![case.arm],
                seed,
                iterations,
                folder: out,
                arguments: all,
            });
        }
        Ok(Self {
            study: name.to_owned(),
            program,
            runs: planned,
        })
    }

    /// Writes `runs.json`. Another one that was there stays beside it under a name of its own, for tasks of it that a scheduler
    /// still holds.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), LabError> {
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(LabError::file(folder))?;
        }
        let text = json(path, self)?;
        if let Ok(earlier) = fs::read_to_string(path)
            && earlier != text
        {
            let name = name_of(&earlier);
            write_whole(
                &path.with_file_name(format!("{EARLIER}{name}.json")),
                &earlier,
            )?;
        }
        write_whole(path, &text)
    }

    /// The plan that has a run: the one at `path`, or an earlier one beside it.
    ///
    /// # Errors
    /// None has it, or the one at `path` cannot be read.
    pub fn with_run(path: &Path, id: &str) -> Result<(Self, PlannedRun), LabError> {
        let run_of = |plan: Self| {
            let run = plan.runs.iter().find(|run| run.id == id).cloned();
            run.map(|run| (plan, run))
        };
        if let Some(found) = run_of(Self::read(path)?) {
            return Ok(found);
        }
        let is_earlier = |path: &PathBuf| {
            let name = path.file_name().and_then(|name| name.to_str());
            name.is_some_and(|name| name.starts_with(EARLIER) && name.ends_with(".json"))
        };
        let beside = path.parent().and_then(|folder| fs::read_dir(folder).ok());
        let entries = beside.into_iter().flatten().flatten();
        let mut earlier = entries.map(|entry| entry.path()).filter(is_earlier);
        earlier
            .find_map(|path| run_of(Self::read(&path).ok()?))
            .ok_or_else(|| LabError::Asked(format!("{} has no run {id}", path.display())))
    }

    /// Reads `runs.json`.
    ///
    /// # Errors
    /// It cannot be read, or is no plan.
    pub fn read(path: &Path) -> Result<Self, LabError> {
        let text = fs::read(path).map_err(LabError::file(path))?;
        serde_json::from_slice(&text).map_err(|e| LabError::content(path, e))
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::io::ErrorKind;
    use std::os::unix::fs::PermissionsExt;

    fn git(folder: &Path, args: &[&str]) {
        let identity = ["-c", "user.name=n", "-c", "user.email=e@x"];
        let status = Command::new("git")
            .args(identity)
            .args(args)
            .current_dir(folder)
            .output();
        assert!(status.expect("git").status.success(), "git {args:?}");
    }

    #[test]
    fn a_program_is_its_bytes_and_keeps_the_commit_that_made_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let checkout = folder.path().join("checkout");
        let file = checkout.join("crates/a.rs");
        fs::create_dir_all(checkout.join("crates")).expect("a folder");
        fs::write(&file, "1").expect("a file");
        fs::write(checkout.join("README"), "1").expect("a file");
        git(&checkout, &["init", "--quiet"]);
        git(&checkout, &["add", "."]);
        git(&checkout, &["commit", "--quiet", "--message", "first"]);

        let program = folder.path().join("program");
        let write = |text: &str| {
            fs::write(&program, format!("#!/bin/sh\necho {text}\n")).expect("a script");
            fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).expect("executable");
        };
        let places = Places {
            out: folder.path().join("out"),
        };
        let keep = |checkout: Option<&Path>| {
            loop {
                match Program::keep(&program, &places, checkout) {
                    // A process that another test is just starting holds the copy open for a moment more.
                    Err(LabError::File { source, .. })
                        if source.kind() == ErrorKind::ExecutableFileBusy =>
                    {
                        std::thread::yield_now();
                    }
                    kept => return kept.expect("a program"),
                }
            }
        };
        write("limpid 1");
        assert_eq!(keep(None).commit, None, "from anywhere");
        let first = keep(Some(&checkout));
        assert_eq!(first.version, "limpid 1");
        assert!(first.commit.is_some() && !first.changed, "{first:?}");
        assert_eq!(keep(None), first, "known by its bytes");
        fs::write(checkout.join("README"), "2").expect("a file");
        assert!(!keep(Some(&checkout)).changed, "no source of the program");
        fs::write(&file, "2").expect("a file");
        assert_eq!(keep(Some(&checkout)), first, "the same bytes all the same");

        write("limpid 2");
        let second = keep(Some(&checkout));
        assert_ne!(second.fingerprint, first.fingerprint, "other bytes");
        assert!(second.changed, "{second:?}");
        assert_ne!(second.path, first.path, "both are kept");
        assert!(first.path.exists(), "both are kept");
    }

    #[test]
    fn tasks_that_wait_find_their_run_in_the_plan_that_they_were_made_of() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("study/runs.json");
        let write = |id: &str| {
            let plan = Plan {
                study: "study".to_owned(),
                program: Program {
                    path: format!("program of {id}").into(),
                    fingerprint: String::new(),
                    version: String::new(),
                    commit: None,
                    changed: false,
                },
                runs: vec![PlannedRun {
                    id: id.to_owned(),
                    scene: String::new(),
                    arms: Vec::new(),
                    seed: 1,
                    iterations: 200,
                    folder: PathBuf::new(),
                    arguments: Vec::new(),
                    command: Vec::new(),
                }],
            };
            plan.write(&path).expect("a plan");
        };
        for id in ["a", "b", "c", "c"] {
            write(id);
        }
        for id in ["a", "b", "c"] {
            let (plan, run) = Plan::with_run(&path, id).expect("found");
            assert_eq!(run.id, id);
            assert_eq!(plan.program.path, Path::new(&format!("program of {id}")));
        }
        let plans = fs::read_dir(folder.path().join("study")).expect("a folder");
        assert_eq!(plans.count(), 3, "the same plan twice is one");
        let unknown = Plan::with_run(&path, "d").expect_err("no such run");
        assert!(unknown.to_string().contains("no run d"), "{unknown}");
    }
}
