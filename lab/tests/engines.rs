//! A study from its file to its table, by every engine that is installed, with a run that is killed on the way.
//!
//! The program that trains lies beside this package's own: `cargo test --workspace` builds both.

#![cfg(unix)]

use std::collections::BTreeSet;
use std::error::Error;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

type Outcome = Result<(), Box<dyn Error>>;

const LAB: &str = env!("CARGO_BIN_EXE_limpid-lab");

/// Two arms with two seeds, without movers and at 20x11: a second each.
const STUDY: &str = r#"
title = "Small"
about = "Four runs."
scenes = ["demo"]
seeds = [1, 2]
baseline = "off"
score = ["psnr", "cpu", "memory", "iterations"]
plot = { x = "cpu", y = "psnr", front = true }
[set]
iterations = 200
downscale = 8
static = true
checkpoint_every = 50
[[variants]]
name = "off"
set.blur.model = "off"
[[variants]]
name = "camera"
set.blur.model = "camera"
"#;

/// Says that a test could not run, past the harness, so that `cargo xtask ci` counts it.
fn skipped(test: &str, why: &str) {
    let line = format!("skipped: {test}: {why}\n");
    std::io::stderr().write_all(line.as_bytes()).ok();
}

/// The program that trains, where the workspace was built.
fn limpid(test: &str) -> Option<PathBuf> {
    let name = format!("limpid{}", std::env::consts::EXE_SUFFIX);
    let program = Path::new(LAB).with_file_name(name);
    if !program.exists() {
        skipped(
            test,
            "the program limpid is not built; `cargo test --workspace` builds it",
        );
        return None;
    }
    Some(program)
}

/// A study in a folder of its own.
struct Bench {
    folder: tempfile::TempDir,
    program: PathBuf,
}

