//! Ctrl-C: the first asks for an end with a checkpoint; once that is written, a second one ends what is only pictures and scores.
//! And SIGUSR1, which asks for a checkpoint and no end.

use crate::failure::Failure;
use crate::say::say;
use std::process::exit;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit code after Ctrl-C, as shells have it.
pub(crate) const INTERRUPTED: u8 = 130;

/// Whether the user wants an end.
#[derive(Clone, Default)]
pub(crate) struct Stop {
    asked: Arc<AtomicBool>,
    saved: Arc<AtomicBool>,
}

/// What a Ctrl-C does.
#[derive(Debug, PartialEq, Eq)]
enum Answer {
    /// The loop looks at it.
    Noted,
    /// The user is told why nothing ends yet.
    Told(&'static str),
    /// The program ends.
    End,
}

impl Stop {
    /// Listens from now on.
    pub(crate) fn listen() -> Result<Self, Failure> {
        let stop = Self::default();
        let heard = stop.clone();
        signals::on_end(move || match heard.hear() {
            Answer::Noted => {}
            Answer::Told(why) => say!("{why}"),
            Answer::End => exit(INTERRUPTED.into()),
        })?;
        Ok(stop)
    }

    fn hear(&self) -> Answer {
        let again = self.asked.swap(true, Ordering::Relaxed);
        match (self.saved.load(Ordering::Relaxed), again) {
            (false, false) => Answer::Noted,
            (false, true) => Answer::Told("the checkpoint is written first"),
            (true, false) => Answer::Told(
                "pictures and scores are being written; once more ends that, the checkpoint is there",
            ),
            (true, true) => Answer::End,
        }
    }

    /// Whether Ctrl-C was pressed.
    pub(crate) fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// From now on something is lost by an end.
    pub(crate) fn unsaved(&self) {
        self.saved.store(false, Ordering::Relaxed);
    }

    /// From now on nothing is lost by an end.
    pub(crate) fn saved(&self) {
        self.saved.store(true, Ordering::Relaxed);
    }
}

/// Whether the user wants a checkpoint now.
#[derive(Debug, Default)]
pub(crate) struct SaveRequest {
    asked: Arc<AtomicBool>,
}

impl SaveRequest {
    /// Listens for SIGUSR1 from now on; where there is no such signal, nobody asks.
    pub(crate) fn listen() -> Result<Self, Failure> {
        let request = Self::default();
        #[cfg(unix)]
        signal_hook::flag::register(signal_hook::consts::SIGUSR1, request.asked.clone())?;
        Ok(request)
    }

    /// Whether it was asked since this was last looked at.
    pub(crate) fn take(&self) -> bool {
        self.asked.swap(false, Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_ends_before_the_checkpoint_and_pictures_end_at_the_second_time() {
        let stop = Stop::default();
        assert!(!stop.is_asked());
        assert_eq!(stop.hear(), Answer::Noted);
        assert!(stop.is_asked());
        assert!(matches!(stop.hear(), Answer::Told(_)), "not saved yet");
        stop.saved();
        assert_eq!(stop.hear(), Answer::End);

        let evaluating = Stop::default();
        evaluating.saved();
        assert!(matches!(evaluating.hear(), Answer::Told(_)));
        assert_eq!(evaluating.hear(), Answer::End);

        let next_length = Stop::default();
        next_length.saved();
        next_length.unsaved();
        assert_eq!(next_length.hear(), Answer::Noted);
        assert!(matches!(next_length.hear(), Answer::Told(_)));
    }
}
