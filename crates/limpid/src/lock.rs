//! One run at a time in a folder.

use crate::failure::Failure;
use crate::say::say;
use std::fs::{File, Metadata, TryLockError};
use std::path::{Path, PathBuf};

const LOCK_FILE: &str = ".lock";

/// A folder that no other run writes to; free again when this goes, or the program ends, however it does.
#[derive(Debug)]
pub(crate) struct Lock {
    file: File,
    path: PathBuf,
}

impl Lock {
    /// Takes a folder, which must be there, and removes what a run that was killed left half written in it.
    pub(crate) fn of(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(LOCK_FILE);
        let file = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&path);
        let file = file.map_err(|e| format!("{e}: {}", path.display()))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(format!(
                    "another run is writing to {}; wait for it, or stop it; a new run can go to another folder (--out)",
                    folder.display()
                )
                .into());
            }
            // Some file systems have no locks.
            Err(TryLockError::Error(e)) => {
                say!(
                    "note: {e}: {}: two runs into this folder would go unnoticed",
                    path.display()
                );
            }
        }
        for name in [
            "",
            "checkpoint",
            "renders/test",
            "renders/train",
            "renders/blurred",
            "renders",
        ] {
            for leftover in io::unfinished(&folder.join(name)) {
                // What cannot be removed is only untidy.
                std::fs::remove_file(leftover).ok();
            }
        }
        Ok(Self { file, path })
    }

    /// Whether the folder at that path is still the one that was taken: it may have been removed, or moved away, and be another
    /// run's.
    pub(crate) fn holds(&self) -> bool {
        let there = std::fs::metadata(&self.path).ok();
        let own = self.file.metadata().ok();
        matches!((there, own), (Some(there), Some(own)) if is_same(&there, &own))
    }
}

#[cfg(unix)]
fn is_same(one: &Metadata, other: &Metadata) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    (one.dev(), one.ino()) == (other.dev(), other.ino())
}

/// Elsewhere a folder with an open file in it stays where it is.
#[cfg(not(unix))]
fn is_same(_: &Metadata, _: &Metadata) -> bool {
    true
}
