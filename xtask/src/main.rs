//! `cargo xtask …`: development commands.
//!
//! A thin launcher over cargo. It compiles in a second, depends on nothing, and never on Burn: what
//! it starts shares the profile and the features of a plain `cargo test --workspace`, so that nothing
//! is compiled twice.

use std::env;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::Instant;

const HELP: &str = "\
cargo xtask COMMAND

  train [ARGS]   train a scene; without --scene and --config, the demo
                 (cargo xtask train --help lists the arguments)
  bench [ARGS]   time the kernels and whole iterations, stage by stage, and how they
                 grow; writes tables, JSON and plots to out/bench/; with --backend wgpu
                 or cuda, times a GPU and writes gpu.json
                 (cargo xtask bench --help lists the arguments)
  lab STUDY      run a study of lab/studies/ (many trainings, each once) and make its
                 tables and plot; plan, run and gather do that one at a time
                 (cargo xtask lab --help lists the arguments)
  numerics       measure f32 against f64 and write docs/NUMERICS.md
  bless          train the golden picture of the tests again, and keep it
  fmt            check the formatting
  clippy         lint; a warning is an error
  doc            build the documentation; a warning is an error
  bare           test splat-core without Burn
  test           all tests: cargo test --workspace
  ndarray        the tests of tensor code on the second CPU backend
  clippy-gpu     lint what is compiled for a GPU
  test-gpu       the tests of tensor code on wgpu: on a GPU, or on one that a CPU plays
  ci             all steps from fmt on, one after the other
";

/// What `numerics` starts.
const NUMERICS: [&str; 5] = ["run", "--package", "limpid-tests", "--bin", "numerics"];

/// What `bench` starts: the kernels by themselves, then the program that times iterations. In the profile of all else, so that
/// Burn is not compiled a second time.
const BENCH: [&[&str]; 2] = [
    &[
        "bench",
        "--profile",
        "dev",
        "--package",
        "limpid-bench",
        "--bench",
        "kernels",
    ],
    &["run", "--package", "limpid-bench"],
];

/// What `bless` starts.
const BLESS: [&str; 4] = ["test", "--workspace", "--test", "golden"];

/// A step of `ci`: its name, cargo's arguments, and a variable of the environment.
type Step = (
    &'static str,
    &'static [&'static str],
    (&'static str, &'static str),
);

/// The variable that names the backends whose tests run. A step that sets it runs [`backend_tests`] alone: all others are the
/// same on every backend, and the step `test` has run them.
const BACKENDS: &str = "LIMPID_BACKENDS";

/// What compiles all backends that tests know: one build for every step that needs another one than the default.
const ALL_BACKENDS: &str = "limpid-tests/ndarray,limpid-tests/wgpu,limpid/wgpu,limpid-bench/wgpu";

/// The steps of `ci`, in their order. Where Burn is compiled, always the whole workspace: with `--package`, cargo would give
/// the crates below it other features, and compile it again.
const STEPS: [Step; 8] = [
    ("fmt", &["fmt", "--all", "--check"], NOTHING),
    (
        "clippy",
        &[
            "clippy",
            "--workspace",
            "--all-targets",
            "--",
            "-D",
            "warnings",
        ],
        NOTHING,
    ),
    (
        "doc",
        &["doc", "--workspace", "--no-deps"],
        ("RUSTDOCFLAGS", "-D warnings"),
    ),
    (
        "bare",
        &["test", "--package", "splat-core", "--no-default-features"],
        NOTHING,
    ),
    ("test", &["test", "--workspace"], NOTHING),
    (
        "ndarray",
        &["test", "--workspace", "--features", ALL_BACKENDS],
        (BACKENDS, "ndarray"),
    ),
    (
        "clippy-gpu",
        &[
            "clippy",
            "--workspace",
            "--all-targets",
            "--features",
            ALL_BACKENDS,
            "--",
            "-D",
            "warnings",
        ],
        NOTHING,
    ),
    (
        "test-gpu",
        &["test", "--workspace", "--features", ALL_BACKENDS],
        (BACKENDS, "wgpu"),
    ),
];

/// No variable of the environment.
const NOTHING: (&str, &str) = ("", "");

/// What a test prints, alone on a line, where it cannot run.
const SKIPPED: &str = "skipped: ";

