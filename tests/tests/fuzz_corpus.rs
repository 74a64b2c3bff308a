//! The fuzz targets on their corpus, on stable: what is called `good-*` is read, what is called `bad-*`
//! gives an error that names the file, and nothing panics, not even on good files with changed bytes.

#[path = "../../fuzz/src/checkpoint.rs"]
pub mod checkpoint;
#[path = "../../fuzz/src/parsers.rs"]
pub mod parsers;

use std::collections::BTreeSet;
use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use limpid_tests::property;

/// The entries of a folder below fuzz/, in order.
fn entries(folder: &str) -> BTreeSet<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz");
    fs::read_dir(root.join(folder))
        .unwrap_or_else(|e| panic!("fuzz/{folder}: {e}"))
        .map(|entry| entry.expect("an entry of a folder").path())
        .collect()
}

fn stem(path: &Path) -> &str {
    let stem = path.file_stem().and_then(|stem| stem.to_str());
    stem.expect("a name in UTF-8")
}

fn replay<E: Display>(target: &str, run: impl Fn(&Path, &[u8]) -> Result<(), E>) {
    let scenes = parsers::scenes();
    let folder = scenes.path().to_string_lossy();
    let (mut good, mut bad) = (0, 0);
    for path in entries(&format!("corpus/{target}")) {
        let name = format!("{target}/{}", stem(&path));
        let bytes = fs::read(&path).unwrap_or_else(|e| panic!("{name}: {e}"));
        let error = run(scenes.path(), &bytes).err().map(|e| e.to_string());
        if stem(&path).starts_with("good-") {
            assert_eq!(error, None, "{name}");
            good += 1;
        }
        if stem(&path).starts_with("bad-") {
            let error = error.unwrap_or_else(|| panic!("{name} is read"));
            assert!(error.contains(&*folder), "{name} names no file: {error}");
            bad += 1;
        }
    }
    assert!(good > 0 && bad > 0, "{target}: {good} good, {bad} bad");
}

#[test]
fn every_target_has_a_corpus_and_every_corpus_a_target() {
    let mut targets = BTreeSet::from(parsers::TARGETS.map(|(name, _)| name));
    targets.insert("checkpoint");
    for folder in ["corpus", "fuzz_targets"] {
        let entries = entries(folder);
        let found: BTreeSet<&str> = entries.iter().map(|path| stem(path)).collect();
        assert_eq!(found, targets, "fuzz/{folder}/");
    }
}

#[test]
fn the_parsers_corpus_holds_no_surprise() {
    for (target, run) in parsers::TARGETS {
        replay(target, run);
    }
}

#[test]
fn the_checkpoints_corpus_holds_no_surprise() {
    replay("checkpoint", checkpoint::checkpoint);
}

/// Runs a target on good files of its corpus with changed bytes: an error or something sound, the targets look at what they open.
fn change<E>(target: &str, run: impl Fn(&Path, &[u8]) -> Result<(), E>) {
    let good: Vec<Vec<u8>> = entries(&format!("corpus/{target}"))
        .iter()
        .filter(|path| stem(path).starts_with("good-"))
        .map(|path| fs::read(path).expect("a file of the corpus"))
        .collect();
    let scenes = parsers::scenes();
    property(target, 200, |u| {
        let mut bytes = u.choose(&good)?.clone();
        for _ in 0..u.int_in_range(1..=8)? {
            let at = u.choose_index(bytes.len())?;
            bytes[at] = u.arbitrary()?;
        }
        run(scenes.path(), &bytes).ok();
        Ok(())
    });
}

#[test]
fn changed_bytes_never_panic() {
    for (target, run) in parsers::TARGETS {
        change(target, run);
    }
    change("checkpoint", checkpoint::checkpoint);
}
