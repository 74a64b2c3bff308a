//! What ends the program.

use std::error::Error;

pub(crate) use trainer::with_causes;

/// A message for the user.
pub(crate) type Failure = Box<dyn Error>;
