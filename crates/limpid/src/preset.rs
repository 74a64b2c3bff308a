//! Presets: what a run may cost, each a file of settings. RESULTS.md, "Presets", has what they give.

use crate::config::{Config, from_table};
use crate::failure::Failure;
use toml::Table;
use trainer::Settings;

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

    /// All settings with it, and others as they are.
    pub(crate) fn over(self, config: &Config) -> Result<Settings, Failure> {
        Ok(from_table(self.table()?, config)?.settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum as _;
    use trainer::differences;

    #[test]
    fn presets_have_settings_that_there_are_and_full_is_what_is_taken_by_default() {
        let defaults = Config::of(Settings::default());
        let settings = |preset: Preset| preset.over(&defaults).expect("settings");
        let all = Preset::value_variants().iter().copied().map(settings);
        assert!(all.is_sorted_by_key(|settings| settings.iterations));
        let names = |preset: &Preset| {
            let mut names = Vec::new();
            for (name, value) in preset.table().expect("a table") {
                let inner = value.as_table().into_iter().flat_map(Table::keys);
                names.extend(inner.map(|inner| format!("{name}.{inner}")));
                names.push(name);
            }
            names.sort();
            names
        };
        let mut all = Preset::value_variants().iter().map(names);
        let first = all.next().expect("presets");
        assert!(
            all.all(|names| names == first),
            "each takes back what another one says"
        );
        let full = settings(Preset::Full);
        assert!(differences(&full, &Settings::default()).is_empty());
    }
}
