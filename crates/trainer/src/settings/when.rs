//! When something is used.

use serde::{Deserialize, Serialize};

/// When something is used that not every scene requires.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum When {
    /// Where the scene requires it.
    #[default]
    Auto,
    /// Always.
    Always,
    /// Never.
    Never,
}

impl When {
    /// Whether it is used where a scene requires it or does not.
    #[must_use]
    pub fn holds(self, required: bool) -> bool {
        match self {
            Self::Auto => required,
            Self::Always => true,
            Self::Never => false,
        }
    }
}
