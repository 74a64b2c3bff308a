//! docs/RELIABILITY.md names the test that holds each of its rows: they are there.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Text between backticks.
fn quoted(cell: &str) -> Vec<&str> {
    cell.split('`').skip(1).step_by(2).collect()
}

/// Names of the functions in a file that are tests.
fn tests_of(source: &str) -> Vec<String> {
    let mut names = Vec::new();
    let mut is_test = false;
    for line in source.lines().map(str::trim_start) {
        if line.starts_with("#[test]") {
            is_test = true;
        } else if let Some(rest) = line.strip_prefix("fn ") {
            let name = rest.split(['(', '<']).next().unwrap_or_default();
            if std::mem::take(&mut is_test) {
                names.push(name.to_owned());
            }
        }
    }
    names
}

#[test]
fn each_row_of_the_table_is_held_by_a_test() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let text = fs::read_to_string(root.join("docs/RELIABILITY.md")).expect("the table");
    let mut known = BTreeMap::new();
    let mut rows = 0;
    for line in text.lines().filter(|line| line.starts_with("| ")) {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
        let [_, _, held_by] = cells[..] else {
            panic!("three cells: {line}");
        };
        if held_by == "Held by" {
            continue;
        }
        rows += 1;
        let [file, test] = quoted(held_by)[..] else {
            panic!("a file and a test: {line}");
        };
        let tests = known.entry(file.to_owned()).or_insert_with(|| {
            let source = fs::read_to_string(root.join(file));
            tests_of(&source.unwrap_or_else(|e| panic!("{file}: {e}")))
        });
        assert!(
            tests.iter().any(|name| name == test),
            "{file} has no test `{test}`"
        );
    }
    assert!(rows > 40, "{rows} rows");
}
