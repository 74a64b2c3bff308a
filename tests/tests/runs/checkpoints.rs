//! What a checkpoint promises: no changed bit is believed, one that is whole is always there, and a run goes on with what it was
//! started with, or says what is other.

use burn::tensor::Device;
use io::Scene;
use limpid_tests::tiny::{scene, settings};
use limpid_tests::with_causes;
use std::fs;
use std::path::Path;
use tempfile::TempDir;
use trainer::{CHECKPOINT_FILE, CheckpointProblem, PREVIOUS_CHECKPOINT_FILE};
use trainer::{Run, Settings, TrainError, Trainer};

fn trainer() -> Trainer {
    Trainer::new(scene(), settings(), &Device::flex()).expect("a trainer")
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("a folder")
}

fn open(folder: &Path) -> Result<Run, TrainError> {
    Run::open(folder, &Device::flex())
}

/// A folder with a checkpoint after one iteration and, before it, one after none.
fn two_saves() -> (TempDir, Trainer) {
    let (folder, mut trainer) = (folder(), trainer());
    trainer.save(folder.path()).expect("saved");
    trainer.step().expect("a step");
    trainer.save(folder.path()).expect("saved");
    (folder, trainer)
}

fn flip(file: &Path, at: usize) {
    let mut bytes = fs::read(file).expect("a file");
    bytes[at] ^= 1 << (at % 8);
    fs::write(file, bytes).expect("written");
}

/// Where the parameters begin in a file, behind the header.
fn data_in(bytes: &[u8]) -> usize {
    8 + u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize
}

#[test]
fn no_changed_bit_of_a_checkpoint_is_believed() {
    let folder = folder();
    trainer().save(folder.path()).expect("saved");
    let file = folder.path().join(CHECKPOINT_FILE);
    let whole = fs::read(&file).expect("a file");
    let header = data_in(&whole);
    let step = (whole.len() - header) / 200;
    let places = (0..header)
        .step_by(23)
        .chain((header..whole.len()).step_by(step));
    for at in places.chain([whole.len() - 1]) {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        fs::write(&file, &bytes).expect("written");
        match open(folder.path()) {
            Err(TrainError::Checkpoint { problem, .. }) => assert!(
                at < header || matches!(problem, CheckpointProblem::Damaged),
                "byte {at}: {problem}"
            ),
            other => panic!("byte {at} of {}: {other:?}", whole.len()),
        }
    }
    fs::write(&file, &whole).expect("written");
    assert!(open(folder.path()).is_ok(), "as it was written");
}

#[test]
fn a_damaged_or_missing_checkpoint_costs_one_interval() {
    let (folder, mut trainer) = two_saves();
    let [last, before] =
        [CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE].map(|name| folder.path().join(name));
    let run = open(folder.path()).expect("whole");
    assert!(run.iteration() == 1 && run.setback().is_none(), "the last");

    let data = data_in(&fs::read(&last).expect("a file"));
    flip(&last, data + 500);
    let run = open(folder.path()).expect("the one before");
    assert_eq!(run.iteration(), 0);
    let said = with_causes(run.setback().expect("it says so"));
    assert!(
        said.contains(CHECKPOINT_FILE) && said.contains("damaged"),
        "{said}"
    );
    let mut resumed = Trainer::resume(run, scene()).expect("resumed");
    resumed.step().expect("a step");

    // A damaged one does not take the place of the one before.
    let good = fs::read(&before).expect("a file");
    trainer.step().expect("a step");
    trainer.save(folder.path()).expect("saved");
    assert!(fs::read(&before).expect("a file") == good, "kept");
    assert_eq!(open(folder.path()).expect("whole").iteration(), 2);

    // As after a kill between the two renames: the new one has not got its name yet.
    fs::rename(&last, &before).expect("renamed");
    let run = open(folder.path()).expect("the one before");
    assert_eq!(run.iteration(), 2);
    assert!(run.setback().is_some(), "it says so");

    fs::copy(&before, &last).expect("copied");
    flip(&last, 100);
    flip(&before, data + 1500);
    let error = open(folder.path()).expect_err("both are damaged");
    let said = with_causes(&error);
    for name in [CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE, "new run"] {
        assert!(said.contains(name), "{said}");
    }

    let empty = self::folder();
    let said = open(empty.path()).expect_err("nothing there").to_string();
    assert!(
        said.contains("no checkpoint was saved") && said.contains("--force"),
        "{said}"
    );
}

