//! Writing files whole or not at all.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::IoError;

/// Writes a file so that a reader sees the old content or all of the new, never half of it: under a
/// temporary name in the same folder, synced, then renamed. Makes the folder if it is not there.
///
/// # Errors
/// [`IoError::Access`] when the system refuses; the temporary file is removed then.
pub fn write_atomic(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), IoError> {
    write_atomic_keeping(path, None, write)
}

/// The same; the old content is renamed to `kept` once the new one is whole and synced, so that at every moment one of the two is
/// there under one of the two names.
///
/// # Errors
/// As [`write_atomic`].
pub fn write_atomic_keeping(
    path: &Path,
    kept: Option<&Path>,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> Result<(), IoError> {
    let file_name = path
        .file_name()
        .ok_or_else(|| IoError::invalid(path, "cannot write: the path names no file"))?;
    if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
        fs::create_dir_all(folder).map_err(|e| IoError::access(folder, e))?;
    }
    let mut temporary_name = std::ffi::OsString::from(".");
    temporary_name.push(file_name);
    temporary_name.push(format!(".{}.tmp", std::process::id()));
    let temporary = path.with_file_name(temporary_name);

    let whole = || -> std::io::Result<()> {
        let mut out = BufWriter::new(File::create(&temporary)?);
        write(&mut out)?;
        let file = out.into_inner().map_err(|e| e.into_error())?;
        file.sync_all()?;
        if let Some(kept) = kept {
            fs::rename(path, kept)?;
        }
        fs::rename(&temporary, path)
    };
    whole().map_err(|source| {
        // The first error is the one to report; a leftover is only untidy.
        fs::remove_file(&temporary).ok();
        IoError::access(path, source)
    })
}

/// Files in a folder that [`write_atomic`] had begun when its program was killed: `.NAME.PID.tmp`. None where the folder cannot be
/// read.
pub fn unfinished(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| {
        let name = path.file_name().and_then(|name| name.to_str());
        let inner = name.and_then(|name| name.strip_prefix('.')?.strip_suffix(".tmp"));
        let id = inner.and_then(|inner| Some(inner.rsplit_once('.')?.1));
        id.is_some_and(|id| !id.is_empty() && id.bytes().all(|b| b.is_ascii_digit()))
    })
}

/// Writes `value` as indented JSON, atomically (see [`write_atomic`]).
///
/// # Errors
/// [`IoError::Invalid`] when the value has no JSON form, [`IoError::Access`] when the system refuses.
pub fn write_json<T: Serialize>(path: &Path, value: &T) -> Result<(), IoError> {
    let mut text = serde_json::to_vec_pretty(value)
        .map_err(|e| IoError::invalid(path, format!("cannot be written as JSON: {e}")))?;
    text.push(b'\n');
    write_atomic(path, |out| out.write_all(&text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_whole_files_and_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/er/metrics.json");
        write_json(&path, &vec![1, 2]).unwrap();
        write_json(&path, &vec![3]).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(serde_json::from_str::<Vec<i32>>(&text).unwrap(), [3]);

        let failed = write_atomic(&path, |out| {
            out.write_all(b"half")?;
            Err(std::io::Error::other("disk full"))
        });
        assert!(matches!(failed, Err(IoError::Access { .. })), "{failed:?}");
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            text,
            "old content stays"
        );
        let kept = path.with_file_name("kept.json");
        write_atomic_keeping(&path, Some(&kept), |out| out.write_all(b"new")).unwrap();
        let contents = [&path, &kept].map(|path| fs::read_to_string(path).unwrap());
        assert_eq!(contents, ["new".to_owned(), text]);
        fs::remove_file(kept).unwrap();
        let files = fs::read_dir(path.parent().unwrap()).unwrap().count();
        assert_eq!(files, 1, "no temporary file stays");
    }
}
