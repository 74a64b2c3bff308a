//! Runs that an earlier report of a study holds, so that their folders need not be there any more.

use crate::error::LabError;
use crate::expand::Case;
use crate::machine::only_processor;
use crate::report::{Finished, Origin, Report, Row};
use crate::score::Score;
use crate::study::Study;
use std::fs;
use std::path::Path;

/// An earlier report of a study.
#[derive(Clone, Debug)]
pub struct Kept {
    report: Report,
}

impl Kept {
    /// Reads `STUDY.json`.
    ///
    /// # Errors
    /// It cannot be read, is no report, is of another study, or lacks a score that the study asks for now.
    pub fn read(path: &Path, name: &str, study: &Study) -> Result<Self, LabError> {
        let text = fs::read(path).map_err(LabError::file(path))?;
        let report: Report =
            serde_json::from_slice(&text).map_err(|e| LabError::content(path, e))?;
        if report.study != name {
            let problem = format!("it is a report of `{}`, not of `{name}`", report.study);
            return Err(LabError::content(path, problem));
        }
        if let Some(score) = study.score.iter().find(|s| !report.scores.contains(s)) {
            let problem = format!(
                "its runs have no `{}`, which the study scores",
                score.name()
            );
            return Err(LabError::content(path, problem));
        }
        Ok(Self { report })
    }

    /// Whether it holds a run that asked for the same as this one.
    #[must_use]
    pub fn holds(&self, case: &Case) -> bool {
        let has_seed = |row: &Row| row.cells.iter().any(|c| c.values.contains_key(&case.seed));
        self.row(case).is_some_and(has_seed)
    }

    /// That run.
    pub(crate) fn finished(&self, case: &Case, scores: &[Score]) -> Option<Finished> {
        let row = self.row(case).filter(|_| self.holds(case))?;
        let of = |score: &Score| {
            let column = self.report.scores.iter().position(|s| s == score)?;
            row.cells.get(column)?.values.get(&case.seed).copied()
        };
        let program = row.programs.get(&case.seed).cloned();
        // Reports of one program do not say it of every run.
        let only = || {
            let is_only = self.report.earlier.is_empty();
            is_only.then(|| self.report.origin.program())
        };
        let program = program.or_else(only);
        let processor = row.processors.get(&case.seed).cloned();
        Some(Finished {
            figures: scores.iter().map(of).collect(),
            processor: processor.or_else(|| self.processor(program.as_deref())),
            program,
        })
    }

    /// The processor of all runs of a program, of all programs where it is not known.
    fn processor(&self, program: Option<&str>) -> Option<String> {
        let origins = self.origins();
        let origins = origins.filter(|of| program.is_none_or(|program| of.program() == program));
        only_processor(origins.flat_map(|of| &of.machines))
    }

    /// What made its runs, the latest last.
    pub(crate) fn origins(&self) -> impl Iterator<Item = &Origin> {
        let all = self.report.earlier.iter().chain([&self.report.origin]);
        all.filter(|origin| origin.dates.is_some())
    }

    fn row(&self, case: &Case) -> Option<&Row> {
        let mut scenes = self.report.scenes.iter();
        let table = scenes.find(|table| table.scene == case.scene)?;
        let mut rows = table.rows.iter();
        // Whatever it is called: what its runs are told is the same.
        rows.find(|row| row.asks == case.asks)
    }
}
