//! What a study found.

use crate::execute::Failed;
use crate::machine::Machine;
use crate::score::Score;
use crate::statistics::Summary;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A finished run.
#[derive(Clone, Debug)]
pub(crate) struct Finished {
    /// A figure a score.
    pub(crate) figures: Vec<Option<f64>>,
    /// What made it, as [`Origin::program`] has it; not known of some that earlier reports hold.
    pub(crate) program: Option<String>,
    /// The processor that it was made on; not known where it was several, nor of some that earlier reports hold.
    pub(crate) processor: Option<String>,
}

/// All that the runs of a study say, without a path of this machine.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// The study's name.
    pub study: String,
    /// Its heading.
    pub title: String,
    /// What it asks.
    pub about: String,
    /// Of what its runs are.
    #[serde(flatten)]
    pub origin: Origin,
    /// The same of runs that are known from earlier reports alone.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub earlier: Vec<Origin>,
    /// Number of runs that the study asks for.
    pub planned: usize,
    /// Number of those that are finished.
    pub finished: usize,
    /// Runs whose last attempt died.
    pub failed: Vec<FailedRun>,
    /// Seeds.
    pub seeds: Vec<u64>,
    /// The arm that others are compared with where they say nothing else.
    pub baseline: String,
    /// The arm that could not be better.
    pub bound: Option<String>,
    /// The columns.
    pub scores: Vec<Score>,
    /// The rows, scene by scene.
    pub scenes: Vec<SceneTable>,
    /// What each arm gains on average over its scenes.
    pub overall: Vec<Row>,
}

/// What made runs, when and where.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// What the program calls itself.
    pub version: String,
    /// The commit it was built from.
    pub commit: Option<String>,
    /// Whether files differed from that commit.
    pub changed: bool,
    /// Hash of its bytes, where files differed or the commit is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fingerprint: Option<String>,
    /// The first and the last day on which a run began.
    pub dates: Option<(String, String)>,
    /// What runs were made on.
    pub machines: Vec<Machine>,
}

impl Origin {
    /// The program, as far as its commit tells, or its bytes where it is of none.
    pub(crate) fn program(&self) -> String {
        let Self { version, .. } = self;
        let names_commit = version.contains("(commit ") && !version.contains("(commit unknown");
        match (&self.commit, &self.fingerprint) {
            (Some(commit), Some(bytes)) if self.changed => {
                format!("{version}, commit `{commit}` with changes on top (`{bytes}`)")
            }
            (Some(commit), None) if self.changed => {
                format!("{version}, commit `{commit}` with changes on top")
            }
            // Where a version names the commit that last changed the program, later ones are of words.
            (Some(commit), _) if !names_commit => {
                format!("{version}, commit `{commit}`")
            }
            (None, Some(bytes)) => format!("{version}, program `{bytes}`"),
            _ => version.clone(),
        }
    }
}

/// A run that died.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FailedRun {
    /// On which scene.
    pub scene: String,
    /// What it was to be.
    pub arm: String,
    /// Its seed.
    pub seed: u64,
    /// Its name.
    pub run: String,
    /// How, and what it said.
    #[serde(flatten)]
    pub failed: Failed,
}

/// The rows of a scene.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneTable {
    /// Its name.
    pub scene: String,
    /// A row an arm.
    pub rows: Vec<Row>,
}

/// What an arm came to.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    /// Its name.
    pub arm: String,
    /// Hash of what its runs are told, whatever the scene, the seed and the program.
    #[serde(default)]
    pub asks: String,
    /// The arm that it is compared with.
    pub against: Option<String>,
    /// The knob that it is a point of.
    pub knob: Option<String>,
    /// Whether it is given something of the truth.
    pub is_given_truth: bool,
    /// Whether its inputs are worse than there are.
    pub is_perturbed: bool,
    /// How many scenes it is a mean of.
    pub scenes: usize,
    /// How many of its runs are finished.
    pub runs: usize,
    /// What made them, by seed, where runs are of several programs and that is known.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub programs: BTreeMap<u64, String>,
    /// What processor they were made on, by seed, where the report's runs are of several and that is known.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub processors: BTreeMap<u64, String>,
    /// Whether a gain may be between runs of two programs.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_mixed: bool,
    /// A cell a score.
    pub cells: Vec<Cell>,
}

/// What an arm came to in a score.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Cell {
    /// By seed.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub values: BTreeMap<u64, f64>,
    /// Mean over seeds.
    pub mean: Option<Summary>,
    /// Gain against the other arm with the same seed: a difference, of costs a quotient.
    pub gain: Option<Summary>,
    /// Whether that is of a cost, and may be between runs on two kinds of processor.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_elsewhere: bool,
    /// Share of the way from the baseline to the bound.
    pub closed: Option<Summary>,
    /// Of how many scenes gain and share are means, where they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub over: Option<[usize; 2]>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_of_no_known_commit_is_its_bytes() {
        let program = |commit: Option<&str>, bytes: &str| {
            Origin {
                version: "limpid 0 (commit abc)".to_owned(),
                commit: commit.map(str::to_owned),
                changed: false,
                fingerprint: Some(bytes.to_owned()),
                dates: None,
                machines: Vec::new(),
            }
            .program()
        };
        assert_ne!(program(None, "1"), program(None, "2"));
        assert_eq!(program(Some("abc"), "1"), program(Some("abc"), "2"));
    }
}
