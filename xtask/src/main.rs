//! `cargo xtask …`: development commands.
//!
//! A thin launcher over cargo. It compiles in a second, depends on nothing, and never on Burn: what
//! it starts shares the profile and the features of a plain `cargo test --workspace`, so that nothing
//! is compiled twice.

mod cargo;
mod ci;

use cargo::{become_command, cargo, cargo_in_root, root, wait};
use ci::{STEPS, ci};
use std::env;
use std::ffi::{OsStr, OsString};
use std::process::{Command, ExitCode};

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
  bare           lint splat-core without Burn
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
