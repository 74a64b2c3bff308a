//! What every setting means, from the sources that document it: what is read there and what is told here cannot differ.

use super::Settings;
use serde_json::Value;
use std::collections::BTreeMap;

/// The sources of all settings.
const SOURCES: [&str; 2] = [include_str!("../settings.rs"), include_str!("blur.rs")];

/// A setting.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Meaning {
    /// Its dotted name, such as `blur.kernel_size`.
    pub key: String,
    /// Its default, as JSON.
    pub default: String,
    /// What it may be; `None` where any value of its kind is taken.
    pub range: Option<String>,
    /// What it does.
    pub meaning: String,
}

/// A field of a struct of settings.
struct Field {
    name: String,
    kind: String,
    doc: String,
}

impl Settings {
    /// Every setting, in the order of the sources.
    #[must_use]
    pub fn meanings() -> Vec<Meaning> {
        let settings = Self::default();
        let defaults = serde_json::to_value(&settings).unwrap_or_default();
        let mut all = Vec::new();
        Items::read().collect("Settings", "", &defaults, &mut all);
        let ranges = settings.ranges();
        for setting in &mut all {
            // Of several, the first says more.
            if let Some(range) = ranges.iter().find(|range| range.key == setting.key) {
                setting.range = Some(range.allowed.to_owned());
            }
        }
        all
    }
}

/// Structs and enums of the sources, by name.
#[derive(Default)]
struct Items {
    structs: BTreeMap<String, Vec<Field>>,
    /// Variants as serde names them.
    enums: BTreeMap<String, Vec<String>>,
}

impl Items {
    /// Follows how rustfmt writes them: an item's line and its last brace at the left, what is in it four spaces in.
    fn read() -> Self {
        let mut items = Self::default();
        for source in SOURCES {
            let mut item = None;
            let mut doc = Vec::new();
            for line in source.lines() {
                if let Some(kind) = ["pub struct ", "pub enum "]
                    .iter()
                    .find(|k| line.starts_with(**k))
                {
                    let name = line[kind.len()..].trim_end_matches(" {").to_owned();
                    item = Some((name, kind.contains("enum")));
                    doc.clear();
                } else if line == "}" {
                    item = None;
                }
                let Some(((name, is_enum), inner)) = item.as_ref().zip(line.strip_prefix("    "))
                else {
                    continue;
                };
                if let Some(text) = inner.strip_prefix("///") {
                    doc.push(text.trim());
                } else if *is_enum && inner.starts_with(char::is_alphabetic) {
                    let variant = inner.split(['(', ',']).next().unwrap_or_default();
                    let variant = variant.to_lowercase();
                    let variants = items.enums.entry(name.clone()).or_default();
                    variants.push(if inner.contains('(') {
                        format!("{{ {variant} = … }}")
                    } else {
                        variant
                    });
                } else if let Some((field, kind)) =
                    inner.strip_prefix("pub ").and_then(|f| f.split_once(": "))
                {
                    let text = doc.join(" ").replace("[`", "`").replace("`]", "`");
                    items.structs.entry(name.clone()).or_default().push(Field {
                        name: field.to_owned(),
                        kind: kind.trim_end_matches(',').to_owned(),
                        doc: text,
                    });
                    doc.clear();
                    continue;
                }
                if !inner.starts_with("///") && !inner.starts_with('#') {
                    doc.clear();
                }
            }
        }
        items
    }

    /// The settings of a struct, whose defaults are these.
    fn collect(&self, name: &str, group: &str, defaults: &Value, all: &mut Vec<Meaning>) {
        for field in self.structs.get(name).into_iter().flatten() {
            let key = format!("{group}{}", field.name);
            let default = &defaults[&field.name];
            if self.structs.contains_key(&field.kind) {
                self.collect(&field.kind, &format!("{key}."), default, all);
                continue;
            }
            let choices = self
                .enums
                .get(&field.kind)
                .map(|variants| variants.join(", "));
            all.push(Meaning {
                key,
                default: default.to_string(),
                range: choices.or_else(|| (field.kind == "bool").then(|| "true, false".to_owned())),
                meaning: field.doc.clone(),
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn leaves(group: &str, value: &Value, all: &mut Vec<String>) {
        match value.as_object() {
            None => all.push(group.trim_end_matches('.').to_owned()),
            Some(fields) => fields
                .iter()
                .for_each(|(name, value)| leaves(&format!("{group}{name}."), value, all)),
        }
    }

    #[test]
    fn every_setting_there_is_has_a_meaning_and_no_other_has() {
        let meanings = Settings::meanings();
        let mut found: Vec<String> = meanings.iter().map(|m| m.key.clone()).collect();
        let mut expected = Vec::new();
        leaves(
            "",
            &serde_json::to_value(Settings::default()).expect("JSON"),
            &mut expected,
        );
        found.sort();
        expected.sort();
        assert_eq!(found, expected);
        for Meaning {
            key,
            meaning,
            default,
            ..
        } in &meanings
        {
            assert!(meaning.len() > 8 && default != "null", "{key}: {meaning}");
        }
    }

    #[test]
    fn ranges_and_choices_are_told() {
        let meanings = Settings::meanings();
        let range = |key: &str| {
            let setting = meanings.iter().find(|m| m.key == key).expect("a setting");
            setting.range.clone().unwrap_or_default()
        };
        assert_eq!(range("blur.kernel_size"), "odd, 1 to 15");
        assert_eq!(range("blur.model"), "auto, off, kernels, camera, both");
        assert_eq!(range("motion.densify"), "true, false");
        assert_eq!(range("loss.depth"), "zero or a positive number");
        assert_eq!(range("loss.ssim"), "0 to 1");
    }
}
