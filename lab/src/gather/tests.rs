use super::*;
use crate::execute::Failed;
use crate::expand::Case;
use crate::machine::Machine;
use crate::report::Row;

fn map(values: &[(u64, f64)]) -> BTreeMap<u64, f64> {
    values.iter().copied().collect()
}

const STUDY: &str = r#"
title = "T"
about = "A."
scenes = ["a", "b"]
seeds = [1, 2]
baseline = "off"
bound = "bound"
score = ["all", "cpu"]
set.iterations = 200
[[variants]]
name = "off"
set.x = 0
[[variants]]
name = "on"
set.x = 1
[[variants]]
name = "bound"
set.x = 2
except = ["b"]
"#;

fn program(commit: &str) -> Program {
    Program {
        path: "limpid".into(),
        fingerprint: commit.to_owned(),
        version: "limpid 0".to_owned(),
        commit: Some(commit.to_owned()),
        changed: false,
    }
}

/// A run's results, or the record of one that died.
fn write(places: &Places, case: &Case, all: Option<f64>) {
    let folder = places.runs().join(&case.run.id);
    fs::create_dir_all(&folder).expect("a folder");
    let attempt = |resumed, failed| crate::execute::Attempt {
        began: 86_400 * case.seed,
        wall_seconds: Some(3.0),
        cpu_seconds: Some(2.0),
        peak_mib: Some(100.0),
        resumed,
        failed,
        machine: Machine {
            processor: "a chip".to_owned(),
            cores: 4,
        },
    };
    let how = |how: &str| Failed {
        how: how.to_owned(),
        last_lines: vec!["it was".to_owned(), "the end".to_owned()],
    };
    let mut attempts = vec![attempt(false, Some(how("exit code 1")))];
    if let Some(all) = all {
        attempts.push(attempt(true, None));
        let metrics = format!("{{\"test\": {{\"mpsnr\": {all}}}}}");
        fs::write(folder.join("metrics.json"), metrics).expect("written");
    }
    let record = Record { attempts };
    let text = serde_json::to_string(&record).expect("JSON");
    fs::write(folder.with_extension("json"), text).expect("written");
}

