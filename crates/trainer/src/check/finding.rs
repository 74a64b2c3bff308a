//! What was measured, and what it says.

use serde::Serialize;
use std::fmt;

/// What a measure says about the inputs; the worst comes last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Verdict {
    /// They agree.
    Pass,
    /// They hold too little to tell.
    Untold,
    /// They agree badly, and nothing says why: look at them.
    Doubtful,
    /// They cannot be right.
    Wrong,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Pass => "pass",
            Self::Untold => "cannot be told",
            Self::Doubtful => "doubtful",
            Self::Wrong => "wrong",
        })
    }
}

/// One thing that was measured of a scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// What is held against what.
    pub what: &'static str,
    /// What it says.
    pub verdict: Verdict,
    /// The measure, in words, and what to do.
    pub text: String,
}
