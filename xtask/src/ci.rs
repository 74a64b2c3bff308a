//! The steps of `ci`: one after the other, with what tests could not run on this machine.

use crate::cargo::{cargo_in_root, could_not_start, exit_code, root};
use std::env;
use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::Instant;

/// A step of `ci`: its name, cargo's arguments, and a variable of the environment.
pub(crate) type Step = (
    &'static str,
    &'static [&'static str],
    (&'static str, &'static str),
);

/// The variable that names the backends whose tests run. A step that sets it runs [`backend_tests`] alone: all others are the
/// same on every backend, and the step `test` has run them.
const BACKENDS: &str = "LIMPID_BACKENDS";

/// What compiles all backends that tests know: one build for every step that needs another one than the default.
const ALL_BACKENDS: &str = "limpid-tests/ndarray,limpid-tests/wgpu,limpid/wgpu,limpid-bench/wgpu";

/// CUDA is compiled as far as lints need it: nothing here runs it.
const CUDA: &str = "limpid-tests/cuda,limpid/cuda,limpid-bench/cuda";

/// What makes the crates below CUDA do without the LLVM that they fetch and link otherwise, as where docs.rs builds them.
const WITHOUT_LLVM: (&str, &str) = ("DOCS_RS", "1");

/// The steps of `ci`, in their order. Where Burn is compiled, always the whole workspace: with `--package`, cargo would give
/// the crates below it other features, and compile it again.
pub(crate) const STEPS: [Step; 8] = [
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
        &[
            "clippy",
            "--package",
            "splat-core",
            "--no-default-features",
            "--all-targets",
            "--",
            "-D",
            "warnings",
        ],
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
            "--features",
            CUDA,
            "--",
            "-D",
            "warnings",
        ],
        WITHOUT_LLVM,
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

/// Runs steps one after the other, and says at the end what tests could not run.
pub(crate) fn ci(steps: &[Step]) -> ExitCode {
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

/// The file that tells Vulkan of SwiftShader, a GPU that the CPU plays.
const SWIFTSHADER: &str = "vk_swiftshader_icd.json";

/// The folder with SwiftShader, and a Vulkan loader beside it: where `.ci/run` unpacks it, or where Debian's chromium keeps it.
fn software_gpu() -> Option<PathBuf> {
    let build = env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    let build = build.or_else(|| Some(env::home_dir()?.join(".cache/limpid-target")));
    let unpacked = build.map(|build| build.join("swiftshader"));
    let mut folders = unpacked.into_iter().chain(["/usr/lib/chromium".into()]);
    folders.find(|folder| folder.join(SWIFTSHADER).exists())
}

/// Lets Vulkan find SwiftShader where it is installed, behind the drivers of real GPUs, unless the user names drivers.
fn offer_software_gpu(command: &mut Command) {
    let named = ["VK_DRIVER_FILES", "VK_ICD_FILENAMES", "VK_ADD_DRIVER_FILES"];
    if named.iter().any(|name| env::var_os(name).is_some()) {
        return;
    }
    let Some(folder) = software_gpu() else {
        return;
    };
    command.env("VK_ADD_DRIVER_FILES", folder.join(SWIFTSHADER));
    let mut folders: Vec<PathBuf> = env::var_os("LD_LIBRARY_PATH")
        .map(|folders| env::split_paths(&folders).collect())
        .unwrap_or_default();
    folders.push(folder);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tests_that_ask_for_a_backend_are_found() {
        let tests = backend_tests("wgpu");
        for (name, asks) in [
            ("training", true),
            ("gpu", true),
            ("backends", true),
            ("program", false),
            ("kills", false),
            ("runs", false),
            ("golden", false),
        ] {
            assert_eq!(
                tests.iter().any(|test| test == name),
                asks,
                "{name} of {tests:?}"
            );
        }
    }
}
