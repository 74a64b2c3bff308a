//! docs/NUMERICS.md: written by `cargo xtask numerics`, read back by the test that guards it.

use super::case::Row;
use super::stability::Measure;
use std::collections::BTreeMap;
use std::fmt::Write as _;

const HEAD: &str = "\
# What f32 costs

Made by `cargo xtask numerics`; a test fails where a figure gets worse than here by more than a factor of 4.

Each op runs in f32, as in training, and in f64, on the same input.
*Absolute* is the largest error of any entry of any output (forward) or gradient (backward).
*Relative* is the largest error of an array over that array's largest entry (or over 1e-6, where all entries are smaller); 1.2e-7 is one unit in the last place.
*Of the promise* is the largest error as a share of what is promised: 8 times the spread of the f64 result when every input moves by one unit in the last place of f32, plus 1e-6 of the array's largest entry or of 1, whichever is larger.
Where that is far under 1 although the error is large, the input itself says no more: a mean at 1e6 is known to 0.06 units before any arithmetic.
";

const TABLE: &str = "
| case | forward, absolute | relative | of the promise | backward, absolute | relative | of the promise |
|---|---|---|---|---|---|---|
";

const STABILITY: &str = "
## What is done for it

Each is measured in f32 with and without; the error is against f64.

| where | what | without | with |
|---|---|---|---|
";

/// The report of all cases, in Markdown.
#[must_use]
pub fn report(rows: &[Row], measures: &[Measure]) -> String {
    let mut text = HEAD.to_owned();
    let mut op = "";
    for row in rows {
        if row.op != op {
            op = &row.op;
            write!(text, "\n## {op}\n{TABLE}").expect("writing to a string");
        }
        write!(text, "| {} |", row.name).expect("writing to a string");
        for figures in [row.forward, row.backward] {
            let cells = [figures.absolute, figures.relative, figures.of_promise];
            for value in cells {
                write!(text, " {value:.1e} |").expect("writing to a string");
            }
        }
        text.push('\n');
    }
    text.push_str(STABILITY);
    for m in measures {
        let error = |e: f64| {
            if e.is_finite() {
                format!("{e:.1e}")
            } else {
                "not a number".to_owned()
            }
        };
        let (without, with) = (error(m.without), error(m.with));
        writeln!(text, "| {} | {} | {without} | {with} |", m.place, m.what)
            .expect("writing to a string");
    }
    text
}

/// The relative errors, forward and backward, of every case of a report, by op and case.
///
/// # Panics
/// Panics, naming the line, if a row of a table is not as [`report`] writes it.
#[must_use]
pub fn read_table(text: &str) -> BTreeMap<(String, String), [f64; 2]> {
    let mut op = "";
    let mut rows = BTreeMap::new();
    let tables = text
        .split("\n## What is done for it")
        .next()
        .unwrap_or(text);
    for line in tables.lines() {
        if let Some(title) = line.strip_prefix("## ") {
            op = title;
        }
        let is_row = line.starts_with("| ") && !line.starts_with("| case |");
        if is_row {
            let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
            let number = |k: usize| -> f64 {
                let cell: Option<&&str> = cells.get(k);
                let value = cell.and_then(|c| c.parse().ok());
                value.unwrap_or_else(|| panic!("no number in column {k} of: {line}"))
            };
            rows.insert((op.to_owned(), cells[0].to_owned()), [number(2), number(5)]);
        }
    }
    rows
}
