//! Files that are whole or not there.

use crate::error::LabError;
use serde::Serialize;
use std::fs;
use std::path::Path;

/// Writes JSON, whole or not at all.
///
/// # Errors
/// It cannot be written.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), LabError> {
    write_whole(path, &json(path, value)?)
}

/// A value as JSON; `path` is where it is to go.
///
/// # Errors
/// It has no such form.
pub(crate) fn json(path: &Path, value: &impl Serialize) -> Result<String, LabError> {
    let text = serde_json::to_string_pretty(value).map_err(|e| LabError::content(path, e))?;
    Ok(text + "\n")
}

/// Writes a file under another name first: a reader finds all of it or nothing, and what was there stays until then.
///
/// # Errors
/// It cannot be written.
pub fn write_whole(path: &Path, text: &str) -> Result<(), LabError> {
    let half = path.with_extension(format!("{}.tmp", std::process::id()));
    fs::write(&half, text).map_err(LabError::file(&half))?;
    fs::rename(&half, path).map_err(LabError::file(path))
}
