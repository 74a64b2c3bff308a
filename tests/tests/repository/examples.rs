//! Every library crate has an example under 40 lines, and all of them run.

use limpid_tests::skipped;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The examples of all crates.
fn examples() -> Vec<PathBuf> {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates");
    let mut found = Vec::new();
    for entry in fs::read_dir(crates).expect("crates/ can be read") {
        let folder = entry.expect("an entry of crates/").path();
        // What is below the kernels, or the programs, shows itself on its front page, the program in the README; the last one is
        // for tests alone.
        let others = ["host", "signals", "limpid", "property"];
        if others.iter().any(|name| folder.ends_with(name)) {
            continue;
        }
        let examples = fs::read_dir(folder.join("examples"))
            .unwrap_or_else(|e| panic!("{} has no examples: {e}", folder.display()));
        found.extend(examples.map(|entry| entry.expect("an entry of examples/").path()));
    }
    found.sort();
    found
}

#[test]
fn examples_are_short() {
    for path in examples() {
        let lines = fs::read_to_string(&path).expect("readable").lines().count();
        assert!(lines < 40, "{} has {lines} lines", path.display());
    }
}

#[test]
fn examples_run() {
    let this = std::env::current_exe().expect("this test's program");
    let built = this.ancestors().nth(2).expect("the build folder");
    for path in examples() {
        let name = path.file_stem().expect("a file has a name");
        let program = built.join("examples").join(name);
        // Where only tests are built, an example may be missing, or of another day.
        let changed = |path: &Path| fs::metadata(path).and_then(|m| m.modified()).ok();
        if changed(&program) < changed(&path) {
            let why = format!(
                "{} is not built; cargo test --workspace builds it",
                path.display()
            );
            skipped("examples_run", &why);
            continue;
        }
        let output = Command::new(&program).output().expect("it starts");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {errors}", path.display());
        assert!(!output.stdout.is_empty(), "{} says nothing", path.display());
    }
}
