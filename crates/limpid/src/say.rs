//! Messages on standard error, and results on standard output.

use crate::failure::Failure;
use std::fmt::Arguments;
use std::io::{ErrorKind, Write as _, stderr, stdout};

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

/// Prints what the program was called for. A reader who has seen enough is no error.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    match writeln!(stdout().lock(), "{text}") {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(format!("{e}: standard output").into()),
        Ok(()) | Err(_) => Ok(()),
    }
}
