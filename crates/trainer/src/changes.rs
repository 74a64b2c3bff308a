//! Going on with other settings than those that a run was started with.

use crate::TrainError;
use crate::settings::Settings;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A setting that is another from some iteration on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Iterations done before it.
    pub iteration: usize,
    /// Dotted name of the setting.
    pub setting: String,
    /// What it was.
    pub from: Value,
    /// What it is since.
    pub to: Value,
}

/// A setting that two sets of settings do not share.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Its dotted name.
    pub setting: String,
    /// Its value in the first.
    pub here: Value,
    /// Its value in the second.
    pub there: Value,
}

/// All settings that differ between two sets; arrays are compared whole.
#[must_use]
pub fn differences(here: &Settings, there: &Settings) -> Vec<Difference> {
    let [here, there] =
        [here, there].map(|s| serde_json::to_value(s).expect("settings have a form in JSON"));
    let mut found = Vec::new();
    collect(String::new(), &here, &there, &mut found);
    found
}

/// Both sides are of one type, and have the same keys.
fn collect(setting: String, here: &Value, there: &Value, found: &mut Vec<Difference>) {
    match (here.as_object(), there.as_object()) {
        (Some(a), Some(b)) => {
            for (name, value) in a {
                let key = if setting.is_empty() {
                    name.clone()
                } else {
                    format!("{setting}.{name}")
                };
                collect(key, value, b.get(name).unwrap_or(&Value::Null), found);
            }
        }
        _ if here != there => found.push(Difference {
            setting,
            here: here.clone(),
            there: there.clone(),
        }),
        _ => {}
    }
}

/// What becomes other in a run with such settings after so many iterations, if these are asked for. The intervals between checkpoints
/// are anyone's and no change; with `rates` learning rates may change.
pub(crate) fn changes(
    settings: &Settings,
    asked: &Settings,
    iteration: usize,
    rates: bool,
) -> Result<Vec<Change>, TrainError> {
    asked.validate()?;
    let mut changes = Vec::new();
    for difference in differences(asked, settings) {
        let setting = difference.setting.as_str();
        let advice = match setting {
            "checkpoint_every" | "checkpoint_minutes" => continue,
            "iterations" if asked.iterations > settings.iterations => None,
            "iterations" => Some("a run can become longer, but not shorter"),
            _ if setting.starts_with("learning_rates.") => {
                (!rates).then_some("learning rates may change on the way, with --allow-change")
            }
            _ => Some(
                "a run goes on with the settings that it was started with: undo the change, or start a new run",
            ),
        };
        let Difference {
            setting,
            here,
            there,
        } = difference;
        if let Some(advice) = advice {
            return Err(TrainError::OtherSetting {
                setting,
                here: here.to_string(),
                there: there.to_string(),
                advice,
            });
        }
        changes.push(Change {
            iteration,
            setting,
            from: there,
            to: here,
        });
    }
    Ok(changes)
}
