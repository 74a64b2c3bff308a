//! What ends the program.

use std::error::Error;

pub(crate) use trainer::with_causes;

/// A message for the user.
pub(crate) type Failure = Box<dyn Error>;

/// A flag, whether it is given, whether it has an effect, and what it is for.
pub(crate) type Flag<'a> = ((&'a str, bool), (bool, &'a str));

/// An error for a flag that changes nothing of what is asked for.
pub(crate) fn refuse_idle<'a>(flags: impl IntoIterator<Item = Flag<'a>>) -> Result<(), Failure> {
    for ((flag, is_given), (has_effect, what)) in flags {
        if is_given && !has_effect {
            return Err(format!(
                "{flag} is for {what}, and changes nothing of what is asked for; leave it out"
            )
            .into());
        }
    }
    Ok(())
}
