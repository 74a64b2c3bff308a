//! What a run is scored by.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A figure of a run: one of a few by a short name, or any of `metrics.json` by its dotted name, in
/// which `*` is the mean over a list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub struct Score {
    name: String,
}

/// Where a score with a short name is found, and how it is written.
struct Known {
    name: &'static str,
    heading: &'static str,
    from: From,
    digits: usize,
    kind: Kind,
}

/// How two runs are compared by a score.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// More is better: by the difference, and the share of the way to a bound.
    Quality,
    /// Less is better: by how many times as much.
    Cost,
    /// Neither: by the difference.
    Finding,
}

#[derive(Clone, Copy)]
enum From {
    /// `metrics.json`.
    Metrics(&'static str),
    /// The sum of static and dynamic Gaussians in it.
    Gaussians,
    /// What the laboratory measured.
    Measured(fn(&Measured) -> Option<f64>),
}

/// What the laboratory measured of a run, all attempts together since it last began from nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Processor time, s.
    pub cpu_seconds: f64,
    /// Time on the clock, s.
    pub wall_seconds: f64,
    /// Most memory that was in use at once, MiB; not known on some systems.
    pub peak_mib: Option<f64>,
}

const KNOWN: [Known; 9] = [
    quality(
        "static",
        "static, dB",
        From::Metrics("test.mpsnr_static"),
        2,
    ),
    quality(
        "movers",
        "movers, dB",
        From::Metrics("test.mpsnr_dynamic"),
        2,
    ),
    quality("all", "all, dB", From::Metrics("test.mpsnr"), 2),
    quality("psnr", "PSNR, dB", From::Metrics("test.psnr"), 2),
    quality("ssim", "SSIM", From::Metrics("test.ssim"), 4),
    cost("seconds", "training, s", From::Metrics("seconds"), 1),
    cost(
        "cpu",
        "processor, s",
        From::Measured(|m| Some(m.cpu_seconds)),
        1,
    ),
    cost("memory", "memory, MiB", From::Measured(|m| m.peak_mib), 0),
    cost("gaussians", "Gaussians", From::Gaussians, 0),
];

const fn quality(name: &'static str, heading: &'static str, from: From, digits: usize) -> Known {
    Known {
        name,
        heading,
        from,
        digits,
        kind: Kind::Quality,
    }
}

const fn cost(name: &'static str, heading: &'static str, from: From, digits: usize) -> Known {
    Known {
        name,
        heading,
        from,
        digits,
        kind: Kind::Cost,
    }
}

impl std::convert::From<String> for Score {
    fn from(name: String) -> Self {
        Self { name }
    }
}

impl std::convert::From<Score> for String {
    fn from(score: Score) -> Self {
        score.name
    }
}

impl Score {
    fn known(&self) -> Option<&'static Known> {
        KNOWN.iter().find(|known| known.name == self.name)
    }

    /// The name in a study's file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Heading of a column, with the unit.
    #[must_use]
    pub fn heading(&self) -> &str {
        self.known().map_or(&self.name, |known| known.heading)
    }

    /// Decimal places.
    #[must_use]
    pub fn digits(&self) -> usize {
        self.known().map_or(4, |known| known.digits)
    }

    /// The least way between two arms that it can tell a share of: ten of its last decimal place, of dB 0.1.
    pub(crate) fn least_way(&self) -> f64 {
        10.0_f64.powi(1 - self.digits() as i32)
    }

    /// How two runs are compared by it.
    #[must_use]
    pub fn kind(&self) -> Kind {
        self.known().map_or(Kind::Finding, |known| known.kind)
    }

    /// The figure of a run; none where it has none, such as that of movers where nothing moves.
    #[must_use]
    pub fn of(&self, metrics: &Value, measured: Option<&Measured>) -> Option<f64> {
        match self.known().map(|known| known.from) {
            Some(From::Metrics(path)) => at(metrics, path),
            Some(From::Gaussians) => {
                Some(at(metrics, "gaussians.static")? + at(metrics, "gaussians.dynamic")?)
            }
            Some(From::Measured(read)) => measured.and_then(read),
            None => at(metrics, &self.name),
        }
    }
}

/// The number under a dotted name; `*` is the mean over a list.
fn at(value: &Value, path: &str) -> Option<f64> {
    if path.is_empty() {
        return value.as_f64();
    }
    let (key, rest) = path.split_once('.').unwrap_or((path, ""));
    match value {
        Value::Array(list) if key == "*" => {
            let values: Option<Vec<f64>> = list.iter().map(|inner| at(inner, rest)).collect();
            let values = values.filter(|values| !values.is_empty())?;
            Some(values.iter().sum::<f64>() / values.len() as f64)
        }
        Value::Array(list) => at(list.get(key.parse::<usize>().ok()?)?, rest),
        other => at(other.get(key)?, rest),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_are_found_by_short_and_by_dotted_names() {
        let metrics = serde_json::json!({
            "test": {"mpsnr": 30.5, "mpsnr_dynamic": null},
            "gaussians": {"static": 3, "dynamic": 4},
            "frames": [{"blur_px": 1.5}, {"blur_px": 3.5}],
            "none": [],
        });
        let measured = Measured {
            cpu_seconds: 7.0,
            wall_seconds: 9.0,
            peak_mib: None,
        };
        let of = |name: &str| Score::from(name.to_owned()).of(&metrics, Some(&measured));
        assert_eq!(of("all"), Some(30.5));
        assert_eq!(of("movers"), None, "null");
        assert_eq!(of("static"), None, "absent");
        assert_eq!(of("gaussians"), Some(7.0));
        assert_eq!(of("cpu"), Some(7.0));
        assert_eq!(of("memory"), None, "not measured");
        assert_eq!(of("frames.0.blur_px"), Some(1.5));
        assert_eq!(of("frames.2.blur_px"), None);
        assert_eq!(of("frames.*.blur_px"), Some(2.5));
        assert_eq!(of("frames.*.focus"), None);
        assert_eq!(of("none.*.blur_px"), None);
        assert_eq!(of("no.such"), None);
        let unmeasured = Score::from("cpu".to_owned()).of(&metrics, None);
        assert_eq!(unmeasured, None, "a run from elsewhere");
    }
}