#[test]
fn what_is_there_is_gathered_half_way_too() {
    let folder = tempfile::tempdir().expect("a folder");
    let places = Places {
        out: folder.path().to_owned(),
    };
    let path = Path::new("s.toml");
    let study = Study::parse(STUDY, path).expect("a study");
    let program = Program {
        path: "limpid".into(),
        fingerprint: "f".to_owned(),
        version: "limpid 0".to_owned(),
        commit: Some("abc".to_owned()),
        changed: false,
    };
    let report = || gather(("s", &study, path), &program, &places, None).expect("a report");
    let nothing = report();
    assert_eq!((nothing.planned, nothing.finished), (10, 0));
    assert!(nothing.origin.dates.is_none() && nothing.failed.is_empty());
    assert!(crate::table::markdown(&nothing, None).contains("**0 of 10 runs are finished.**"));

    for case in cases(&study, path, "f").expect("cases") {
        let all = match (&*case.scene, &*case.arm, case.seed) {
            ("a", "off", seed) => Some(20.0 + seed as f64),
            ("a", "on", seed) => Some(25.0 + 2.0 * seed as f64),
            ("a", "bound", seed) => Some(30.0 + seed as f64),
            ("b", "off", 1) => Some(30.0),
            ("b", "on", 1) => Some(29.0),
            ("b", "on", 2) => None,
            _ => continue,
        };
        write(&places, &case, all);
    }
    let found = report();
    assert_eq!((found.planned, found.finished), (10, 8));
    let days = ["1970-01-02", "1970-01-03"].map(str::to_owned);
    assert_eq!(found.origin.dates, Some(days.into()));
    assert_eq!(found.origin.machines.len(), 1);
    let [died] = &found.failed[..] else {
        panic!("one died: {:?}", found.failed);
    };
    assert_eq!((&*died.scene, &*died.arm, died.seed), ("b", "on", 2));

    // Gains of 6 and 7 of 10 on `a`, of -1 on `b`, where nothing bounds.
    let row = |scene: usize, arm: &str| {
        let rows = &found.scenes[scene].rows;
        rows.iter().find(|row| row.arm == arm).expect("a row")
    };
    let on = &row(0, "on").cells[0];
    let gain = on.gain.expect("two pairs");
    assert!(
        (gain.mean - 6.5).abs() < 1e-12 && (gain.standard_error.expect("two") - 0.5).abs() < 1e-12
    );
    assert!((on.closed.expect("a way").mean - 0.65).abs() < 1e-12);
    assert_eq!(row(1, "on").cells[0].closed, None);
    assert_eq!(row(1, "on").runs, 1);
    assert!(found.scenes[1].rows.iter().all(|row| row.arm != "bound"));
    assert_eq!(
        row(0, "off").cells[1].mean.expect("measured").mean,
        4.0,
        "both attempts"
    );
    let over = found
        .overall
        .iter()
        .find(|row| row.arm == "on")
        .expect("a row");
    let gain = over.cells[0].gain.expect("two scenes");
    assert!((gain.mean - 2.75).abs() < 1e-12, "{gain:?}");
    assert_eq!(gain.standard_error, None, "of one scene nothing is known");

    let table = crate::table::markdown(&found, Some("s.svg"));
    for part in [
        "**8 of 10 runs are finished, and 1 died.**",
        "limpid 0, commit `abc`, 1970-01-02 to 1970-01-03, on a chip, 4 cores; one thread a run.",
        "| on | 2 | 28.00 ± 1.00 (**+6.50 ± 0.50**; 65 %) | 4.0 ± 0.0 (×1.00 ± 0.00) |",
        "| on | 1 | 29.00 (-1.00) | 4.0 (×1.00) |",
        "| on | 2 | +2.75; 65 % (of 1) | ×1.00 |",
        "![T](s.svg)",
        "- `b`, on, seed 2",
        "exit code 1: the end",
    ] {
        assert!(table.contains(part), "{part}: {table}");
    }
    assert!(!table.contains("\n\n\n"), "one empty line at most: {table}");
}