fn main() -> ExitCode {
    let mut args = env::args_os().skip(1);
    let command = args.next();
    let rest: Vec<OsString> = args.collect();
    let step = |name: &str| STEPS.iter().find(|(step, ..)| *step == name);
    match command.as_deref().and_then(OsStr::to_str) {
        Some("train") => become_command(train(&rest)),
        Some("bench") => bench(&rest),
        Some("lab") => lab(&rest),
        Some("numerics") => become_command(cargo_in_root(&NUMERICS)),
        Some("bless") => {
            let mut golden = cargo_in_root(&BLESS);
            golden.env("LIMPID_BLESS", "1");
            become_command(golden)
        }
        Some("ci") => ci(&STEPS),
        Some("help" | "--help" | "-h") => {
            eprint!("{HELP}");
            ExitCode::SUCCESS
        }
        Some(name) if let Some(step) = step(name) => ci(std::slice::from_ref(step)),
        _ => {
            eprint!("{HELP}");
            ExitCode::from(2)
        }
    }
}

/// The command that trains with `args`. Without a scene of their own, arguments are about the demo, or go on with what it came to.
fn train(args: &[OsString]) -> Command {
    let mut command = in_folder("run", "limpid");
    if let Some(backend) = backend_feature(args) {
        command.args(["--features", backend]);
    }
    command.args(["--", "train"]);
    let has = |flags: &[&str]| {
        let mut names = args
            .iter()
            .filter_map(|arg| arg.to_str()?.split('=').next());
        names.any(|name| flags.contains(&name))
    };
    if !has(&["--scene", "--config", "--help", "-h"]) {
        if !has(&["--resume"]) {
            command.arg("--config").arg(root().join("demo/limpid.toml"));
        } else if !has(&["--out"]) {
            // A run goes on with settings of its own, which need not be the demo's.
            command.args(["--out", "out/demo"]);
        }
    }
    command.args(args);
    command
}

/// Builds the program that trains, as `train` does, and starts the laboratory, which finds it beside itself.
fn lab(args: &[OsString]) -> ExitCode {
    if lab_trains(args)
        && let Err(code) = wait(in_folder("build", "limpid"))
    {
        return code;
    }
    let mut command = in_folder("run", "limpid-lab");
    command.arg("--").args(args);
    become_command(command)
}

/// Whether the laboratory is asked for something that needs a program, and is not told which one.
fn lab_trains(args: &[OsString]) -> bool {
    let reads = ["gather", "one", "help", "--help", "-h"];
    let first = args.first().and_then(|arg| arg.to_str());
    let is_told = |arg: &OsString| {
        arg.to_str()
            .is_some_and(|arg| arg.split('=').next() == Some("--program"))
    };
    first.is_some_and(|first| !reads.contains(&first)) && !args.iter().any(is_told)
}

/// Cargo on a package, in the folder where the user is: a path in the arguments means what it means to the user's shell.
fn in_folder(what: &str, package: &str) -> Command {
    let mut command = cargo();
    command.arg(what).arg("--manifest-path");
    command.arg(root().join("Cargo.toml"));
    command.args(["--package", package]);
    command
}

/// Runs steps one after the other, and says at the end what tests could not run.
fn ci(steps: &[Step]) -> ExitCode {
    let mut skipped = Vec::new();
    for (name, args, (variable, value)) in steps {
        let mut command = cargo_in_root(args);
        if !variable.is_empty() {
            command.env(variable, value);
        }
        if *variable == BACKENDS {
            for test in backend_tests(value) {
                command.args(["--test", &test]);
            }
        }
        if *name == "test-gpu" {
            offer_software_gpu(&mut command);
        }
        let started = Instant::now();
        eprintln!("ci: {name}: cargo {}", args.join(" "));
        match watch(command, &mut skipped) {
            Ok(()) => eprintln!("ci: {name} passed in {} s", started.elapsed().as_secs()),
            Err(code) => {
                eprintln!("ci: {name} failed");
                return code;
            }
        }
    }
    eprintln!("ci: {} checks skipped on this machine", skipped.len());
    for line in skipped {
        eprintln!("ci: {line}");
    }
    ExitCode::SUCCESS
}

/// The test targets of the workspace whose source asks for the list of backends, or names this one where the program has it.
fn backend_tests(backend: &str) -> Vec<String> {
    let mut asks: Vec<String> = vec!["devices(".into(), "devices_in(".into(), "computes(".into()];
    if ALL_BACKENDS.contains(&format!("limpid/{backend}")) {
        asks.push(format!("\"{backend}\""));
    }
    let mut packages = vec![
        root().join("tests"),
        root().join("bench"),
        root().join("lab"),
    ];
    packages.extend(entries(&root().join("crates")));
    let mut tests: Vec<String> = packages
        .iter()
        .flat_map(|package| entries(&package.join("tests")))
        .filter(|path| {
            let asking = |file: &PathBuf| {
                let source = fs::read_to_string(file).unwrap_or_default();
                asks.iter().any(|ask| source.contains(ask))
            };
            target_files(path).iter().any(asking)
        })
        .filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned()))
        .collect();
    tests.sort();
    tests
}

