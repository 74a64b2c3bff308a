//! The figures of docs/NUMERICS.md hold, and so does what is promised.

use limpid_tests::devices;
use limpid_tests::numerics::{Place, cases, measure, measures, read_table};
use std::path::Path;

/// Under this an error counts as this much: half a unit in the last place moves with the order of a few additions.
const ROUNDING: f64 = 1.2e-7;

#[test]
fn every_case_keeps_the_promise_and_the_table() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/NUMERICS.md");
    let text = std::fs::read_to_string(&path).expect("docs/NUMERICS.md");
    let table = read_table(&text);
    let mut faults = Vec::new();
    let cases = cases();
    for case in &cases {
        let row = measure(case, &Place::F32);
        let key = (row.op.clone(), row.name.clone());
        let Some(before) = table.get(&key) else {
            faults.push(format!(
                "{case:?}: not in the table; run `cargo xtask numerics`"
            ));
            continue;
        };
        for (direction, figures, before) in [
            ("forward", row.forward, before[0]),
            ("backward", row.backward, before[1]),
        ] {
            if figures.of_promise > 1.0 {
                let times = figures.of_promise;
                faults.push(format!(
                    "{case:?}, {direction}: {times:.2} times what is promised"
                ));
            }
            if figures.relative > 4.0 * before.max(ROUNDING) {
                let now = figures.relative;
                faults.push(format!(
                    "{case:?}, {direction}: {now:.1e}, was {before:.1e}"
                ));
            }
        }
    }
    assert_eq!(
        table.len(),
        cases.len(),
        "the table has cases that are gone; run `cargo xtask numerics`"
    );
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn every_case_keeps_the_promise_on_every_device() {
    let mut faults = Vec::new();
    for (name, device) in devices() {
        for case in cases() {
            let row = measure(&case, &Place::Device(device.clone()));
            for (direction, figures) in [("forward", row.forward), ("backward", row.backward)] {
                if figures.of_promise > 1.0 {
                    faults.push(format!(
                        "{name}, {case:?}, {direction}: {:.2} times what is promised, {:.1e} of the largest",
                        figures.of_promise, figures.relative
                    ));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn what_is_done_for_stability_does_something() {
    for m in measures() {
        let limit = match m.place {
            // The exponential is there for speed: it may be worse than the library's, but not by much.
            "splatting, inner loops" => 4.0 * m.without,
            // A gradient that counts as 1e15 costs a third of the way.
            "Adam" => 0.5 * m.without,
            // Without, nothing comes out that is usable at all.
            _ if m.without.is_nan() => 1e-6,
            _ => 0.1 * m.without,
        };
        assert!(
            m.with.is_finite() && m.with <= limit,
            "{m:?}: more than {limit:e}"
        );
    }
}
