//! `report.html`: a run as one page that opens from disk and asks no network.

mod facts;
mod gallery;
mod splats;

pub(crate) use facts::Live;
pub(crate) use gallery::Gallery;

use crate::config::Config;
use crate::failure::Failure;
use crate::log::Line;
use crate::page::{Page, REPORT, held};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use facts::{Facts, scene_name};
use serde::de::DeserializeOwned;
use serde_json::Value;
use splats::Rows;
use std::path::Path;
use trainer::Run;

/// The page.
pub(crate) const FILE: &str = "report.html";
/// What of a large scene lies beside it.
pub(crate) const SIDE_FILE: &str = "report.splats";
/// A page with more bytes than this has its splats beside it.
const MOST_BYTES: usize = 25_000_000;

/// Writes the report of a run into its folder: scores are as in `metrics.json`, or null.
pub(crate) fn write(
    out: &Path,
    run: &Run,
    config: &Config,
    gallery: &Gallery,
    (metrics, curves): (&Value, &[Line]),
) -> Result<(), Failure> {
    let scene = scene_bytes(run)?;
    let mut facts = Facts::new(run, config, metrics, curves);
    let gallery = serde_json::to_string(gallery)?;
    // Base64 writes three bytes as four.
    let beside = gallery.len() + scene.len() / 3 * 4 > MOST_BYTES;
    let encoded = if beside {
        String::new()
    } else {
        STANDARD.encode(&scene)
    };
    let side = out.join(SIDE_FILE);
    if beside {
        facts.side_file = Some(SIDE_FILE);
        io::write_atomic(&side, |file| file.write_all(&scene))?;
    } else if side.exists() {
        std::fs::remove_file(&side).map_err(|e| format!("{e}: {}", side.display()))?;
    }
    let html = page(&facts, config, (&gallery, &encoded))?;
    Ok(io::write_atomic(&out.join(FILE), |file| {
        file.write_all(html.as_bytes())
    })?)
}

/// The report of a run that is still trained: the page, and the splats that it asks its server for as [`SIDE_FILE`].
pub(crate) fn live(
    run: &Run,
    config: &Config,
    gallery: &Gallery,
    (curves, live): (&[Line], Live),
) -> Result<(String, Vec<u8>), Failure> {
    let mut facts = Facts::new(run, config, &Value::Null, curves);
    facts.side_file = Some(SIDE_FILE);
    facts.live = Some(live);
    let html = page(&facts, config, (&serde_json::to_string(gallery)?, ""))?;
    Ok((html, scene_bytes(run)?))
}

/// The page; splats in base64, empty where they lie beside it.
fn page(
    facts: &Facts<'_>,
    config: &Config,
    (gallery, splats): (&str, &str),
) -> Result<String, Failure> {
    let facts = serde_json::to_string(facts)?;
    Ok(Page {
        kind: &REPORT,
        title: scene_name(config),
        data: &[("facts", &facts), ("gallery", gallery)],
        splats: Some(splats),
    }
    .html())
}

/// What the report in a folder was made of: facts and gallery; `None` where there is none that can be read.
pub(crate) fn read<F: DeserializeOwned, G: DeserializeOwned>(out: &Path) -> Option<(F, G)> {
    let path = out.join(FILE);
    // One of ours with every scene inside would be no longer.
    if path.metadata().ok()?.len() > 2 * MOST_BYTES as u64 {
        return None;
    }
    let html = std::fs::read_to_string(path).ok()?;
    let facts = serde_json::from_str(held(&html, "facts")?).ok()?;
    let gallery = serde_json::from_str(held(&html, "gallery")?).ok()?;
    Some((facts, gallery))
}

/// The Gaussians and their motion, with the colours that are trained by now.
fn scene_bytes(run: &Run) -> Result<Vec<u8>, Failure> {
    let gaussians = run.gaussians(None)?;
    let rows = Rows {
        means: &gaussians.means,
        quats: &gaussians.quats,
        log_scales: &gaussians.log_scales,
        opacity_logits: &gaussians.opacity_logits,
        sh: &gaussians.sh,
    };
    let degree = run
        .schedule()
        .sh_degree_at(run.iteration())
        .min(gaussians.sh_degree);
    Ok(splats::encode(&rows, degree, run.motion_arrays()?.as_ref()))
}
