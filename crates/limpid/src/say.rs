//! Messages on standard error and in a log file, and results on standard output.

use crate::failure::Failure;
use crate::version;
use indicatif::ProgressBar;
use std::fmt::Arguments;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, IsTerminal as _, Write as _, stderr, stdout};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::SystemTime;

/// How much is said; arguments of all commands.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Voice {
    /// Say errors and the outcome only.
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
    /// Say what is done in between too: checkpoints, snapshots, how long things take.
    #[arg(short, long, global = true)]
    verbose: bool,
    /// Add all that is said, with --verbose or without, to this file, with the time (UTC).
    #[arg(long, global = true, value_name = "FILE")]
    log: Option<PathBuf>,
}

/// How much a line matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Weight {
    /// Said with --verbose.
    Detail,
    Usual,
    /// Errors and outcomes: with --quiet too.
    Most,
}

/// Prints a line on standard error, as `eprintln!` does, but never fails: what nobody reads any more, or what a full disk does
/// not take, is lost, and the run goes on.
macro_rules! say {
    ($($text:tt)*) => {
        $crate::say::line($crate::say::Weight::Usual, format_args!($($text)*))
    };
}
pub(crate) use say;

/// The same for errors and for what a command came to.
macro_rules! conclude {
    ($($text:tt)*) => {
        $crate::say::line($crate::say::Weight::Most, format_args!($($text)*))
    };
}
pub(crate) use conclude;

/// The same for what only some want to know.
macro_rules! detail {
    ($($text:tt)*) => {
        $crate::say::line($crate::say::Weight::Detail, format_args!($($text)*))
    };
}
pub(crate) use detail;

/// What the program was asked for, if anything.
static ASKED: OnceLock<(Weight, Option<Log>)> = OnceLock::new();
/// The bar on the terminal, which makes room for lines.
static BAR: Mutex<Option<ProgressBar>> = Mutex::new(None);

#[derive(Debug)]
struct Log(Mutex<File>);

impl Log {
    fn open(path: &Path) -> std::io::Result<Self> {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let file = OpenOptions::new().create(true).append(true).open(path)?;
        Ok(Self(Mutex::new(file)))
    }

    #[expect(
        clippy::disallowed_methods,
        reason = "a log tells the time of day, and no result depends on it"
    )]
    fn add(&self, text: Arguments<'_>) {
        let time = humantime::format_rfc3339_seconds(SystemTime::now());
        let mut lines = String::new();
        for line in text.to_string().lines() {
            lines.extend([&time.to_string(), " ", line, "\n"]);
        }
        // In one piece, so that lines of several runs stay whole.
        held(&self.0).write_all(lines.as_bytes()).ok();
    }
}

impl Voice {
    /// From now on all is said so.
    pub(crate) fn set(&self) -> Result<(), Failure> {
        let least = match (self.quiet, self.verbose) {
            (true, _) => Weight::Most,
            (_, true) => Weight::Detail,
            _ => Weight::Usual,
        };
        let log = self
            .log
            .as_deref()
            .map(|path| Log::open(path).map_err(|e| format!("--log: {e}: {}", path.display())));
        let log = log.transpose()?;
        if let Some(log) = &log {
            let words: Vec<_> = std::env::args_os().skip(1).collect();
            log.add(format_args!("limpid {}: {words:?}", version::long()));
        }
        // Asked once, at the start.
        ASKED.set((least, log)).ok();
        Ok(())
    }
}

/// Whether there is a terminal that shows how far things are.
pub(crate) fn shows_bars() -> bool {
    stderr().is_terminal() && least() <= Weight::Usual
}

/// Lines make room for this bar from now on, or for none.
pub(crate) fn set_bar(bar: Option<&ProgressBar>) {
    *held(&BAR) = bar.cloned();
}

/// See [`say!`].
pub(crate) fn line(weight: Weight, text: Arguments<'_>) {
    if weight >= least() {
        let write = || writeln!(stderr().lock(), "{text}").ok();
        let bar = held(&BAR).clone();
        match bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        };
    }
    if let Some((_, Some(log))) = ASKED.get() {
        log.add(text);
    }
}

fn least() -> Weight {
    ASKED.get().map_or(Weight::Usual, |(least, _)| *least)
}

/// What a lock holds; a thread that panicked leaves it as good as it was.
fn held<T>(lock: &Mutex<T>) -> MutexGuard<'_, T> {
    lock.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Prints what the program was called for. A reader who has seen enough is no error.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    match writeln!(stdout().lock(), "{text}") {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(format!("{e}: standard output").into()),
        Ok(()) | Err(_) => Ok(()),
    }
}
