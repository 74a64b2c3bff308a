//! What a run was made on.

use serde::{Deserialize, Serialize};
use std::fs;

/// A machine, without its name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Machine {
    /// The processor.
    pub processor: String,
    /// Threads that it runs at once.
    pub cores: usize,
}

impl Machine {
    /// This one.
    #[must_use]
    pub fn here() -> Self {
        let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        Self {
            processor: model(&info).unwrap_or(std::env::consts::ARCH).to_owned(),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
        }
    }
}

/// The processor of all of some machines; `None` of none, and where they are of several kinds.
pub(crate) fn only_processor<'a>(
    machines: impl IntoIterator<Item = &'a Machine>,
) -> Option<String> {
    let mut all = machines.into_iter().map(|machine| &machine.processor);
    let first = all.next()?;
    all.all(|other| other == first).then(|| first.clone())
}

fn model(cpuinfo: &str) -> Option<&str> {
    let line = cpuinfo
        .lines()
        .find(|line| line.starts_with("model name"))?;
    Some(line.split_once(':')?.1.trim())
}

/// A moment in seconds since 1970 as a date, such as 2026-02-28 (UTC).
///
/// Hinnant, "chrono-compatible low-level date algorithms", `civil_from_days`.
pub(crate) fn date(unix_seconds: u64) -> String {
    let day = unix_seconds / 86_400 + 719_468;
    let (era, of_era) = (day / 146_097, day % 146_097);
    let year = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let shifted = (5 * of_year + 2) / 153;
    let day = of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 {
        shifted + 3
    } else {
        shifted - 9
    };
    let year = 400 * era + year + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates() {
        for (seconds, expected) in [
            (0, "1970-01-01"),
            (951_782_399, "2000-02-28"),
            (951_782_400, "2000-02-29"),
            (951_868_800, "2000-03-01"),
            (1_767_225_599, "2025-12-31"),
            (1_767_225_600, "2026-01-01"),
            (4_107_542_400, "2100-03-01"),
        ] {
            assert_eq!(date(seconds), expected);
        }
    }

    #[test]
    fn a_processor_has_a_name() {
        let info = "processor\t: 0\nmodel name\t: A Chip 3000\nmodel\t\t: 1\n";
        assert_eq!(model(info), Some("A Chip 3000"));
        assert_eq!(model("Processor: x"), None);
        assert!(!Machine::here().processor.is_empty());
        assert!(Machine::here().cores > 0);
    }
}
