//! `limpid settings`.

use crate::failure::Failure;
use crate::say;
use std::fmt::Write as _;
use std::process::ExitCode;
use trainer::Settings;
use trainer::settings::Meaning;

/// Columns of a line.
const WIDTH: usize = 80;

/// Arguments of `limpid settings`.
#[derive(Debug, clap::Args)]
pub(crate) struct SettingsArguments {
    /// List only those with this in their name, such as `blur` or `camera.`.
    part: Option<String>,
}

pub(crate) fn run(arguments: &SettingsArguments) -> Result<ExitCode, Failure> {
    let part = arguments.part.as_deref().unwrap_or_default();
    let mut text = String::new();
    for setting in Settings::meanings().iter().filter(|s| s.key.contains(part)) {
        let Meaning {
            key,
            default,
            range,
            meaning,
        } = setting;
        let range = range
            .as_ref()
            .map_or_else(String::new, |range| format!("  ({range})"));
        write!(text, "{key}={default}{range}\n{}", wrapped(meaning))?;
    }
    if text.is_empty() {
        return Err(
            format!("no setting has {part} in its name; `limpid settings` lists them all").into(),
        );
    }
    say::print(text.trim_end())?;
    Ok(ExitCode::SUCCESS)
}

/// In lines that fit, four spaces in.
fn wrapped(text: &str) -> String {
    let mut all = String::new();
    let mut line = String::new();
    for word in text.split_whitespace() {
        if !line.is_empty() && 5 + line.chars().count() + word.chars().count() > WIDTH {
            all.push_str(&format!("    {line}\n"));
            line.clear();
        }
        if !line.is_empty() {
            line.push(' ');
        }
        line.push_str(word);
    }
    all.push_str(&format!("    {line}\n"));
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_fit_and_no_word_is_lost() {
        let text = "A meaning of many words, ".repeat(20);
        let lines = wrapped(&text);
        assert!(lines.lines().all(|line| line.chars().count() <= WIDTH));
        assert!(lines.split_whitespace().eq(text.split_whitespace()));
    }
}
