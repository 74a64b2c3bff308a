//! The rows of a report: what each arm came to on a scene, and what it gains against another with the same seed.

use crate::expand::{Arm, Case};
use crate::report::{Cell, Finished, Row, SceneTable};
use crate::score::Kind;
use crate::statistics::Summary;
use crate::study::Study;
use std::collections::BTreeMap;

/// Runs of a scene, by arm and seed.
type ByArm<'a> = BTreeMap<&'a str, BTreeMap<u64, &'a Finished>>;

/// Those of the finished runs that are of a scene.
pub(crate) fn of_scene<'a>(
    cases: &'a [Case],
    finished: &'a BTreeMap<&str, Finished>,
    scene: &str,
) -> ByArm<'a> {
    let mut all = ByArm::new();
    for case in cases.iter().filter(|case| case.scene == scene) {
        let seeds = all.entry(&case.arm).or_default();
        if let Some(run) = finished.get(case.run.id.as_str()) {
            seeds.insert(case.seed, run);
        }
    }
    all
}

/// A row for every arm that is run on a scene.
pub(crate) fn rows(study: &Study, arms: &[Arm], all: &ByArm<'_>) -> Vec<Row> {
    let values = |arm: Option<&str>, score: usize| -> BTreeMap<u64, f64> {
        let seeds = arm.and_then(|arm| all.get(arm)).into_iter().flatten();
        seeds
            .filter_map(|(seed, run)| Some((*seed, run.figures[score]?)))
            .collect()
    };
    let cell = |arm: &Arm, score: usize| {
        let here = values(Some(&arm.name), score);
        let there = values(arm.against.as_deref(), score);
        let from = values(Some(study.baseline()), score);
        let to = values(study.bound.as_deref(), score);
        let kind = study.score[score].kind();
        let is_way = kind == Kind::Quality && arm.name != study.baseline();
        Cell {
            mean: Summary::of(&Vec::from_iter(here.values().copied())),
            gain: gain(kind, &here, &there),
            closed: is_way.then(|| closed(&here, &from, &to)).flatten(),
            values: here,
        }
    };
    arms.iter()
        .filter_map(|arm| {
            let runs = all.get(arm.name.as_str())?;
            // The share of the way to the bound begins at the baseline.
            let from = study.bound.is_some().then(|| study.baseline());
            let others = [arm.against.as_deref(), study.bound.as_deref(), from];
            let mut others = others
                .into_iter()
                .flatten()
                .filter_map(|name| all.get(name));
            let cells = (0..study.score.len()).map(|score| cell(arm, score));
            let of_program = |(seed, run): (&u64, &&Finished)| Some((*seed, run.program.clone()?));
            Some(Row {
                programs: runs.iter().filter_map(of_program).collect(),
                is_mixed: others.any(|other| is_mixed(runs, other)),
                ..row(arm, 1, runs.len(), cells.collect())
            })
        })
        .collect()
}

fn row(arm: &Arm, scenes: usize, runs: usize, cells: Vec<Cell>) -> Row {
    Row {
        arm: arm.name.clone(),
        asks: arm.asks(),
        against: arm.against.clone(),
        knob: arm.knob.clone(),
        is_given_truth: arm.is_given_truth(),
        is_perturbed: arm.is_perturbed(),
        scenes,
        runs,
        programs: BTreeMap::new(),
        is_mixed: false,
        cells,
    }
}

/// Whether two runs with the same seed may be of two programs.
fn is_mixed(here: &BTreeMap<u64, &Finished>, there: &BTreeMap<u64, &Finished>) -> bool {
    here.iter().any(|(seed, run)| {
        let other = there.get(seed);
        other.is_some_and(|other| run.program.is_none() || run.program != other.program)
    })
}

/// The gain of `here` against `there`, over the seeds that both have.
fn gain(kind: Kind, here: &BTreeMap<u64, f64>, there: &BTreeMap<u64, f64>) -> Option<Summary> {
    let pairs = here.iter().filter_map(|(seed, a)| {
        let b = there.get(seed)?;
        match kind {
            Kind::Quality | Kind::Finding => Some(a - b),
            Kind::Cost => (*b > 0.0).then(|| a / b),
        }
    });
    Summary::of(&pairs.collect::<Vec<_>>())
}