/// The files of a test target, which is a file, or a folder with a `main.rs`; none of what is no target.
fn target_files(path: &Path) -> Vec<PathBuf> {
    let is_rust = |path: &PathBuf| path.extension() == Some(OsStr::new("rs"));
    let files = if path.join("main.rs").exists() {
        entries(path)
    } else {
        vec![path.to_owned()]
    };
    files.into_iter().filter(is_rust).collect()
}

/// What stands in a folder; nothing where there is none.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

/// Where Debian's chromium keeps SwiftShader, a GPU that the CPU plays, with a Vulkan loader beside it.
const SWIFTSHADER: &str = "/usr/lib/chromium";

/// Lets Vulkan find SwiftShader where it is installed, behind the drivers of real GPUs, unless the user names drivers.
fn offer_software_gpu(command: &mut Command) {
    let driver = Path::new(SWIFTSHADER).join("vk_swiftshader_icd.json");
    let named = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES"];
    if named.iter().any(|name| env::var_os(name).is_some()) || !driver.exists() {
        return;
    }
    command.env("VK_ADD_DRIVER_FILES", driver);
    let mut folders: Vec<PathBuf> = env::var_os("LD_LIBRARY_PATH")
        .map(|folders| env::split_paths(&folders).collect())
        .unwrap_or_default();
    folders.push(SWIFTSHADER.into());
    if let Ok(folders) = env::join_paths(folders) {
        command.env("LD_LIBRARY_PATH", folders);
    }
}

/// Runs a step, shows its standard error, and keeps the lines of it that say what was skipped.
fn watch(mut command: Command, skipped: &mut Vec<String>) -> Result<(), ExitCode> {
    let started = command.stderr(Stdio::piped()).spawn();
    let mut child = started.map_err(|error| could_not_start(&command, &error))?;
    for line in child
        .stderr
        .take()
        .into_iter()
        .flat_map(|e| BufReader::new(e).split(b'\n'))
    {
        let Ok(line) = line else { break };
        let line = String::from_utf8_lossy(&line).into_owned();
        eprintln!("{line}");
        if line.starts_with(SKIPPED) {
            skipped.push(line);
        }
    }
    match child.wait() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(exit_code(status.code())),
        Err(error) => Err(could_not_start(&command, &error)),
    }
}

/// Times the kernels, unless `args` ask for something else than the whole run, and then iterations.
fn bench(args: &[OsString]) -> ExitCode {
    if args.is_empty()
        && let Err(code) = wait(cargo_in_root(BENCH[0]))
    {
        return code;
    }
    become_command(iterations(args))
}

/// The command that times iterations with `args`.
fn iterations(args: &[OsString]) -> Command {
    let mut command = cargo_in_root(BENCH[1]);
    if let Some(backend) = backend_feature(args) {
        command.args(["--features", backend]);
    }
    command.arg("--").args(args);
    command
}

/// The feature that compiles the backend which `args` ask for, unless it is in the default build.
fn backend_feature(args: &[OsString]) -> Option<&'static str> {
    let mut values = args.iter().enumerate().filter_map(|(i, arg)| {
        if arg == "--backend" {
            args.get(i + 1)?.to_str()
        } else {
            arg.to_str()?.strip_prefix("--backend=")
        }
    });
    match values.next_back()? {
        "ndarray" => Some("ndarray"),
        "wgpu" => Some("wgpu"),
        "cuda" => Some("cuda"),
        _ => None,
    }
}

/// The checkout that cargo was called in. (Where two of them share a target folder, this program may have been built in the
/// other.)
fn root() -> PathBuf {
    let here =
        env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    let root = Path::new(&here).parent();
    root.expect("xtask lies in the workspace's root").to_owned()
}

/// The cargo that started this program.
fn cargo() -> Command {
    Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

fn cargo_in_root(args: &[&str]) -> Command {
    let mut command = cargo();
    command.args(args).current_dir(root());
    command
}

/// Runs a step of several; the exit code of a failed one comes back as an error.
fn wait(mut command: Command) -> Result<(), ExitCode> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(exit_code(status.code())),
        Err(error) => Err(could_not_start(&command, &error)),
    }
}

