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
    let cell = |arm: &Arm, score: usize, elsewhere: bool| {
        let here = values(Some(&arm.name), score);
        let there = values(arm.against.as_deref(), score);
        let from = values(Some(study.baseline()), score);
        let to = values(study.bound.as_deref(), score);
        let (kind, least) = (study.score[score].kind(), study.score[score].least_way());
        let is_way = kind == Kind::Quality && arm.name != study.baseline();
        Cell {
            mean: Summary::of(&Vec::from_iter(here.values().copied())),
            gain: gain(kind, &here, &there),
            is_elsewhere: elsewhere && kind == Kind::Cost,
            closed: is_way.then(|| closed(&here, &from, &to, least)).flatten(),
            values: here,
            over: None,
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
            let against = arm.against.as_deref().and_then(|name| all.get(name));
            let elsewhere =
                against.is_some_and(|other| may_differ(runs, other, |run| run.processor.as_ref()));
            let cells = (0..study.score.len()).map(|score| cell(arm, score, elsewhere));
            let by_seed = |of: fn(&Finished) -> Option<&String>| {
                let known = runs.iter();
                let known = known.filter_map(|(seed, run)| Some((*seed, of(run)?.clone())));
                known.collect()
            };
            Some(Row {
                programs: by_seed(|run| run.program.as_ref()),
                processors: by_seed(|run| run.processor.as_ref()),
                is_mixed: others.any(|other| may_differ(runs, other, |run| run.program.as_ref())),
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
        processors: BTreeMap::new(),
        is_mixed: false,
        cells,
    }
}

/// Whether two runs with the same seed may be of two programs, or whatever else is asked of each.
fn may_differ(
    here: &BTreeMap<u64, &Finished>,
    there: &BTreeMap<u64, &Finished>,
    of: fn(&Finished) -> Option<&String>,
) -> bool {
    here.iter().any(|(seed, run)| {
        let other = there.get(seed);
        other.is_some_and(|other| of(run).is_none() || of(run) != of(other))
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

/// The share of the way between two arms, a mean over the seeds that all three have. None where that way is on average less than
/// `least`, or with one of the seeds half of the average or less: each seed's share divides by its own way, and a short one would
/// decide by itself. (A way of several seeds is then beyond two standard errors; with two seeds that is the same.)
fn closed(
    here: &BTreeMap<u64, f64>,
    from: &BTreeMap<u64, f64>,
    to: &BTreeMap<u64, f64>,
    least: f64,
) -> Option<Summary> {
    let ways: Vec<(f64, f64)> = here
        .iter()
        .filter_map(|(seed, here)| {
            let from = from.get(seed)?;
            Some((here - from, to.get(seed)? - from))
        })
        .collect();
    let whole = Summary::of(&Vec::from_iter(ways.iter().map(|(_, whole)| *whole)))?;
    let is_way = whole.mean >= least && ways.iter().all(|(_, way)| *way > 0.5 * whole.mean);
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
                let parts: Vec<Summary> = parts.collect();
                (Summary::over(&parts), parts.len())
            };
            let (mean, _) = over(|cell| cell.mean);
            let [(gain, gained), (closed, shared)] =
                [over(|cell| cell.gain), over(|cell| cell.closed)];
            Cell {
                values: BTreeMap::new(),
                mean,
                gain,
                is_elsewhere: found.iter().any(|row| row.cells[score].is_elsewhere),
                closed,
                over: Some([gained, shared]),
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
    use crate::score::Score;
    use property::property;

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
        let found = closed(&map(&[(1, 25.0), (2, 35.0)]), &from, &to, 0.1).expect("a way");
        assert!((found.mean - 0.625).abs() < 1e-12);
        let found = closed(&from, &from, &to, 0.1).expect("a way");
        assert_eq!(found.mean, 0.0);
        let flat = map(&[(1, 20.1), (2, 19.95)]);
        assert_eq!(
            closed(&to, &from, &flat, 0.1),
            None,
            "inside two standard errors"
        );
        assert_eq!(closed(&to, &to, &from, 0.1), None, "the wrong way");
        assert_eq!(
            closed(&to, &from, &BTreeMap::new(), 0.1),
            None,
            "no bound yet"
        );
    }

    #[test]
    fn a_short_way_has_no_shares() {
        // One seed: 0.01 dB are noise, and half a decibel no fifty times of something.
        let at = |value: f64| map(&[(1, value)]);
        let share = |to: f64| closed(&at(30.5), &at(30.0), &at(to), 0.1);
        assert_eq!(share(30.01), None);
        let found = share(30.2).expect("a way");
        assert!((found.mean - 2.5).abs() < 1e-9, "{found:?}");
        assert_eq!(found.standard_error, None);
        // The same with two seeds that happen to agree.
        let two = |value: f64| map(&[(1, value), (2, value + 0.001)]);
        assert_eq!(closed(&two(30.5), &two(30.0), &two(30.01), 0.1), None);
        // What has more decimal places is told on a shorter way.
        let least = |name: &str| Score::from(name.to_owned()).least_way();
        assert!((least("all") - 0.1).abs() < 1e-12, "dB");
        assert!((least("ssim") - 1e-3).abs() < 1e-12, "SSIM");
    }

    #[test]
    fn no_seed_decides_a_share_by_its_short_way() {
        // Far beyond two standard errors, but the share with seed 8 is 500.
        let seeds = || 1..=8_u64;
        let flat: BTreeMap<u64, f64> = seeds().map(|seed| (seed, 20.0)).collect();
        let here: BTreeMap<u64, f64> = seeds().map(|seed| (seed, 20.5)).collect();
        let to = |last: f64| -> BTreeMap<u64, f64> {
            let way = |seed: u64| if seed == 8 { last } else { 1.0 };
            seeds().map(|seed| (seed, 20.0 + way(seed))).collect()
        };
        assert_eq!(closed(&here, &flat, &to(0.001), 0.1), None);
        let found = closed(&here, &flat, &to(0.8), 0.1).expect("a way");
        assert!((found.mean - (7.0 * 0.5 + 0.625) / 8.0).abs() < 1e-9);

        // With two seeds it is the rule of two standard errors.
        let two = |a: f64, b: f64| map(&[(1, 20.0 + a), (2, 20.0 + b)]);
        for short in [-1.0, 0.0, 0.2, 0.3, 0.4, 0.9, 1.0] {
            let way = Summary::of(&[1.0, short]).expect("two");
            let found = closed(&two(0.5, 0.5), &two(0.0, 0.0), &two(1.0, short), 0.1);
            assert_eq!(found.is_some(), way.is_clear(), "{short}");
        }

        // Where an arm is off, its share is off by no more than twice that part of the mean way.
        property("shares", 500, |u| {
            let count = u.int_in_range(1..=8_u64)?;
            let ranges: [(i32, i32); 4] = [(2000, 2100), (2000, 2300), (-10, 10), (-50, 200)];
            let mut drawn = [(); 4].map(|()| BTreeMap::new());
            for seed in 1..=count {
                for (values, (least, most)) in drawn.iter_mut().zip(ranges) {
                    let value = u.int_in_range(least..=most)?;
                    values.insert(seed, f64::from(value) / 100.0);
                }
            }
            let [from, here, off, way] = drawn;
            let add = |a: &BTreeMap<u64, f64>, b: &BTreeMap<u64, f64>| -> BTreeMap<u64, f64> {
                a.iter().map(|(seed, v)| (*seed, v + b[seed])).collect()
            };
            let to = add(&from, &way);
            let Some(share) = closed(&here, &from, &to, 0.1) else {
                return Ok(());
            };
            let moved = closed(&add(&here, &off), &from, &to, 0.1).expect("the same way");
            let mean = |of: &BTreeMap<u64, f64>, f: fn(&f64) -> f64| {
                of.values().map(f).sum::<f64>() / of.len() as f64
            };
            let most = 2.0 * mean(&off, |v| v.abs()) / mean(&way, |v| *v);
            let change = (moved.mean - share.mean).abs();
            assert!(change <= most + 1e-9, "{change} of {most}: {way:?}");
            Ok(())
        });
    }
}