/// The share of the way between two arms, over the seeds that all three have; none where that way is not clear of zero, which a share
/// would divide by.
fn closed(
    here: &BTreeMap<u64, f64>,
    from: &BTreeMap<u64, f64>,
    to: &BTreeMap<u64, f64>,
) -> Option<Summary> {
    let ways: Vec<(f64, f64)> = here
        .iter()
        .filter_map(|(seed, here)| {
            let from = from.get(seed)?;
            Some((here - from, to.get(seed)? - from))
        })
        .collect();
    let whole = Summary::of(&Vec::from_iter(ways.iter().map(|(_, whole)| *whole)))?;
    let is_way = whole.mean > 0.0 && (whole.standard_error.is_none() || whole.is_clear());
    let shares = ways.iter().map(|(part, whole)| part / whole);
    is_way
        .then(|| Summary::of(&shares.collect::<Vec<_>>()))
        .flatten()
}

/// Means over scenes of what was gained on each.
pub(crate) fn overall(arms: &[Arm], scenes: &[SceneTable], scores: usize) -> Vec<Row> {
    let mut all = Vec::new();
    for arm in arms {
        let found = scenes.iter().flat_map(|table| &table.rows);
        let found: Vec<&Row> = found.filter(|row| row.arm == arm.name).collect();
        let cell = |score: usize| {
            let over = |of: fn(&Cell) -> Option<Summary>| {
                let parts = found.iter().filter_map(|row| of(&row.cells[score]));
                Summary::over(&parts.collect::<Vec<_>>())
            };
            Cell {
                values: BTreeMap::new(),
                mean: over(|cell| cell.mean),
                gain: over(|cell| cell.gain),
                closed: over(|cell| cell.closed),
            }
        };
        let cells = (0..scores).map(cell).collect();
        let with_runs = found.iter().filter(|row| row.runs > 0).count();
        let runs = found.iter().map(|row| row.runs).sum();
        all.push(Row {
            is_mixed: found.iter().any(|row| row.is_mixed),
            ..row(arm, with_runs, runs, cells)
        });
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(values: &[(u64, f64)]) -> BTreeMap<u64, f64> {
        values.iter().copied().collect()
    }

    #[test]
    fn gains_are_paired_by_seed() {
        // Seeds differ by 10, the gain hardly: its error is that of the differences 1.0 and 1.2.
        let here = map(&[(1, 21.0), (2, 31.2), (4, 99.0)]);
        let there = map(&[(1, 20.0), (2, 30.0), (3, 0.0)]);
        let found = gain(Kind::Quality, &here, &there).expect("two pairs");
        assert_eq!(found.count, 2);
        assert!((found.mean - 1.1).abs() < 1e-12);
        assert!((found.standard_error.expect("two") - 0.1).abs() < 1e-12);
        let times = gain(Kind::Cost, &here, &there).expect("two pairs");
        assert!((times.mean - (1.05 + 1.04) / 2.0).abs() < 1e-12);
        assert_eq!(gain(Kind::Quality, &here, &map(&[(3, 1.0)])), None);
    }

    #[test]
    fn a_share_needs_a_way_to_be_a_share_of() {
        let from = map(&[(1, 20.0), (2, 20.0)]);
        let to = map(&[(1, 30.0), (2, 40.0)]);
        let found = closed(&map(&[(1, 25.0), (2, 35.0)]), &from, &to).expect("a way");
        assert!((found.mean - 0.625).abs() < 1e-12);
        let found = closed(&from, &from, &to).expect("a way");
        assert_eq!(found.mean, 0.0);
        let flat = map(&[(1, 20.1), (2, 19.95)]);
        assert_eq!(
            closed(&to, &from, &flat),
            None,
            "inside two standard errors"
        );
        assert_eq!(closed(&to, &to, &from), None, "the wrong way");
        assert_eq!(closed(&to, &from, &BTreeMap::new()), None, "no bound yet");
    }
}
