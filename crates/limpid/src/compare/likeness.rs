//! Whether two runs can be held against each other.

use super::read::{Compared, ReportFacts, ReportView};

/// Cameras of one scene may be so far apart, as a share of its size and in a rotation's entries: runs correct poses a little.
const NEAR: f64 = 0.05;

/// What a run is to the first one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Likeness {
    /// Of the same scene at the same size.
    Same,
    /// Of the same scene, with frames of these sizes (width, height).
    OtherSize([usize; 2], [usize; 2]),
    /// Of another scene, or of other frames: what is other.
    OtherScene(&'static str),
}

/// What a run is to the first one.
pub(super) fn of(first: &ReportFacts, run: &ReportFacts) -> Likeness {
    let pairs = [(&first.train, &run.train), (&first.test, &run.test)];
    for ((a, b), other) in pairs.into_iter().zip(["frames", "test views"]) {
        let same = |(a, b): (&ReportView, &ReportView)| a.name == b.name && a.time == b.time;
        if a.len() != b.len() || !a.iter().zip(b).all(same) {
            return Likeness::OtherScene(other);
        }
        let near = |(a, b): (&ReportView, &ReportView)| is_near(a, b, first.scene_size);
        if !a.iter().zip(b).all(near) {
            return Likeness::OtherScene("cameras");
        }
    }
    let sizes = |views: &[ReportView]| -> Vec<[usize; 2]> {
        views.iter().map(|view| [view.width, view.height]).collect()
    };
    let all = |facts: &ReportFacts| [sizes(&facts.train), sizes(&facts.test)].concat();
    let pairs = all(first).into_iter().zip(all(run));
    let mut others = pairs.filter(|(a, b)| a != b);
    others
        .next()
        .map_or(Likeness::Same, |(a, b)| Likeness::OtherSize(a, b))
}

/// Whether two cameras stand at one place, with one angle of view.
fn is_near(a: &ReportView, b: &ReportView, scene_size: f64) -> bool {
    let angle = |view: &ReportView| view.fx / view.width as f64;
    let entries = a.pose.iter().zip(&b.pose).enumerate();
    let mut gaps = entries.map(|(k, (a, b))| {
        let unit = if k % 4 == 3 { scene_size } else { 1.0 };
        (a - b).abs() / unit
    });
    (angle(a) / angle(b) - 1.0).abs() <= NEAR && gaps.all(|gap| gap <= NEAR)
}

/// What must be said before anything is compared.
pub(super) fn warnings(runs: &[Compared], likeness: &[Likeness]) -> Vec<String> {
    let first = &runs[0];
    let mut warnings = Vec::new();
    for (run, likeness) in runs.iter().zip(likeness) {
        let (name, other) = (&run.name, &first.name);
        match likeness {
            Likeness::Same => {}
            Likeness::OtherSize([w, h], [x, y]) => warnings.push(format!(
                "{name} has pictures of {x} × {y} and {other} of {w} × {h}: scores of different sizes say little about each other"
            )),
            Likeness::OtherScene(what) => warnings.push(format!(
                "{name} (scene {}) has other {what} than {other} (scene {}): their scores say nothing about each other, and its pictures \
                 are not shown",
                run.facts.name, first.facts.name
            )),
        }
        if run.facts.metrics.is_null() {
            warnings.push(format!(
                "{name} was not scored: it ended before its last iteration"
            ));
        }
    }
    warnings
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use serde_json::{Value, json};

    /// A run's facts with two frames and a test view.
    pub(in super::super) fn facts() -> ReportFacts {
        let view = |name: &str, time: f64| {
            json!({ "name": name, "time": time, "width": 160, "height": 90, "fx": 140.0,
            "pose": [1.0, 0.0, 0.0, time, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0] })
        };
        serde_json::from_value(json!({
            "name": "demo", "version": "0.1.0", "backend": "flex", "iterations": 300, "seconds": 12.0, "scene_size": 5.0,
            "gaussians": 100, "movers": 10, "train": [view("a", 0.0), view("b", 1.0)], "test": [view("a", 0.0)],
            "metrics": Value::Null, "notes": [],
        }))
        .expect("facts")
    }

    #[test]
    fn runs_of_another_scene_or_size_are_told_apart() {
        let first = facts();
        assert_eq!(of(&first, &facts()), Likeness::Same);
        let mut moved = facts();
        // Poses that were refined, under another name of the folder.
        moved.train[1].pose[3] += 0.1;
        moved.name = "copy".to_owned();
        assert_eq!(of(&first, &moved), Likeness::Same);
        moved.train[1].pose[3] += 1.0;
        assert_eq!(of(&first, &moved), Likeness::OtherScene("cameras"));
        let mut small = facts();
        for view in small.train.iter_mut().chain(&mut small.test) {
            (view.width, view.height, view.fx) = (80, 45, 70.0);
        }
        assert_eq!(of(&first, &small), Likeness::OtherSize([160, 90], [80, 45]));
        small.train[0].fx = 100.0;
        assert_eq!(of(&first, &small), Likeness::OtherScene("cameras"));
        let mut fewer = facts();
        fewer.train.pop();
        assert_eq!(of(&first, &fewer), Likeness::OtherScene("frames"));
        let mut others = facts();
        others.test[0].name = "c".to_owned();
        assert_eq!(of(&first, &others), Likeness::OtherScene("test views"));
    }
}
