//! What can go wrong in the laboratory itself. (A run that dies is no error: it is reported, and the study goes on.)

use std::io;
use std::path::{Path, PathBuf};

/// An error of the laboratory.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LabError {
    /// A file or folder cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// A study's file says something that cannot be.
    #[error("{}: {}{problem}", path.display(), named(key))]
    Study {
        /// The file.
        path: PathBuf,
        /// The key, such as `variants[1].set`; empty where none is at fault.
        key: String,
        /// What is wrong with it, and what to do.
        problem: String,
    },
    /// A file that the laboratory or the program wrote is not what it should be.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// What was asked for cannot be done.
    #[error("{0}")]
    Asked(String),
}

fn named(key: &str) -> String {
    if key.is_empty() {
        String::new()
    } else {
        format!("`{key}`: ")
    }
}

impl LabError {
    /// For `map_err` of what was done with a file.
    pub fn file(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::File { path, source }
    }

    pub(crate) fn content(path: &Path, problem: impl ToString) -> Self {
        Self::Content {
            path: path.to_owned(),
            problem: problem.to_string(),
        }
    }
}
