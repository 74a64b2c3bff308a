//! A word where a test could not run.

use std::io::{self, Write as _};

/// Says that a test could not run and why: past the test harness, which keeps what a passing test prints.
pub(crate) fn skipped(test: &str, why: &str) -> io::Result<()> {
    let line = format!("skipped: {test}: {why}\n");
    io::stderr().write_all(line.as_bytes())
}