#[test]
fn another_format_is_named() {
    let folder = folder();
    trainer().save(folder.path()).expect("saved");
    let file = folder.path().join(CHECKPOINT_FILE);
    let whole = fs::read(&file).expect("a file");
    let key = br#"\"format\":8"#;
    let at = whole.windows(key.len()).position(|w| w == key);
    let at = at.expect("a format");
    let reads = "this program reads 8";
    for (other, said, and) in [
        (br#"\"format\":7"#, "it has format 7", reads),
        (br#"\"fromat\":8"#, "it has no format", reads),
        // No version wrote this.
        (br#"\"format\":{"#, "it is damaged", "checksum"),
        (br#"\"format\":-"#, "it is damaged", "checksum"),
    ] {
        let mut bytes = whole.clone();
        bytes[at..at + other.len()].copy_from_slice(other);
        fs::write(&file, bytes).expect("written");
        let error = with_causes(&open(folder.path()).expect_err("another format"));
        assert!(error.contains(said) && error.contains(and), "{error}");
        assert!(!error.contains("Some"), "{error}");
    }
}

#[test]
fn inputs_that_were_replaced_are_named() {
    let mut seen = scene();
    seen.points.push(io::SparsePoint {
        position: glam::DVec3::new(0.0, 0.0, 4.0),
        color: [0.5; 3],
    });
    let trainer = Trainer::new(seen.clone(), settings(), &Device::flex()).expect("a trainer");
    let folder = folder();
    trainer.save(folder.path()).expect("saved");
    type Replace = fn(&mut Scene);
    let replaced: [(&str, Replace); 6] = [
        ("the picture of frame 00002", |s| {
            s.frames[2].view.image.pixels[7] += 1.0 / 255.0;
        }),
        ("the depth of frame 00001", |s| {
            s.frames[1].depth.as_mut().expect("depth").values[3] *= 1.001;
        }),
        ("the mask of frame 00004", |s| {
            let mask = s.frames[4].mask.as_mut().expect("a mask");
            mask.values[0] = 1.0 - mask.values[0];
        }),
        ("the tracks of frame", |s| {
            let tracks = s.tracks.as_mut().expect("tracks");
            let mut queries = tracks.queries.iter_mut();
            let query = queries.find(|q| !q.samples.is_empty()).expect("a query");
            query.samples[0].x += 0.25;
        }),
        ("the mask of frame 00000", |s| {
            s.frames.iter_mut().for_each(|frame| frame.mask = None);
            s.tracks = None;
        }),
        ("the cloud of sparse points", |s| {
            s.points[0].position.z += 1e-9;
        }),
    ];
    for (name, replace) in replaced {
        let mut other = seen.clone();
        replace(&mut other);
        let run = open(folder.path()).expect("opened");
        let error = Trainer::resume(run, other).expect_err(name);
        assert!(matches!(error, TrainError::OtherScene(_)), "{error}");
        let said = with_causes(&error);
        assert!(said.contains(name) && said.contains("--force"), "{said}");
    }
    // Test views teach nothing.
    seen.test.clear();
    Trainer::resume(open(folder.path()).expect("opened"), seen).expect("resumed");
}

/// A run that became longer, up to its first end, is the run that it was.
#[test]
fn a_longer_run_is_the_shorter_one_and_what_follows() {
    let (folder, mut shorter) = (folder(), trainer());
    for _ in 0..40 {
        shorter.step().expect("a step");
    }
    shorter.save(folder.path()).expect("saved");
    let mut asked = settings();
    let end = asked.iterations;
    asked.iterations = end + 30;
    let mut run = open(folder.path()).expect("opened");
    let changes = run.change(asked, false).expect("longer");
    assert_eq!(changes.len(), 1, "{changes:?}");
    let longer = Trainer::resume(run, scene()).expect("resumed");
    assert_eq!(shorter.schedule(), longer.schedule());
    // It is one after another interruption, too.
    longer.save(folder.path()).expect("saved");
    let mut longer = Trainer::load(folder.path(), scene(), &Device::flex()).expect("loaded");
    assert_eq!(shorter.schedule(), longer.schedule());
    assert_eq!(longer.run().changes(), changes);
    while !shorter.is_done() {
        let expected = shorter.step().expect("a step");
        assert_eq!(expected, longer.step().expect("a step"));
    }
    assert!(!longer.is_done(), "there is more to come");
    while !longer.is_done() {
        longer.step().expect("a step");
    }
    assert_eq!(longer.iteration(), end + 30);
}

#[test]
fn settings_that_may_not_change_are_refused_and_changes_are_kept() {
    let (folder, trainer) = two_saves();
    let started = trainer.settings().clone();
    type Ask = fn(&mut Settings);
    let refused: [(&str, Ask); 4] = [
        ("`blur.kernel_size` is 7 here and", |s| {
            s.blur.kernel_size = 7;
        }),
        ("shorter", |s| s.iterations = 200),
        ("--allow-change", |s| s.learning_rates.means *= 0.5),
        ("checkpoint_minutes", |s| s.checkpoint_minutes = -1.0),
    ];
    for (said, ask) in refused {
        let mut asked = started.clone();
        asked.iterations = 250;
        let mut run = open(folder.path()).expect("opened");
        run.change(asked.clone(), false).expect("longer");
        let before = run.settings().clone();
        ask(&mut asked);
        let error = run.change(asked, false).expect_err(said).to_string();
        assert!(error.contains(said), "{error}");
        assert_eq!(*run.settings(), before, "nothing has changed");
    }

    let mut run = open(folder.path()).expect("opened");
    let mut asked = started.clone();
    asked.checkpoint_every = 7;
    asked.checkpoint_minutes = 0.5;
    assert!(run.change(started.clone(), false).expect("same").is_empty());
    assert!(run.change(asked.clone(), false).expect("free").is_empty());
    asked.learning_rates.means = 1e-5;
    let changes = run.change(asked, true).expect("allowed");
    let mut resumed = Trainer::resume(run, scene()).expect("resumed");
    resumed.step().expect("a step");
    resumed.count_seconds(1.5);
    resumed.save(folder.path()).expect("saved");
    let run = open(folder.path()).expect("opened");
    assert_eq!(run.changes(), changes);
    let [change] = run.changes() else {
        panic!("one change: {changes:?}")
    };
    assert_eq!(
        (change.iteration, change.setting.as_str()),
        (1, "learning_rates.means")
    );
    assert_eq!(change.from, started.learning_rates.means);
    assert_eq!((change.to.as_f64(), run.seconds()), (Some(1e-5), 1.5));
    assert_eq!(run.settings().checkpoint_every, 7);
}
