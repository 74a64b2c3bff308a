//! Cargo, and how commands are started.

use std::env;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// The checkout that cargo was called in. (Where two of them share a target folder, this program may have been built in the
/// other.)
pub(crate) fn root() -> PathBuf {
    let here =
        env::var_os("CARGO_MANIFEST_DIR").unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    let root = Path::new(&here).parent();
    root.expect("xtask lies in the workspace's root").to_owned()
}

/// The cargo that started this program.
pub(crate) fn cargo() -> Command {
    Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
}

pub(crate) fn cargo_in_root(args: &[&str]) -> Command {
    let mut command = cargo();
    command.args(args).current_dir(root());
    command
}

/// Runs a step of several; the exit code of a failed one comes back as an error.
pub(crate) fn wait(mut command: Command) -> Result<(), ExitCode> {
    match command.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(exit_code(status.code())),
        Err(error) => Err(could_not_start(&command, &error)),
    }
}

/// Runs the last command there is by becoming it, as `cargo run` itself does: a Ctrl-C then reaches
/// the program alone, which ends when its checkpoint is written, and not before.
#[cfg(unix)]
pub(crate) fn become_command(mut command: Command) -> ExitCode {
    use std::os::unix::process::CommandExt as _;
    let error = command.exec();
    could_not_start(&command, &error)
}

/// Without `exec`, waits for the child; cargo shields itself from Ctrl-C and waits on its own.
#[cfg(not(unix))]
pub(crate) fn become_command(command: Command) -> ExitCode {
    wait(command).map_or_else(|code| code, |()| ExitCode::SUCCESS)
}

pub(crate) fn exit_code(code: Option<i32>) -> ExitCode {
    // A child that a signal ended has no code.
    ExitCode::from(code.and_then(|code| u8::try_from(code).ok()).unwrap_or(1))
}

pub(crate) fn could_not_start(command: &Command, error: &std::io::Error) -> ExitCode {
    eprintln!(
        "xtask: cannot start {}: {error}",
        command.get_program().display()
    );
    ExitCode::FAILURE
}
