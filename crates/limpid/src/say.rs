//! Messages on standard error.

use std::fmt::Arguments;
use std::io::{Write as _, stderr};

/// Prints a line on standard error, as `eprintln!` does, but never fails: what nobody reads any more, or what a full disk does
/// not take, is lost, and the run goes on.
macro_rules! say {
    ($($text:tt)*) => {
        $crate::say::line(format_args!($($text)*))
    };
}
pub(crate) use say;

/// See [`say!`].
pub(crate) fn line(text: Arguments<'_>) {
    writeln!(stderr().lock(), "{text}").ok();
}
