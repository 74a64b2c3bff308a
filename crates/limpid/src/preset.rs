//! Presets: what a run may cost, each a file of settings. RESULTS.md, "Presets", has what they give.

use crate::failure::Failure;
use toml::Table;

/// How much time a run may take for what it gains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Preset {
    /// A first look.
    Draft,
    /// Half of the time of the defaults.
    Balanced,
    /// The defaults.
    Full,
}

impl Preset {
    /// Its settings, as a config file has them.
    pub(crate) fn table(self) -> Result<Table, Failure> {
        Ok(toml::from_str(match self {
            Self::Draft => include_str!("../presets/draft.toml"),
            Self::Balanced => include_str!("../presets/balanced.toml"),
            Self::Full => include_str!("../presets/full.toml"),
        })?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, from_table};
    use clap::ValueEnum as _;
    use trainer::{Settings, differences};

    #[test]
    fn presets_have_settings_that_there_are_and_full_is_what_is_taken_by_default() {
        let settings = |preset: &Preset| {
            let table = preset.table().expect("TOML");
            let config = from_table(table, &Config::of(Settings::default()));
            config.expect("settings").settings
        };
        let all: Vec<Settings> = Preset::value_variants().iter().map(settings).collect();
        assert!(all.is_sorted_by_key(|settings| settings.iterations));
        let full = settings(&Preset::Full);
        assert!(differences(&full, &Settings::default()).is_empty());
    }
}
