//! `limpid compare`: several runs side by side, as a table and as a page.

mod likeness;
mod pictures;
mod read;
mod table;

use crate::config::Backend;
use crate::failure::Failure;
use crate::page::{COMPARISON, Page, held};
use crate::say::{conclude, print, say};
use likeness::Likeness;
use pictures::{Pictures, Places};
use read::{Compared, ReportView};
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use table::Row;

/// Arguments of `limpid compare`.
#[derive(Debug, clap::Args)]
pub(crate) struct CompareArguments {
    /// Folders with the results of runs, two or more; the first is what the others are held against.
    #[arg(required = true, num_args = 2.., value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// The page.
    #[arg(long, value_name = "FILE", default_value = "compare.html")]
    out: PathBuf,
    /// Where tensors live, if a report is to be written first [default: where they did in training].
    #[arg(long)]
    backend: Option<Backend>,
}

/// What the page is told, as JSON.
#[derive(Serialize)]
struct Comparison<'a> {
    version: &'static str,
    warnings: &'a [String],
    /// Whether one run's scores are better than another's.
    comparable: bool,
    rows: &'a [Row],
    settings: &'a [Row],
    /// The views of the first run.
    facts: Views<'a>,
    /// Every so-manieth view has its pictures.
    every: usize,
    /// JPEG in base64, each once.
    pictures: &'a [&'a str],
    runs: Vec<PageRun<'a>>,
}

#[derive(Serialize)]
struct Views<'a> {
    train: &'a [ReportView],
    test: &'a [ReportView],
}

#[derive(Serialize)]
struct PageRun<'a> {
    name: &'a str,
    metrics: &'a Value,
    notes: &'a [String],
    /// Pictures are so many times smaller than the frames.
    factor: usize,
    /// Places of the views' pictures; null for a run of another scene.
    views: Option<&'a [Places]>,
}

pub(crate) fn run(arguments: &CompareArguments) -> Result<ExitCode, Failure> {
    check_page(&arguments.out)?;
    let names = names(&arguments.runs)?;
    let runs = names.into_iter().zip(&arguments.runs);
    let runs: Vec<Compared> = runs
        .map(|(name, folder)| Compared::open(name, folder, arguments.backend))
        .collect::<Result<_, _>>()?;
    let likeness: Vec<Likeness> = runs
        .iter()
        .map(|run| likeness::of(&runs[0].facts, &run.facts))
        .collect();
    let warnings = likeness::warnings(&runs, &likeness);
    let comparable = likeness.iter().all(|l| *l == Likeness::Same);
    let rows = table::figures(&runs, comparable);
    let settings = table::settings(&runs);
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    for warning in &warnings {
        say!("warning: {warning}");
    }
    print(&table::text(&names, &rows, &settings))?;

    let pictures = Pictures::of(&runs, &likeness);
    let comparison = Comparison {
        version: env!("CARGO_PKG_VERSION"),
        warnings: &warnings,
        comparable,
        rows: &rows,
        settings: &settings,
        facts: Views {
            train: &runs[0].facts.train,
            test: &runs[0].facts.test,
        },
        every: pictures.every,
        pictures: &pictures.pool,
        runs: runs
            .iter()
            .zip(&pictures.places)
            .map(|(run, views)| PageRun {
                name: &run.name,
                metrics: &run.facts.metrics,
                notes: &run.facts.notes,
                factor: run.gallery.factor,
                views: views.as_deref(),
            })
            .collect(),
    };
    let html = Page {
        kind: &COMPARISON,
        title: &names.join(", "),
        data: &[(DATA, &serde_json::to_string(&comparison)?)],
        splats: None,
    }
    .html();
    io::write_atomic(&arguments.out, |file| file.write_all(html.as_bytes()))?;
    conclude!("side by side in {}", arguments.out.display());
    Ok(ExitCode::SUCCESS)
}

/// The name under which the page holds its data.
const DATA: &str = "comparison";

/// Refuses to write over a file that is no comparison.
fn check_page(path: &Path) -> Result<(), Failure> {
    if !path.exists() {
        return Ok(());
    }
    let is_ours = std::fs::read_to_string(path).is_ok_and(|html| held(&html, DATA).is_some());
    if is_ours {
        return Ok(());
    }
    Err(format!(
        "{} is there and no comparison; choose another file with --out",
        path.display()
    )
    .into())
}

/// What runs are called: their folders' names, or their paths where two have the same.
fn names(folders: &[PathBuf]) -> Result<Vec<String>, Failure> {
    let mut paths = Vec::new();
    for folder in folders {
        let path = folder.canonicalize();
        let path = path.map_err(|e| format!("{e}: {}", folder.display()))?;
        if paths.contains(&path) {
            return Err(format!("{} is given twice", folder.display()).into());
        }
        paths.push(path);
    }
    let short: Vec<String> = paths
        .iter()
        .map(|path| {
            let name = path.file_name().unwrap_or(path.as_os_str());
            name.to_string_lossy().into_owned()
        })
        .collect();
    let distinct = short.iter().collect::<BTreeSet<_>>().len() == short.len();
    Ok(if distinct {
        short
    } else {
        folders.iter().map(|f| f.display().to_string()).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_called_by_their_folders_or_by_their_paths() -> Result<(), Failure> {
        let folder = tempfile::tempdir()?;
        let make = |name: &str| -> std::io::Result<PathBuf> {
            let path = folder.path().join(name);
            std::fs::create_dir_all(&path)?;
            Ok(path)
        };
        let [a, b, other] = [make("x/a")?, make("x/b")?, make("y/a")?];
        assert_eq!(names(&[a.clone(), b.clone()])?, ["a", "b"]);
        let long = names(&[a.clone(), other])?;
        assert!(
            long[0].ends_with("x/a") && long[1].ends_with("y/a"),
            "{long:?}"
        );
        let twice = names(&[a.clone(), b, a.join("../a")]).expect_err("the same");
        assert!(twice.to_string().contains("twice"), "{twice}");
        assert!(names(&[a, folder.path().join("none")]).is_err());
        Ok(())
    }

    #[test]
    fn a_file_that_is_no_comparison_is_left_alone() -> Result<(), Failure> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join("compare.html");
        check_page(&path)?;
        std::fs::write(&path, "<p>mine</p>")?;
        assert!(check_page(&path).is_err());
        let page = Page {
            kind: &COMPARISON,
            title: "t",
            data: &[(DATA, "{}")],
            splats: None,
        };
        std::fs::write(&path, page.html())?;
        check_page(&path)
    }
}
