//! What asks programs for their end: Ctrl-C, a request of the system, a terminal that closes.
//!
//! ```
//! use std::sync::Arc;
//! use std::sync::atomic::{AtomicBool, Ordering};
//!
//! let asked = Arc::new(AtomicBool::new(false));
//! let heard = asked.clone();
//! signals::on_end(move || heard.store(true, Ordering::Relaxed))?;
//! // From here on the work looks at `asked`, saves what it has, and ends.
//! assert!(!asked.load(Ordering::Relaxed));
//! # Ok::<(), std::io::Error>(())
//! ```

use std::io;

/// Calls `heard`, in a thread of its own, at every Ctrl-C (SIGINT), SIGTERM and SIGHUP from now on, in the place of an end. But
/// SIGHUP stays ignored where whoever started the program has it ignored, as `nohup` does; that is known on Linux alone.
///
/// # Errors
/// The system does not let the program listen.
#[cfg(unix)]
pub fn on_end(heard: impl Fn() + Send + 'static) -> io::Result<()> {
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let outlives_its_terminal = ignores(&status, SIGHUP);
    // Scripts let what they leave in the background ignore SIGINT, too; but who sends that by `kill` wants an end.
    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM])?;
    if !outlives_its_terminal {
        signals.add_signal(SIGHUP)?;
    }
    std::thread::Builder::new().spawn(move || signals.forever().for_each(|_| heard()))?;
    Ok(())
}

/// The same where there are no such signals, by what the system has in their place.
///
/// # Errors
/// The system does not let the program listen.
#[cfg(not(unix))]
pub fn on_end(heard: impl Fn() + Send + 'static) -> io::Result<()> {
    ctrlc::set_handler(heard).map_err(io::Error::other)
}

/// Asks another process for its end, as Ctrl-C does; one that is gone is left alone.
#[cfg(unix)]
pub fn ask_to_end(process: u32) {
    use nix::sys::signal::{Signal, kill};
    use nix::unistd::Pid;
    if let Ok(process) = i32::try_from(process) {
        // Where it has ended by itself, there is nothing to do.
        kill(Pid::from_raw(process), Signal::SIGINT).ok();
    }
}

/// Nothing: here a Ctrl-C reaches all programs of a console.
#[cfg(not(unix))]
pub fn ask_to_end(_: u32) {}

/// Whether a process with such a `/proc/self/status` ignores a signal.
#[cfg(unix)]
fn ignores(status: &str, signal: i32) -> bool {
    let ignored = status
        .lines()
        .find_map(|line| line.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    ignored.is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read_from_the_mask() {
        let status = "Name:\tlimpid\nSigBlk:\t0000000000000002\nSigIgn:\t0000000000001001\n";
        // Of SIGHUP, SIGINT, SIGPIPE and SIGTERM the first and the third.
        let found = [1, 2, 13, 15].map(|signal| ignores(status, signal));
        assert_eq!(found, [true, false, true, false]);
        assert!(!ignores("", 1), "nothing is known");
    }
}
