//! `metrics.jsonl`: the course of training, a line now and then.

use crate::failure::Failure;
use crate::say::say;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use trainer::StepReport;

/// Name of the file.
pub(crate) const LOG_FILE: &str = "metrics.jsonl";
/// A run has about so many lines…
const LINES: usize = 200;
/// … and at least so many iterations from one to the next.
const LEAST_ITERATIONS: usize = 5;

/// A line: what happened since the one before.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Line {
    /// The last iteration that counts.
    pub(crate) iteration: usize,
    /// Mean loss; null where it is no number.
    pub(crate) loss: Option<f64>,
    /// Mean of each weighted term of it, over the iterations that had it.
    terms: BTreeMap<String, Option<f64>>,
    /// Mean PSNR of what the camera is said to have seen, dB.
    pub(crate) psnr: Option<f64>,
    /// Number of Gaussians.
    pub(crate) gaussians: usize,
    /// Seconds of training, from the start of the run.
    pub(crate) seconds: f64,
}

/// The log of a run that is being trained.
#[derive(Debug)]
pub(crate) struct Log {
    path: PathBuf,
    file: Option<File>,
    every: usize,
    sums: Sums,
}

/// Sums since the last line.
#[derive(Debug, Default)]
struct Sums {
    loss: Mean,
    psnr: Mean,
    terms: BTreeMap<&'static str, Mean>,
}

#[derive(Debug, Default)]
struct Mean {
    sum: f64,
    count: usize,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    fn value(&self) -> Option<f64> {
        let mean = self.sum / self.count as f64;
        mean.is_finite().then_some(mean)
    }
}

impl Log {
    /// Goes on with the log in a folder, after so many iterations of `iterations`: lines of later ones are removed.
    pub(crate) fn open(out: &Path, iteration: usize, iterations: usize) -> Result<Self, Failure> {
        let path = out.join(LOG_FILE);
        let kept = match std::fs::read(&path) {
            Ok(text) => lines(&text),
            Err(error) if error.kind() == ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(format!("{error}: {}", path.display()).into()),
        };
        let mut text = Vec::new();
        for line in kept.iter().filter(|line| line.iteration <= iteration) {
            serde_json::to_writer(&mut text, line)?;
            text.push(b'\n');
        }
        io::write_atomic(&path, |file| file.write_all(&text))?;
        let file = OpenOptions::new().append(true).open(&path);
        Ok(Self {
            file: Some(file.map_err(|e| format!("{e}: {}", path.display()))?),
            path,
            every: (iterations / LINES).max(LEAST_ITERATIONS),
            sums: Sums::default(),
        })
    }

    /// Takes note of an iteration, after so many seconds of training. What cannot be written is said once, and training goes on.
    pub(crate) fn add(&mut self, report: &StepReport, seconds: f64) {
        self.sums.loss.add(report.loss);
        self.sums.psnr.add(report.psnr);
        for (name, value) in &report.terms {
            self.sums.terms.entry(name).or_default().add(*value);
        }
        if report.iteration.is_multiple_of(self.every) {
            self.write(report, seconds);
        }
    }

    fn write(&mut self, report: &StepReport, seconds: f64) {
        let Sums { loss, psnr, terms } = std::mem::take(&mut self.sums);
        let line = Line {
            iteration: report.iteration,
            loss: loss.value(),
            terms: terms
                .into_iter()
                .map(|(name, mean)| (name.to_owned(), mean.value()))
                .collect(),
            psnr: psnr.value(),
            gaussians: report.gaussians,
            seconds,
        };
        let Some(file) = &mut self.file else {
            return;
        };
        let written = serde_json::to_string(&line).map_err(Into::into);
        // In one piece, so that another reader sees whole lines.
        if let Err(problem) =
            written.and_then(|text| file.write_all(format!("{text}\n").as_bytes()))
        {
            say!(
                "warning: {problem}: {}; training goes on without it",
                self.path.display()
            );
            self.file = None;
        }
    }
}

/// The lines of a log up to the first that is not whole; none where there is no log.
pub(crate) fn read(path: &Path) -> Vec<Line> {
    lines(&std::fs::read(path).unwrap_or_default())
}

fn lines(text: &[u8]) -> Vec<Line> {
    text.split(|byte| *byte == b'\n')
        .map_while(|line| serde_json::from_slice(line).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(iteration: usize, loss: f64) -> StepReport {
        StepReport {
            iteration,
            loss,
            terms: vec![("l1", loss / 2.0)],
            psnr: 20.0,
            view: "a".to_owned(),
            gaussians: 7,
            decided: None,
        }
    }

    #[test]
    fn lines_are_means_and_a_resumed_run_cuts_what_it_repeats() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(LOG_FILE);
        let mut log = Log::open(folder.path(), 0, 2000).unwrap();
        for it in 1..=30 {
            log.add(&report(it, it as f64), 0.5 * it as f64);
        }
        let lines = read(&path);
        let figures: Vec<_> = lines
            .iter()
            .map(|l| (l.iteration, l.loss, l.seconds))
            .collect();
        assert_eq!(
            figures,
            [
                (10, Some(5.5), 5.0),
                (20, Some(15.5), 10.0),
                (30, Some(25.5), 15.0)
            ]
        );
        assert_eq!(lines[0].terms["l1"], Some(2.75));

        // Killed while it wrote, with a checkpoint after 20; and a byte that is no text.
        let mut half = std::fs::read(&path).unwrap();
        half.extend(b"{\"iteration\": 40, \"lo\xff");
        std::fs::write(&path, half).unwrap();
        let mut log = Log::open(folder.path(), 20, 2000).unwrap();
        assert_eq!(read(&path), lines[..2]);
        log.add(&report(21, f64::NAN), 10.5);
        log.add(&report(30, 1.0), 15.0);
        let lines = read(&path);
        assert_eq!(
            (lines.len(), lines[2].iteration, lines[2].loss),
            (3, 30, None)
        );
    }

    #[test]
    fn a_folder_without_a_log_has_no_lines() {
        let folder = tempfile::tempdir().unwrap();
        assert!(read(&folder.path().join("none")).is_empty());
    }
}
