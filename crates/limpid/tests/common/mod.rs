//! What several of these tests need.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;

/// Copies a folder with everything in it.
pub(crate) fn copy(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}

/// Says that a test could not run and why: past the test harness, which keeps what a passing test prints.
pub(crate) fn skipped(test: &str, why: &str) -> io::Result<()> {
    let line = format!("skipped: {test}: {why}\n");
    io::stderr().write_all(line.as_bytes())
}