#[test]
fn what_a_report_holds_needs_no_folder_any_more() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = Path::new("s.toml");
    let study = Study::parse(STUDY, path).expect("a study");
    let places = |name: &str| Places {
        out: folder.path().join(name),
    };
    let file = folder.path().join("s.json");
    let keep = |report: &Report| {
        fs::write(&file, serde_json::to_string(report).expect("JSON")).expect("written");
        Kept::read(&file, "s", &study)
    };
    let trained = |commit: &str, seed: u64, more: f64| {
        for case in cases(&study, path, commit).expect("cases") {
            if case.seed == seed {
                write(&places(commit), &case, Some(30.0 + more));
            }
        }
    };
    trained("first", 1, 0.0);
    let of = |commit: &str, kept: Option<&Kept>| {
        let report = gather(("s", &study, path), &program(commit), &places(commit), kept);
        report.expect("a report")
    };
    let half = of("first", None);
    assert_eq!((half.planned, half.finished), (10, 5));
    let kept = keep(&half).expect("a report");

    // Another machine, with another program: what is kept is not planned, and stands beside what is new.
    let lacking = cases(&study, path, "second").expect("cases");
    let lacking = lacking.iter().filter(|case| !kept.holds(case));
    assert!(lacking.map(|case| case.seed).eq([2; 5]));
    trained("second", 2, 1.0);
    let whole = of("second", Some(&kept));
    assert_eq!((whole.planned, whole.finished), (10, 10));
    assert_eq!(
        whole.scenes[0].rows[0].cells[0].values,
        map(&[(1, 30.0), (2, 31.0)])
    );
    assert_eq!(
        whole.scenes[0].rows[0].cells[1].values,
        map(&[(1, 4.0), (2, 4.0)])
    );
    assert_eq!(whole.earlier, std::slice::from_ref(&half.origin));
    let table = crate::table::markdown(&whole, None);
    for part in [
        "limpid 0, commit `second`, 1970-01-03, on a chip",
        "Other runs: limpid 0, commit `first`, 1970-01-02, on a chip, 4 cores.",
    ] {
        assert!(table.contains(part), "{part}: {table}");
    }
    assert!(!table.contains('†'), "pairs are of one seed: {table}");

    // Told again of itself it is the same, and a program of the same commit elsewhere is the same program.
    let again = of("second", Some(&keep(&whole).expect("a report")));
    assert_eq!(again.earlier, whole.earlier);
    assert_eq!(again.origin, whole.origin);
    let elsewhere = of("first", Some(&keep(&whole).expect("a report")));
    assert_eq!(elsewhere.finished, 10);
    assert_eq!(elsewhere.origin, half.origin);
    assert_eq!(elsewhere.earlier, [whole.origin]);

    // An arm by another name asks for what it asked for.
    let renamed = STUDY.replace("\"on\"", "\"with\"");
    assert_ne!(renamed, STUDY);
    let renamed = Study::parse(&renamed, path).expect("a study");
    let all = cases(&renamed, path, "p").expect("cases");
    assert!(all.iter().all(|case| kept.holds(case) == (case.seed == 1)));

    // An arm that asks for something else now is not what was kept under its name.
    let changed = STUDY.replace("set.x = 1", "set.x = 3");
    let changed = Study::parse(&changed, path).expect("a study");
    let all = cases(&changed, path, "p").expect("cases");
    for case in &all {
        assert_eq!(
            kept.holds(case),
            case.seed == 1 && case.arm != "on",
            "{case:?}"
        );
    }
    // Made by another program, it is told apart from what it is compared with.
    for case in all.iter().filter(|case| !kept.holds(case)) {
        write(&places("p"), case, Some(32.0));
    }
    let report = |program, kept| {
        gather(("s", &changed, path), &program, &places("p"), kept).expect("a report")
    };
    let mixed = report(program("p"), Some(&kept));
    let is_mixed = |row: &Row| {
        let known = |seed: u64, commit: &str| row.programs[&seed].contains(commit);
        assert!(known(1, if row.arm == "on" { "p" } else { "first" }) && known(2, "p"));
        row.is_mixed
    };
    let [rows, _] = &mixed.scenes[..] else {
        panic!("two scenes")
    };
    assert!(rows.rows.iter().map(is_mixed).eq([false, true, false]));
    let table = crate::table::markdown(&mixed, None);
    for part in ["| on† | 2 |", "† where runs of two programs are compared"] {
        assert!(table.contains(part), "{part}: {table}");
    }

    let more = STUDY.replace("\"cpu\"", "\"cpu\", \"ssim\"");
    let more = Study::parse(&more, path).expect("a study");
    for (name, study, told) in [("s", &more, "have no `ssim`"), ("t", &study, "not of `t`")] {
        let error = Kept::read(&file, name, study).expect_err("no use");
        assert!(error.to_string().contains(told), "{error}");
    }
}