/// Runs the last command there is by becoming it, as `cargo run` itself does: a Ctrl-C then reaches
/// the program alone, which ends when its checkpoint is written, and not before.
#[cfg(unix)]
fn become_command(mut command: Command) -> ExitCode {
    use std::os::unix::process::CommandExt as _;
    let error = command.exec();
    could_not_start(&command, &error)
}

/// Without `exec`, waits for the child; cargo shields itself from Ctrl-C and waits on its own.
#[cfg(not(unix))]
fn become_command(command: Command) -> ExitCode {
    wait(command).map_or_else(|code| code, |()| ExitCode::SUCCESS)
}

fn exit_code(code: Option<i32>) -> ExitCode {
    // A child that a signal ended has no code.
    ExitCode::from(code.and_then(|code| u8::try_from(code).ok()).unwrap_or(1))
}

fn could_not_start(command: &Command, error: &std::io::Error) -> ExitCode {
    eprintln!(
        "xtask: cannot start {}: {error}",
        command.get_program().display()
    );
    ExitCode::FAILURE
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> Vec<OsString> {
        line.split_whitespace().map(OsString::from).collect()
    }

    /// What cargo is told, with `ROOT` for the workspace's root.
    fn train_line(args: &str) -> String {
        let command = train(&words(args));
        let args: Vec<_> = command
            .get_args()
            .map(OsStr::to_string_lossy)
            .skip(3)
            .collect();
        let root = root();
        let root = root.to_str().expect("a path in UTF-8");
        args.join(" ").replace(root, "ROOT")
    }

    #[test]
    fn without_a_scene_the_demo_is_trained() {
        let demo = "--package limpid -- train --config ROOT/demo/limpid.toml";
        assert_eq!(train_line(""), demo, "no arguments");
        for args in ["--iterations 300", "--out o --force"] {
            assert_eq!(train_line(args), format!("{demo} {args}"), "{args}");
        }
    }

    #[test]
    fn a_run_goes_on_without_settings_of_the_demo() {
        for (args, told) in [
            ("--resume", "--out out/demo --resume"),
            ("--resume --out o", "--resume --out o"),
            ("--out=o --resume", "--out=o --resume"),
        ] {
            let all = format!("--package limpid -- train {told}");
            assert_eq!(train_line(args), all, "{args}");
        }
    }

    #[test]
    fn arguments_with_a_scene_go_through_as_they_are() {
        for args in [
            "--scene a --set seed=1 --resume",
            "--scene=a",
            "--config c.toml",
            "--config=c.toml",
            "--help",
        ] {
            assert_eq!(
                train_line(args),
                format!("--package limpid -- train {args}"),
                "cargo's arguments"
            );
        }
    }

    #[test]
    fn the_laboratory_gets_a_program_where_it_needs_one() {
        for (args, trains) in [
            ("demo-study", true),
            ("run quality --scenes s", true),
            ("plan quality --engine slurm", true),
            ("quality --program p", false),
            ("quality --program=p", false),
            ("gather quality", false),
            ("--help", false),
            ("", false),
        ] {
            assert_eq!(lab_trains(&words(args)), trains, "{args}");
        }
        let command = in_folder("build", "limpid");
        assert_eq!(command.get_current_dir(), None, "where the user is");
    }

    #[test]
    fn tests_that_ask_for_a_backend_are_found() {
        let tests = backend_tests("wgpu");
        for (name, asks) in [
            ("training_devices", true),
            ("gpu", true),
            ("program", true),
            ("kills", false),
            ("golden", false),
        ] {
            assert_eq!(
                tests.iter().any(|test| test == name),
                asks,
                "{name} of {tests:?}"
            );
        }
    }

    #[test]
    fn only_a_backend_that_is_not_in_the_default_build_adds_a_feature() {
        for (args, feature) in [
            ("--backend wgpu --out o", Some("wgpu")),
            ("--out o --backend=ndarray", Some("ndarray")),
            ("--backend flex", None),
            ("--backend", None),
            ("--backend nonsense", None),
            ("", None),
        ] {
            assert_eq!(backend_feature(&words(args)), feature, "{args}");
        }
        assert!(
            train_line("--backend wgpu --scene s")
                .contains("--features wgpu -- train --backend wgpu"),
            "{}",
            train_line("--backend wgpu --scene s")
        );
        let args = words("launches --backend wgpu");
        let line = iterations(&args)
            .get_args()
            .map(OsStr::to_string_lossy)
            .collect::<Vec<_>>()
            .join(" ");
        assert_eq!(
            line,
            "run --package limpid-bench --features wgpu -- launches --backend wgpu"
        );
    }
}
