//! What ends the program.

use std::error::Error;

/// A message for the user.
pub(crate) type Failure = Box<dyn Error>;

/// An error and what caused it, on one line.
pub(crate) fn with_causes(error: &dyn Error) -> String {
    let causes = std::iter::successors(Some(error), |&e| e.source());
    causes
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(": ")
}
