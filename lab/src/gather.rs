//! Makes the report of a study, as far as its runs are there.

use crate::error::LabError;
use crate::execute::{Record, is_finished};
use crate::expand::{arms, cases};
use crate::kept::Kept;
use crate::machine::date;
use crate::plan::{Places, Program};
use crate::report::{FailedRun, Finished, Origin, Report, SceneTable};
use crate::rows::{of_scene, overall, rows};
use crate::score::Score;
use crate::study::Study;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Reads what is there of a study; what is not there is taken from an earlier report of it.
///
/// # Errors
/// The study cannot be expanded, or a file of a run cannot be read.
pub fn gather(
    study: (&str, &Study, &Path),
    program: &Program,
    places: &Places,
    kept: Option<&Kept>,
) -> Result<Report, LabError> {
    let (name, study, path) = study;
    let cases = cases(study, path, &program.fingerprint)?;
    let mut origin = Origin {
        version: program.version.clone(),
        commit: program.commit.clone(),
        changed: program.changed,
        fingerprint: (program.changed || program.commit.is_none())
            .then(|| program.fingerprint.clone()),
        dates: None,
        machines: Vec::new(),
    };
    let (mut days, mut machines, mut failed) = (BTreeSet::new(), BTreeSet::new(), Vec::new());
    let mut finished: BTreeMap<&str, Finished> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    // What made the runs that stand here by the earlier report alone.
    let mut taken = BTreeSet::new();
    for case in &cases {
        let id = case.run.id.as_str();
        if !seen.insert(id) {
            continue;
        }
        let folder = places.runs().join(id);
        let record = Record::read(&folder)?;
        for attempt in &record.attempts {
            days.insert(date(attempt.began));
            machines.insert(attempt.machine.clone());
        }
        if is_finished(&folder) {
            let metrics = read_metrics(&folder.join("metrics.json"))?;
            let measured = record.measured();
            let of = |score: &Score| score.of(&metrics, measured.as_ref());
            let run = Finished {
                figures: study.score.iter().map(of).collect(),
                program: Some(origin.program()),
                processor: record.processor(),
            };
            finished.insert(id, run);
        } else if let Some(earlier) = kept.and_then(|kept| kept.finished(case, &study.score)) {
            taken.insert(earlier.program.clone());
            finished.insert(id, earlier);
        } else if let Some(how) = record.attempts.last().and_then(|a| a.failed.clone()) {
            failed.push(FailedRun {
                scene: case.scene.clone(),
                arm: case.arm.clone(),
                seed: case.seed,
                run: id.to_owned(),
                failed: how,
            });
        }
    }
    let mut earlier = Vec::new();
    // A run of which that report does not say what made it may be of any of its programs.
    let is_taken = |of: &&Origin| {
        let mut taken = taken.iter();
        taken.any(|made: &Option<String>| made.as_ref().is_none_or(|made| *made == of.program()))
    };
    let origins = kept.iter().flat_map(|kept| kept.origins());
    for kept in origins.filter(is_taken) {
        if kept.program() == origin.program() {
            days.extend(
                kept.dates
                    .iter()
                    .flat_map(|(first, last)| [first, last])
                    .cloned(),
            );
            machines.extend(kept.machines.iter().cloned());
        } else {
            earlier.push(kept.clone());
        }
    }
    origin.dates = days.first().cloned().zip(days.last().cloned());
    origin.machines = machines.into_iter().collect();
    if origin.dates.is_none()
        && let Some(last) = earlier.pop()
    {
        // None of them is of the program that would run now.
        origin = last;
    }
    let arms = arms(study, path)?;
    let table = |scene: &String| SceneTable {
        scene: scene.clone(),
        rows: rows(study, &arms, &of_scene(&cases, &finished, scene)),
    };
    let mut scenes: Vec<SceneTable> = study.scenes.iter().map(table).collect();
    if earlier.is_empty() {
        // All runs are of one program, which stands at the head.
        let rows = scenes.iter_mut().flat_map(|table| &mut table.rows);
        rows.for_each(|row| row.programs.clear());
    }
    let processors = finished.values().map(|run| run.processor.as_ref());
    if processors.collect::<BTreeSet<_>>().len() < 2 {
        // All runs are of one kind, which stands at the head.
        let rows = scenes.iter_mut().flat_map(|table| &mut table.rows);
        rows.for_each(|row| row.processors.clear());
    }
    Ok(Report {
        study: name.to_owned(),
        title: study.title.clone(),
        about: study.about.trim().to_owned(),
        origin,
        earlier,
        planned: seen.len(),
        finished: finished.len(),
        failed,
        seeds: study.seeds.clone(),
        baseline: study.baseline().to_owned(),
        bound: study.bound.clone(),
        scores: study.score.clone(),
        overall: overall(&arms, &scenes, study.score.len()),
        scenes,
    })
}

fn read_metrics(path: &Path) -> Result<Value, LabError> {
    let text = fs::read(path).map_err(LabError::file(path))?;
    serde_json::from_slice(&text).map_err(|e| LabError::content(path, e))
}

#[cfg(test)]
mod tests;
