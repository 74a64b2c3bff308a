//! Settings by name: what is wrong with one, and which one was meant.

use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use std::fmt;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table};
use trainer::Settings;

/// The keys of a config file that are not settings of the trainer.
pub(crate) const RUN_KEYS: [&str; 6] = [
    "scene",
    "images",
    "downscale",
    "static",
    "distortion",
    "backend",
];

/// A setting that cannot be what it was said to be.
#[derive(Debug)]
pub(crate) struct Mistake {
    /// Its dotted name, such as `blur.kernel_size`.
    pub(crate) key: String,
    problem: String,
}

impl Mistake {
    /// What serde says of a key, in words of ours.
    pub(crate) fn new(key: impl Into<String>, problem: &str) -> Self {
        let key = key.into();
        let known = Known::new();
        let problem = if problem.starts_with("unknown field") {
            match known.nearest(&key) {
                Some(near) => format!("there is no such setting; did you mean `{near}`?"),
                None => problem.to_owned(),
            }
        } else {
            let default = known.default_of(&key);
            let such_as = default.map_or_else(String::new, |value| format!(", such as {value}"));
            format!("{}{such_as}", in_words(problem))
        };
        Self { key, problem }
    }
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.key.is_empty() {
            return write!(f, "{}", self.problem);
        }
        write!(f, "`{}`: {}", self.key, self.problem)
    }
}

/// A table as what it should be.
pub(crate) fn typed<T: DeserializeOwned>(table: Table) -> Result<T, Mistake> {
    serde_path_to_error::deserialize(table).map_err(|error| {
        let key = error.path().iter().map(ToString::to_string);
        let key = Vec::from_iter(key).join(".");
        Mistake::new(key, error.inner().message())
    })
}

/// The line, counted from 1, on which a dotted key stands in TOML; that of the innermost group that is there where it does not.
pub(crate) fn line_of(text: &str, key: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut table = Some(document.get_ref());
    let mut at = None;
    for part in key.split('.') {
        let entry = table.and_then(|table| table.iter().find(|(name, _)| name.get_ref() == part));
        let Some((name, value)) = entry else {
            break;
        };
        at = Some(Spanned::span(name).start);
        table = match value.get_ref() {
            DeValue::Table(inner) => Some(inner),
            _ => None,
        };
    }
    Some(1 + text[..at?].matches('\n').count())
}

/// The names of types, as serde writes them, in words. (Of a name it says `unit variant, expected string only`.)
fn in_words(problem: &str) -> String {
    let Some((found, wanted)) = problem.rsplit_once("expected ") else {
        return problem.to_owned();
    };
    if wanted == "string only" {
        return "expected a name in quotes".to_owned();
    }
    let wanted = match wanted {
        "usize" | "u64" | "u32" => "a whole number that is not negative",
        "f64" | "f32" => "a number",
        "a boolean" => "true or false",
        group if group.starts_with("struct ") => "a group of settings",
        other => other,
    };
    format!("{found}expected {wanted}")
}

/// Every setting that there is, with its default.
struct Known(Vec<(String, Json)>);

impl Known {
    fn new() -> Self {
        let mut all = Vec::from_iter(RUN_KEYS.map(|key| (key.to_owned(), Json::Null)));
        if let Ok(defaults) = serde_json::to_value(Settings::default()) {
            collect("", &defaults, &mut all);
        }
        Self(all)
    }

    /// A default that shows what is wanted; none for a group, and for what has none.
    fn default_of(&self, key: &str) -> Option<&Json> {
        let (_, value) = self.0.iter().find(|(name, _)| name == key)?;
        (!value.is_null() && !value.is_object()).then_some(value)
    }

    /// The key that was meant: few letters away, or of the same name in another group.
    fn nearest(&self, key: &str) -> Option<&str> {
        fn name(key: &str) -> &str {
            key.rsplit('.').next().unwrap_or(key)
        }
        let distance = |known: &str| {
            let whole = strsim::damerau_levenshtein(known, key);
            whole.min(1 + strsim::damerau_levenshtein(name(known), name(key)))
        };
        let known = self.0.iter().map(|(known, _)| known.as_str());
        let (far, nearest) = known.map(|known| (distance(known), known)).min()?;
        (far <= 1 + name(key).chars().count() / 4).then_some(nearest)
    }
}

/// Groups and what is in them, by dotted names.
fn collect(group: &str, value: &Json, all: &mut Vec<(String, Json)>) {
    for (name, value) in value.as_object().into_iter().flatten() {
        let key = if group.is_empty() {
            name.clone()
        } else {
            format!("{group}.{name}")
        };
        collect(&key, value, all);
        all.push((key, value.clone()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_meant_is_found_and_nothing_far_away() {
        let known = Known::new();
        for (key, meant) in [
            ("blur.kernal_size", Some("blur.kernel_size")),
            ("blurr.kernel_size", Some("blur.kernel_size")),
            ("kernel_size", Some("blur.kernel_size")),
            ("blr", Some("blur")),
            ("iteration", Some("iterations")),
            ("downscal", Some("downscale")),
            ("blur.weather", None),
            ("x", None),
        ] {
            assert_eq!(known.nearest(key), meant, "{key}");
        }
    }

    #[test]
    fn keys_are_found_on_their_lines() {
        let text = "iterations = 500\n\n[blur]\n# a comment\nkernel_size = 7\n[loss]\ngauge = 1\n";
        for (key, line) in [
            ("iterations", Some(1)),
            ("blur.kernel_size", Some(5)),
            ("blur.other", Some(3)),
            ("loss.gauge", Some(7)),
            ("loss.gauge.more", Some(7)),
            ("other", None),
        ] {
            assert_eq!(line_of(text, key), line, "{key}");
        }
        assert_eq!(line_of("blur.kernel_size = 7", "blur.kernel_size"), Some(1));
    }
}
