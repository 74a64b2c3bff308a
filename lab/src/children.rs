//! Processes that this one started, and their end.

use std::collections::BTreeSet;
use std::io;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use wait4::{ResUse, Wait4 as _};

/// How often a process is looked at.
const LOOK: Duration = Duration::from_millis(50);

/// All processes that are running for a study. A Ctrl-C ends them, and starts no more.
#[derive(Debug, Default)]
pub struct Children {
    stopped: AtomicBool,
    running: Mutex<BTreeSet<u32>>,
}

impl Children {
    /// Asks all of them for their end, in which a training writes its checkpoint.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::SeqCst);
        // Under the lock no process is reaped: its number is nobody else's.
        for id in self.lock().iter() {
            signals::ask_to_end(*id);
        }
    }

    /// Whether they were asked for their end.
    #[must_use]
    pub fn are_stopped(&self) -> bool {
        self.stopped.load(Ordering::SeqCst)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, BTreeSet<u32>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs a command to its end, and says what it took; nothing where no more is to be started. `began` is told the process's
    /// number.
    pub(crate) fn run(
        &self,
        command: &mut Command,
        began: impl FnOnce(u32),
    ) -> io::Result<Option<ResUse>> {
        own_group(command);
        let mut child: Child = {
            let mut running = self.lock();
            if self.are_stopped() {
                return Ok(None);
            }
            let child = command.spawn()?;
            running.insert(child.id());
            child
        };
        began(child.id());
        loop {
            {
                let mut running = self.lock();
                let ended = child.try_wait4();
                if !matches!(ended, Ok(None)) {
                    running.remove(&child.id());
                    return ended;
                }
            }
            std::thread::sleep(LOOK);
        }
    }
}

/// A group of its own: a Ctrl-C on the terminal reaches this program alone, which hands it on once.
#[cfg(unix)]
fn own_group(command: &mut Command) {
    use std::os::unix::process::CommandExt as _;
    command.process_group(0);
}

/// Elsewhere the console tells all programs in it.
#[cfg(not(unix))]
fn own_group(_: &mut Command) {}