#[test]
fn costs_of_two_processors_are_told_apart() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = Path::new("s.toml");
    let study = Study::parse(STUDY, path).expect("a study");
    let places = Places {
        out: folder.path().to_owned(),
    };
    let all = cases(&study, path, "p").expect("cases");
    for case in &all {
        write(&places, case, Some(30.0));
    }
    let report =
        |kept| gather(("s", &study, path), &program("p"), &places, kept).expect("a report");
    let elsewhere = |report: &Report| -> Vec<[bool; 2]> {
        let rows = report.scenes.iter().flat_map(|table| &table.rows);
        rows.map(|row| [0, 1].map(|score| row.cells[score].is_elsewhere))
            .collect()
    };
    let one = report(None);
    assert_eq!(elsewhere(&one), [[false; 2]; 5]);
    assert!(one.scenes[0].rows[1].processors.is_empty(), "at the head");
    // A run of `on`, on another kind.
    let other = all.iter().find(|case| case.arm == "on").expect("a case");
    let record = places.runs().join(&other.run.id).with_extension("json");
    let text = fs::read_to_string(&record).expect("a record");
    fs::write(&record, text.replace("a chip", "another")).expect("written");
    let two = report(None);
    let expected = [
        [false, false],
        [false, true],
        [false; 2],
        [false; 2],
        [false; 2],
    ];
    assert_eq!(elsewhere(&two), expected, "of the cost alone");
    let table = crate::table::markdown(&two, None);
    assert!(table.contains("(×1.00 ± 0.00‡)"), "{table}");
    // It is known of what an earlier report holds as well.
    let file = folder.path().join("s.json");
    fs::write(&file, serde_json::to_string(&two).expect("JSON")).expect("written");
    fs::remove_dir_all(places.runs()).expect("removed");
    let kept = Kept::read(&file, "s", &study).expect("a report");
    assert_eq!(elsewhere(&report(Some(&kept))), expected);
}

#[test]
fn a_report_names_only_what_made_its_runs() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = Path::new("s.toml");
    let study = Study::parse(STUDY, path).expect("a study");
    let one_seed = STUDY.replace("seeds = [1, 2]", "seeds = [1]");
    let one_seed = Study::parse(&one_seed, path).expect("a study");
    let places = |name: &str| Places {
        out: folder.path().join(name),
    };
    // What is trained with a seed begins on that day, by `write`.
    let trained = |commit: &str, seeds: &[u64]| {
        for case in cases(&study, path, commit).expect("cases") {
            if seeds.contains(&case.seed) {
                write(&places(commit), &case, Some(30.0));
            }
        }
    };
    let of = |study: &Study, commit: &str, kept: Option<&Kept>| {
        let report = gather(("s", study, path), &program(commit), &places(commit), kept);
        report.expect("a report")
    };
    let file = folder.path().join("s.json");
    let keep = |report: &Report| {
        fs::write(&file, serde_json::to_string(report).expect("JSON")).expect("written");
        Kept::read(&file, "s", &study).expect("a report")
    };

    // `first` made one seed, `second` the other.
    trained("first", &[1]);
    trained("second", &[2]);
    let first = of(&study, "first", None);
    let both = of(&study, "second", Some(&keep(&first)));
    assert_eq!((both.finished, both.earlier.len()), (10, 1));

    // A third makes one of them anew, and then all: what nothing is of any more is not named.
    trained("third", &[2]);
    let third = of(&study, "third", Some(&keep(&both)));
    assert_eq!(third.finished, 10);
    assert_eq!(third.earlier, std::slice::from_ref(&first.origin));
    trained("third", &[1, 2]);
    let third = of(&study, "third", Some(&keep(&both)));
    assert_eq!(third.finished, 10);
    assert!(third.earlier.is_empty(), "{:?}", third.earlier);
    let mut rows = third.scenes.iter().flat_map(|table| &table.rows);
    assert!(rows.all(|row| row.programs.is_empty()), "one program");

    // Nor are days of the same program on which others of its runs began.
    let third = of(&one_seed, "third", Some(&keep(&third)));
    assert_eq!((third.finished, third.earlier.len()), (5, 0));
    let day = "1970-01-02".to_owned();
    assert_eq!(third.origin.dates, Some((day.clone(), day)));

    // Where a report does not say which of its programs made a run, it may be any.
    let mut unsaid = both.clone();
    let rows = unsaid.scenes.iter_mut().flat_map(|table| &mut table.rows);
    rows.for_each(|row| row.programs.clear());
    let fourth = of(&one_seed, "fourth", Some(&keep(&unsaid)));
    assert_eq!(fourth.finished, 5);
    assert_eq!(
        (fourth.origin, fourth.earlier),
        (both.origin, vec![first.origin])
    );
}
