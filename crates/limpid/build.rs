//! Tells the program which commit it was built from, where git knows: the last one that changed what it is made of, so that a
//! commit of words makes the same bytes, and with them the same runs of a study.

#![allow(
    clippy::print_stdout,
    reason = "cargo reads what a build script prints"
)]

use std::process::Command;

/// What the program is made of, from its own folder.
const SOURCES: [&str; 4] = ["--", "..", "../../Cargo.toml", "../../Cargo.lock"];

fn git(arguments: &[&str]) -> Option<String> {
    let run = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(run.stdout).ok()?;
    run.status.success().then(|| text.trim().to_owned())
}

fn main() {
    // Of another repository, where this one's sources lie in it without a history of their own, nothing is said.
    let is_ours = git(&["ls-files", "--error-unmatch", "build.rs"]).is_some();
    let commit = is_ours
        .then(|| git(&[&["log", "-1", "--abbrev=9", "--format=%h"], &SOURCES[..]].concat()))
        .flatten();
    let commit = commit.filter(|commit| !commit.is_empty());
    let commit = commit.unwrap_or_else(|| "unknown".to_owned());
    println!("cargo::rustc-env=LIMPID_COMMIT={commit}");
    println!("cargo::rerun-if-changed=build.rs");
    // Every commit and checkout writes a line to it.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo::rerun-if-changed={log}");
    }
}
