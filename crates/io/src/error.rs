//! What can be wrong with files.

use std::path::{Path, PathBuf};

/// Why a file or a scene could not be read or written. Every message ends with the path.
#[derive(Debug, thiserror::Error)]
pub enum IoError {
    /// The operating system refused to read or write.
    #[error("cannot access {}", path.display())]
    Access {
        /// What the system said.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },

    /// The folder is no scene that this crate knows.
    #[error("not a scene: {looked_for}: {}", path.display())]
    Unrecognised {
        /// What was looked for, and what of it is there.
        looked_for: String,
        /// The folder.
        path: PathBuf,
    },

    /// Files are missing that the others ask for.
    #[error("missing {what}; {advice}: {}", path.display())]
    Missing {
        /// What is missing, by name.
        what: String,
        /// What to do about it.
        advice: String,
        /// Where it should be.
        path: PathBuf,
    },

    /// Names in two places do not fit together.
    #[error("names do not match: {difference}: {}", path.display())]
    Names {
        /// The difference of the two sets, both ways.
        difference: String,
        /// The file or folder that disagrees.
        path: PathBuf,
    },

    /// The header promises more than the file holds, or the file ends too early.
    #[error("truncated, or its header is wrong: {what}: {}", path.display())]
    Truncated {
        /// What was promised and what is there.
        what: String,
        /// The file.
        path: PathBuf,
    },

    /// The content is not what the format says.
    #[error("malformed: {what}: {}", path.display())]
    Malformed {
        /// What is wrong, and where.
        what: String,
        /// The file.
        path: PathBuf,
    },

    /// JSON that is broken, or that holds something else than what is read from it.
    #[error("line {line}, column {column}{}: {problem}: {}", at_key(key), path.display())]
    Json {
        /// The field, such as `frames[3].time`; empty where it is the whole.
        key: String,
        /// What is wrong with it.
        problem: String,
        /// The line, counted from 1.
        line: usize,
        /// The column, counted from 1.
        column: usize,
        /// The file.
        path: PathBuf,
    },

    /// A picture or an array has another size than what it belongs to.
    #[error("{what} has size {found}, expected {expected}: {}", path.display())]
    Size {
        /// What has the wrong size.
        what: String,
        /// The size found, width x height.
        found: String,
        /// The size expected, width x height.
        expected: String,
        /// The file.
        path: PathBuf,
    },

    /// Not a number where one is needed.
    #[error("{what} is not a number; {advice}: {}", path.display())]
    NotANumber {
        /// Where: which value of what.
        what: String,
        /// What to do about it, in this kind of file.
        advice: &'static str,
        /// The file.
        path: PathBuf,
    },

    /// A camera with lens distortion, where it is to be refused.
    #[error(
        "camera model {model} moves pixels by up to {pixels:.2} px, and distortion is to be refused; \
         undistort the images first (for example by `colmap image_undistorter`), or leave \
         `--distortion refuse` out, and it is undone on loading: {}",
        path.display()
    )]
    Distortion {
        /// The camera model's name in the file.
        model: String,
        /// Largest displacement over the image against the pinhole with the same focal length, px.
        pixels: f64,
        /// The file with the cameras.
        path: PathBuf,
    },

    /// Masks say that something moves, and no tracks say how.
    #[error(
        "there are dynamic masks ({}) but no tracks; add tracks, or train without them by \
         `limpid train --static`, which ignores the masks: {}", masks.display(), tracks.display()
    )]
    MasksWithoutTracks {
        /// The masks.
        masks: PathBuf,
        /// Where the tracks should be.
        tracks: PathBuf,
    },

    /// What the caller asked for makes no sense.
    #[error("{what}: {}", path.display())]
    Invalid {
        /// What is wrong with the request.
        what: String,
        /// The file or scene it was about.
        path: PathBuf,
    },
}

impl IoError {
    pub(crate) fn access(path: &Path, source: std::io::Error) -> Self {
        Self::Access {
            source,
            path: path.into(),
        }
    }

    pub(crate) fn missing(path: &Path, what: impl Into<String>, advice: impl Into<String>) -> Self {
        Self::Missing {
            what: what.into(),
            advice: advice.into(),
            path: path.into(),
        }
    }

    pub(crate) fn names(path: &Path, difference: impl Into<String>) -> Self {
        Self::Names {
            difference: difference.into(),
            path: path.into(),
        }
    }

    pub(crate) fn truncated(path: &Path, what: impl Into<String>) -> Self {
        Self::Truncated {
            what: what.into(),
            path: path.into(),
        }
    }

    pub(crate) fn malformed(path: &Path, what: impl Into<String>) -> Self {
        Self::Malformed {
            what: what.into(),
            path: path.into(),
        }
    }

    pub(crate) fn invalid(path: &Path, what: impl Into<String>) -> Self {
        Self::Invalid {
            what: what.into(),
            path: path.into(),
        }
    }

    pub(crate) fn not_a_number(path: &Path, what: impl Into<String>, advice: &'static str) -> Self {
        Self::NotANumber {
            what: what.into(),
            advice,
            path: path.into(),
        }
    }

    /// `found` and `expected` are (width, height).
    pub(crate) fn size(
        path: &Path,
        what: impl Into<String>,
        found: (usize, usize),
        expected: (usize, usize),
    ) -> Self {
        Self::Size {
            what: what.into(),
            found: format!("{}x{}", found.0, found.1),
            expected: format!("{}x{}", expected.0, expected.1),
            path: path.into(),
        }
    }
}

/// A field as a part of a sentence.
fn at_key(key: &str) -> String {
    if key.is_empty() {
        return String::new();
    }
    format!(", `{key}`")
}

/// Up to eight names for a message, and how many more there are.
#[must_use]
pub fn list_names<S: AsRef<str>>(names: &[S]) -> String {
    const SHOWN: usize = 8;
    let mut text = names
        .iter()
        .take(SHOWN)
        .map(AsRef::as_ref)
        .collect::<Vec<_>>()
        .join(", ");
    if names.len() > SHOWN {
        text.push_str(&format!(" and {} more", names.len() - SHOWN));
    }
    text
}
