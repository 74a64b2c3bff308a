//! A run that is compared, as its report has it.

use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::refresh;
use crate::report;
use crate::shell::quoted;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// What of a report's facts is compared.
#[derive(Debug, Deserialize)]
pub(super) struct ReportFacts {
    /// The scene's.
    pub(super) name: String,
    pub(super) version: String,
    pub(super) backend: String,
    pub(super) iterations: usize,
    pub(super) seconds: f64,
    pub(super) scene_size: f64,
    pub(super) gaussians: usize,
    pub(super) movers: usize,
    pub(super) train: Vec<ReportView>,
    pub(super) test: Vec<ReportView>,
    pub(super) metrics: Value,
    pub(super) notes: Vec<String>,
}

/// From where and when a view was taken.
#[derive(Debug, Deserialize, Serialize)]
pub(super) struct ReportView {
    pub(super) name: String,
    pub(super) time: f32,
    pub(super) width: usize,
    pub(super) height: usize,
    #[serde(skip_serializing)]
    pub(super) fx: f64,
    /// Rows of [R | t], camera from world.
    #[serde(skip_serializing)]
    pub(super) pose: [f64; 12],
}

/// A run, as its report has it.
pub(super) struct Compared {
    pub(super) name: String,
    pub(super) config: Config,
    pub(super) facts: ReportFacts,
    pub(super) gallery: ReportGallery,
}

/// What of a report's gallery is compared.
#[derive(Debug, Deserialize)]
pub(super) struct ReportGallery {
    pub(super) factor: usize,
    pub(super) views: Vec<ViewPictures<String>>,
}

/// A view's pictures, or where they are.
#[derive(Debug, Default, Deserialize, Serialize)]
pub(super) struct ViewPictures<T> {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) input: Option<T>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) seen: Option<T>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) sharp: Option<T>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) truth: Option<T>,
}

impl Compared {
    /// A run by its report, which is written first, on `backend` or where the run was trained, where there is none that says how the
    /// run is now.
    pub(super) fn open(
        name: String,
        folder: &Path,
        backend: Option<Backend>,
    ) -> Result<Self, Failure> {
        let config = Config::of_run(folder)?;
        let current = refresh::is_current(folder);
        let mut found = current.then(|| read(folder)).flatten();
        if found.is_none() {
            refresh::write(folder, &config.clone().on(backend), None)?;
            found = read(folder);
        }
        let (facts, gallery) = found.ok_or_else(|| {
            let path = folder.join(report::FILE);
            format!(
                "{} cannot be read back; `limpid render {} --scene DIR` writes it anew",
                path.display(),
                quoted(&folder.display().to_string())
            )
        })?;
        Ok(Self {
            name,
            config,
            facts,
            gallery,
        })
    }
}

/// A report's facts and gallery; `None` where they are no whole report's.
fn read(folder: &Path) -> Option<(ReportFacts, ReportGallery)> {
    let (facts, gallery): (ReportFacts, ReportGallery) = report::read(folder)?;
    let views = facts.train.len() + facts.test.len();
    (views == gallery.views.len()).then_some((facts, gallery))
}