impl Bench {
    fn new(program: &Path, study: &str) -> Result<Self, Box<dyn Error>> {
        let folder = tempfile::tempdir()?;
        fs::write(folder.path().join("small.toml"), study)?;
        Ok(Self {
            folder,
            program: program.to_owned(),
        })
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// `lab WHAT small.toml`, with two jobs.
    fn lab(&self, what: &str, more: &[&str]) -> Command {
        let mut command = Command::new(LAB);
        command.arg(what).arg(self.folder.path().join("small.toml"));
        command.arg("--out").arg(self.out()).args(more);
        if what != "gather" {
            command.arg("--program").arg(&self.program);
            command.args(["--jobs", "2"]);
        }
        command.stderr(Stdio::piped()).stdout(Stdio::piped());
        command
    }

    fn plan(&self, more: &[&str]) -> Result<serde_json::Value, Box<dyn Error>> {
        let output = self.lab("plan", more).output()?;
        assert!(output.status.success(), "{}", said(&output));
        let text = fs::read(self.out().join("small/runs.json"))?;
        Ok(serde_json::from_slice(&text)?)
    }

    fn script(&self, name: &str) -> PathBuf {
        self.out().join("small").join(name)
    }

    fn report(&self) -> Result<(serde_json::Value, String), Box<dyn Error>> {
        let output = self.lab("gather", &[]).output()?;
        assert!(output.status.success(), "{}", said(&output));
        let json = fs::read(self.out().join("small/small.json"))?;
        let table = fs::read_to_string(self.out().join("small/small.md"))?;
        Ok((serde_json::from_slice(&json)?, table))
    }

    /// The folder of the run of an arm and a seed.
    fn run(&self, plan: &serde_json::Value, arm: &str, seed: u64) -> PathBuf {
        let runs = plan["runs"].as_array().expect("a list of runs");
        let run = runs
            .iter()
            .find(|r| r["arms"][0] == arm && r["seed"] == seed);
        PathBuf::from(run.expect("a run")["folder"].as_str().expect("a path"))
    }
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Waits for a file, up to five minutes, so that a test whose file never comes ends; the longest run that is waited for takes
/// seconds on a machine that does nothing else.
fn wait_for(file: &Path) -> Outcome {
    let began = Instant::now();
    while !file.exists() {
        if began.elapsed() > Duration::from_secs(300) {
            return Err(format!("{} did not come", file.display()).into());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

fn signal(name: &str, process: &str) -> Outcome {
    let status = Command::new("kill").args([name, process]).status()?;
    assert!(status.success(), "kill {name} {process}");
    Ok(())
}

/// Starts an engine, kills the run in `victim` once it trains, and waits for the engine's end.
fn with_a_kill(mut engine: Command, victim: &Path) -> Result<Output, Box<dyn Error>> {
    let engine: Child = engine
        .stderr(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    wait_for(&victim.join("config.json"))?;
    let process = fs::read_to_string(victim.with_extension("lock"))?;
    signal("-KILL", process.trim())?;
    Ok(engine.wait_with_output()?)
}

/// An engine ends with the number of runs that failed.
fn assert_one_failed(output: &Output) {
    let code = output.status.code();
    assert_eq!(code, Some(1), "one failed: {}", said(output));
}

/// What stands after a study of which a run was killed: the others are finished, and it is named.
fn check_report(bench: &Bench, engine: &str) -> Outcome {
    let (report, table) = bench.report()?;
    assert_eq!(report["finished"], 3, "{engine}: {table}");
    assert_eq!(report["failed"][0]["arm"], "camera", "{engine}");
    assert_eq!(report["failed"][0]["how"], "killed by signal 9", "{engine}");
    assert!(
        table.contains("3 of 4 runs are finished, and 1 died"),
        "{table}"
    );
    assert!(table.contains("## Runs that died"), "{table}");
    let rows = report["scenes"][0]["rows"].as_array().ok_or("rows")?;
    let camera = &rows[1];
    assert_eq!(camera["arm"], "camera", "{engine}");
    assert_eq!(camera["runs"], 1, "{engine}");
    // Iterations are those that were asked for; a quarter of a second and ten megabytes are less than any run takes.
    assert_eq!(camera["cells"][3]["mean"]["mean"], 200.0, "{engine}");
    assert!(
        rows[0]["cells"][1]["mean"]["mean"].as_f64() > Some(0.02),
        "{engine}: s"
    );
    assert!(
        rows[0]["cells"][2]["mean"]["mean"].as_f64() > Some(5.0),
        "{engine}: MiB"
    );
    let (off, gained) = (&rows[0]["cells"][0]["values"], &camera["cells"][0]);
    let seed = gained["values"].as_object().ok_or("values")?.keys().next();
    let seed = seed.ok_or("a seed")?;
    let (here, there) = (gained["values"][seed].as_f64(), off[seed].as_f64());
    let gain = here.ok_or("a value")? - there.ok_or("a value")?;
    let told = gained["gain"]["mean"].as_f64().ok_or("a gain")?;
    assert!(
        (gain - told).abs() < 1e-9,
        "{engine}: the same seed's {gain}, {told}"
    );
    assert!(bench.out().join("small/small.svg").exists(), "{engine}");
    Ok(())
}

#[test]
fn this_machine_goes_on_when_a_run_dies_and_ends_what_is_missing_later() -> Outcome {
    let Some(program) = limpid("this machine") else {
        return Ok(());
    };
    let bench = Bench::new(&program, STUDY)?;
    let plan = bench.plan(&[])?;
    let victim = bench.run(&plan, "camera", 1);
    let output = with_a_kill(bench.lab("run", &[]), &victim)?;
    let text = said(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for part in [
        "failed: demo, camera, seed 1",
        "killed by signal 9",
        "runs: 3 finished, 1 failed",
        "tries them again",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    check_report(&bench, "this machine")?;

    // Once more: nothing but the one that died is run.
    let before = fs::metadata(bench.run(&plan, "off", 1).join("metrics.json"))?.modified()?;
    let output = bench.lab("run", &[]).output()?;
    let text = said(&output);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("runs: 1 finished, 3 there already"), "{text}");
    let after = fs::metadata(bench.run(&plan, "off", 1).join("metrics.json"))?.modified()?;
    assert_eq!(before, after, "not run again");
    let (report, table) = bench.report()?;
    assert_eq!(
        (&report["finished"], &report["failed"]),
        (&4.into(), &serde_json::json!([]))
    );
    assert!(table.contains("All 4 runs are finished."), "{table}");
    assert!(table.contains(" ± "), "{table}");
    let out = bench.out();
    let path = out.to_str().ok_or("a path in UTF-8")?;
    assert!(
        !table.contains(path) && !report.to_string().contains(path),
        "no path of this machine"
    );
    Ok(())
}

/// One arm, with 2,000 iterations: seconds, in which there is time to end it, or to ask for it again in a tenth of one, and which
/// are soon over where it is left alone.
fn long_study() -> String {
    let (one_arm, _) = STUDY.rsplit_once("[[variants]]").expect("two variants");
    let long = one_arm.replace("iterations = 200", "iterations = 2000");
    long.replace("seeds = [1, 2]", "seeds = [1]")
}

#[test]
fn ctrl_c_ends_a_study_that_goes_on_from_its_checkpoints() -> Outcome {
    let Some(program) = limpid("Ctrl-C") else {
        return Ok(());
    };
    let bench = Bench::new(&program, &long_study())?;
    let plan = bench.plan(&[])?;
    let run = bench.run(&plan, "off", 1);
    let lab = bench.lab("run", &[]).spawn()?;
    wait_for(&run.join("checkpoint/state.safetensors"))?;
    signal("-INT", &lab.id().to_string())?;
    let output = lab.wait_with_output()?;
    let text = said(&output);
    assert_eq!(output.status.code(), Some(130), "{text}");
    assert!(
        text.contains("the same command goes on from there"),
        "{text}"
    );
    assert!(text.contains("runs: 0 finished, 1 left"), "{text}");

    let output = bench.lab("run", &[]).output()?;
    assert!(output.status.success(), "{}", said(&output));
    let log = fs::read_to_string(run.with_extension("log"))?;
    assert!(log.contains("going on after iteration"), "{log}");
    let record: serde_json::Value = serde_json::from_slice(&fs::read(run.with_extension("json"))?)?;
    let attempts = record["attempts"].as_array().ok_or("attempts")?;
    assert_eq!(attempts.len(), 2, "both are measured: {record}");
    assert!(attempts.iter().all(|a| a["failed"].is_null()), "{record}");
    Ok(())
}

#[test]
fn a_run_whose_laboratory_was_killed_is_left_alone_until_it_ends() -> Outcome {
    let Some(program) = limpid("a killed laboratory") else {
        return Ok(());
    };
    let bench = Bench::new(&program, &long_study())?;
    let plan = bench.plan(&[])?;
    let run = bench.run(&plan, "off", 1);
    let one = || {
        let mut command = Command::new(LAB);
        let id = run.file_name().unwrap_or_default();
        command.arg("one").arg(bench.script("runs.json")).arg(id);
        command.stderr(Stdio::piped());
        command
    };
    let mut lab = one().spawn()?;
    wait_for(&run.join("config.json"))?;
    lab.kill()?;
    lab.wait()?;
    let again = one().output()?;
    assert!(!again.status.success(), "{}", said(&again));
    assert!(
        said(&again).contains("another process is at run"),
        "{}",
        said(&again)
    );
    wait_for(&run.join("metrics.json"))?;
    Ok(())
}

#[test]
fn gnu_parallel_works_through_a_study() -> Outcome {
    let Some(program) = limpid("GNU parallel") else {
        return Ok(());
    };
    let version = Command::new("parallel").arg("--version").output();
    let is_gnu = version.is_ok_and(|v| String::from_utf8_lossy(&v.stdout).contains("GNU parallel"));
    if !is_gnu {
        skipped("GNU parallel", "it is not installed");
        return Ok(());
    }
    let bench = Bench::new(&program, STUDY)?;
    let plan = bench.plan(&["--engine", "parallel"])?;
    let mut engine = Command::new("sh");
    engine.arg(bench.script("parallel.sh"));
    let output = with_a_kill(engine, &bench.run(&plan, "camera", 1))?;
    assert_one_failed(&output);
    check_report(&bench, "parallel")
}

/// What Slurm would do, task by task.
#[test]
fn the_tasks_of_slurms_array_are_the_runs() -> Outcome {
    let Some(program) = limpid("Slurm's script") else {
        return Ok(());
    };
    let bench = Bench::new(&program, STUDY)?;
    let plan = bench.plan(&["--engine", "slurm"])?;
    let task = |n: usize| {
        let mut command = Command::new("sh");
        command.arg(bench.script("slurm.sh"));
        command.env("SLURM_ARRAY_TASK_ID", n.to_string());
        command
    };
    let runs = plan["runs"].as_array().ok_or("runs")?;
    for (i, run) in runs.iter().enumerate() {
        let is_victim = run["arms"][0] == "camera" && run["seed"] == 1;
        let output = if is_victim {
            with_a_kill(task(i + 1), &bench.run(&plan, "camera", 1))?
        } else {
            task(i + 1).output()?
        };
        assert_eq!(output.status.success(), !is_victim, "{}", said(&output));
    }
    check_report(&bench, "slurm")
}

/// The commands of runs.json on a worker of HyperQueue in this process.
const LOCAL_CLUSTER: &str = r#"
import json, sys
from hyperqueue import Job, LocalCluster
from hyperqueue.cluster import WorkerConfig
with LocalCluster() as cluster:
    cluster.start_worker(WorkerConfig(cores=2))
    client = cluster.client()
    job = Job(max_fails=None)
    for run in json.load(open(sys.argv[1]))["runs"]:
        job.program(run["command"], stdout=None, stderr=None, name=run["id"])
    submitted = client.submit(job)
    sys.exit(0 if client.wait_for_jobs([submitted], raise_on_error=False) else 1)
"#;

#[test]
fn hyperqueue_works_through_a_study() -> Outcome {
    let Some(program) = limpid("HyperQueue") else {
        return Ok(());
    };
    let python = std::env::var_os("PYTHON").unwrap_or_else(|| "python3".into());
    let has_it = Command::new(&python)
        .args(["-c", "import hyperqueue"])
        .output();
    if !has_it.is_ok_and(|output| output.status.success()) {
        skipped(
            "HyperQueue",
            "python3 has no package hyperqueue (PyPI has it; PYTHON names another python)",
        );
        return Ok(());
    }
    let bench = Bench::new(&program, STUDY)?;
    let plan = bench.plan(&["--engine", "hq"])?;
    let lines = fs::read_to_string(bench.script("hq.sh"))?;
    assert_eq!(lines.matches("\nhq submit ").count(), 4, "{lines}");
    let mut engine = Command::new(&python);
    engine
        .args(["-c", LOCAL_CLUSTER])
        .arg(bench.script("runs.json"));
    let output = with_a_kill(engine, &bench.run(&plan, "camera", 1))?;
    assert_one_failed(&output);
    check_report(&bench, "HyperQueue")
}

#[test]
fn a_setting_that_there_is_not_is_named_before_anything_runs() -> Outcome {
    let Some(program) = limpid("a misspelt setting") else {
        return Ok(());
    };
    let misspelt = STUDY.replace("blur.model = \"camera\"", "blur.modle = \"camera\"");
    let bench = Bench::new(&program, &misspelt)?;
    let output = bench.lab("run", &[]).output()?;
    let text = said(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for part in ["small.toml", "`camera`", "did you mean `blur.model`"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert!(!bench.out().join("runs").exists(), "nothing was run");
    Ok(())
}

#[test]
fn the_repositorys_studies_have_settings_that_there_are() -> Outcome {
    let Some(program) = limpid("settings of studies") else {
        return Ok(());
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("studies");
    let mut tried = BTreeSet::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let study = limpid_lab::Study::read(&path)?;
        for case in limpid_lab::cases(&study, &path, "")? {
            let arguments = case.run.arguments;
            // The seed is no setting that a study could have wrong.
            if !tried.insert(arguments[2..].to_vec()) {
                continue;
            }
            let mut command = Command::new(&program);
            let output = command
                .args(["train", "--dry-run"])
                .args(&arguments)
                .output()?;
            let (study, arm, text) = (path.display(), case.arm, said(&output));
            assert!(output.status.success(), "{study}: {arm}: {text}");
        }
    }
    assert!(tried.len() > 50, "only {} were found", tried.len());
    Ok(())
}
