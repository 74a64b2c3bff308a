//! Figures and settings of several runs, a row for each and a column for every run.

use super::read::Compared;
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;
use trainer::differences;

/// Columns of a terminal.
const COLUMNS: usize = 80;
/// What stands above the settings.
const SETTINGS: &str = "settings that differ";
/// What there is not.
const NONE: &str = "–";

/// A line of a table.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub(super) struct Row {
    label: String,
    /// One for each run.
    cells: Vec<String>,
    /// Which of them are the best; none where all are the same or no value is better than another.
    best: Vec<bool>,
}

impl Row {
    fn of(label: impl Into<String>, cells: Vec<String>) -> Self {
        Self {
            label: label.into(),
            best: vec![false; cells.len()],
            cells,
        }
    }

    /// A score with so many decimals, of which the highest is the best.
    fn score(label: &str, values: &[Option<f64>], digits: usize) -> Self {
        let text = |value: &Option<f64>| {
            let value = value.filter(|value| value.is_finite());
            value.map_or(NONE.to_owned(), |value| format!("{value:.digits$}"))
        };
        let mut row = Self::of(label, values.iter().map(text).collect());
        let known = values.iter().flatten().filter(|value| value.is_finite());
        let highest = known.copied().fold(f64::NEG_INFINITY, f64::max);
        let highest = text(&Some(highest));
        // What looks the same is the same.
        let differ = row
            .cells
            .iter()
            .any(|cell| *cell != NONE && *cell != highest);
        if differ {
            row.best = row.cells.iter().map(|cell| *cell == highest).collect();
        }
        row
    }

    fn is_empty(&self) -> bool {
        self.cells.iter().all(|cell| cell == NONE)
    }
}

/// Scores, what was found, and what it took. Where the runs are not `comparable`, no score is the best.
pub(super) fn figures(runs: &[Compared], comparable: bool) -> Vec<Row> {
    let text = |label: &str, of: &dyn Fn(&Compared) -> String| {
        Row::of(label, runs.iter().map(of).collect())
    };
    let number = |label: &str, digits: usize, of: &dyn Fn(&Value) -> Option<f64>| {
        let values: Vec<Option<f64>> = runs.iter().map(|run| of(&run.facts.metrics)).collect();
        Row::score(label, &values, digits)
    };
    let score = |label: &str, digits: usize, of: &dyn Fn(&Value) -> Option<f64>| {
        let row = number(label, digits, of);
        if comparable {
            row
        } else {
            Row::of(row.label, row.cells)
        }
    };
    let found = |label: &str, digits: usize, of: &dyn Fn(&Value) -> Option<f64>| {
        let row = number(label, digits, of);
        Row::of(row.label, row.cells)
    };
    let of = |group: &'static str, key: &'static str| {
        move |metrics: &Value| metrics[group][key].as_f64()
    };
    let one = |key: &'static str| move |metrics: &Value| metrics[key].as_f64();
    let mean = |key: &'static str| move |metrics: &Value| mean_of(&metrics["frames"], key);
    let mut rows = vec![
        text("scene", &|run| run.facts.name.clone()),
        text("frames", &|run| {
            let views = &run.facts.train;
            let size = views
                .first()
                .map_or([0, 0], |view| [view.width, view.height]);
            format!("{} of {} × {}", views.len(), size[0], size[1])
        }),
        score("test PSNR, dB", 2, &of("test", "psnr")),
        score("test SSIM", 4, &of("test", "ssim")),
        score("test mPSNR, dB", 2, &of("test", "mpsnr")),
        score("… what stands still", 2, &of("test", "mpsnr_static")),
        score("… what moves", 2, &of("test", "mpsnr_dynamic")),
        score("sharp frames PSNR, dB", 2, &of("train_sharp", "psnr")),
        score("sharp frames SSIM", 4, &of("train_sharp", "ssim")),
        score("blurred frames PSNR", 2, &mean("psnr")),
        found("mean path, px", 2, &mean("blur_px")),
        found("mean disc, px", 2, &mean("disc_px")),
        found("shutter, frames", 2, &one("shutter")),
        found("aperture", 4, &one("aperture")),
        found("blur intensity", 2, &one("mean_intensity")),
        found("kernels' shift, px", 2, &one("kernel_centroid_px")),
        text("static Gaussians", &|run| {
            let fixed = run.facts.gaussians.saturating_sub(run.facts.movers);
            fixed.to_string()
        }),
        text("dynamic Gaussians", &|run| run.facts.movers.to_string()),
        text("iterations", &|run| run.facts.iterations.to_string()),
        text("seconds of training", &|run| {
            format!("{:.0}", run.facts.seconds)
        }),
        text("backend", &|run| run.facts.backend.clone()),
        text("Limpid", &|run| run.facts.version.clone()),
    ];
    rows.retain(|row| !row.is_empty());
    rows
}

/// The mean of a figure over the frames that have it.
fn mean_of(frames: &Value, key: &str) -> Option<f64> {
    let frames = frames.as_array()?;
    let values: Vec<f64> = frames.iter().filter_map(|f| f[key].as_f64()).collect();
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The settings that are not the same in all runs, and what pictures they were given.
pub(super) fn settings(runs: &[Compared]) -> Vec<Row> {
    let first = &runs[0].config;
    let mut values: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (at, run) in runs.iter().enumerate() {
        for other in differences(&first.settings, &run.config.settings) {
            let usual = value_text(&other.here);
            let cells = values.entry(other.setting);
            cells.or_insert_with(|| vec![usual; runs.len()])[at] = value_text(&other.there);
        }
    }
    let mut rows: Vec<Row> = Vec::new();
    let mut add = |label: &str, of: &dyn Fn(&Compared) -> String| {
        let cells: Vec<String> = runs.iter().map(of).collect();
        if cells.iter().any(|cell| *cell != cells[0]) {
            rows.push(Row::of(label, cells));
        }
    };
    add("images", &|run| {
        let images = run.config.run.images.as_ref();
        images.map_or(NONE.to_owned(), |images| images.display().to_string())
    });
    add("downscale", &|run| run.config.run.factor().to_string());
    add("static", &|run| run.config.run.is_static.to_string());
    add("changed on the way", &|run| {
        let changes = run.config.changes.iter().map(|change| {
            let (setting, to) = (&change.setting, value_text(&change.to));
            format!("{setting} to {to} after {}", change.iteration)
        });
        let changes: Vec<String> = changes.collect();
        if changes.is_empty() {
            NONE.to_owned()
        } else {
            changes.join(", ")
        }
    });
    rows.extend(values.into_iter().map(|(key, cells)| Row::of(key, cells)));
    rows
}

fn value_text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        value => value.to_string(),
    }
}

/// Tables for a terminal: as many runs side by side as it has columns for, then the next ones. The best scores have a star.
pub(super) fn text(names: &[&str], figures: &[Row], settings: &[Row]) -> String {
    let rows = || figures.iter().chain(settings);
    let width = |text: &str| text.chars().count();
    let heading = (!settings.is_empty()).then_some(SETTINGS);
    let labels = rows().map(|row| row.label.as_str()).chain(heading);
    let labels = labels.map(width).max().unwrap_or(0);
    let column = |k: usize| {
        let cells = rows().map(|row| width(&row.cells[k]) + 1);
        // Two columns between a run and the next.
        cells.max().unwrap_or(0).max(width(names[k])) + 2
    };
    let mut out = String::new();
    let mut from = 0;
    while from < names.len() {
        let mut to = from + 1;
        let mut taken = labels + column(from);
        while to < names.len() && taken + column(to) <= COLUMNS {
            taken += column(to);
            to += 1;
        }
        let mut line = |label: &str, cell: &dyn Fn(usize) -> String| {
            let mut text = format!("{}{}", plain(label), " ".repeat(labels - width(label)));
            for k in from..to {
                let cell = plain(&cell(k));
                text.extend([" ".repeat(column(k) - width(&cell)), cell]);
            }
            out.push_str(text.trim_end());
            out.push('\n');
        };
        line("", &|k| format!("{} ", names[k]));
        for row in figures {
            let star = |k: usize| if row.best[k] { '*' } else { ' ' };
            line(&row.label, &|k| format!("{}{}", row.cells[k], star(k)));
        }
        if let Some(heading) = heading {
            line("", &|_| String::new());
            line(heading, &|_| String::new());
        }
        for row in settings {
            line(&row.label, &|k| format!("{} ", row.cells[k]));
        }
        out.push('\n');
        from = to;
    }
    out.trim_end().to_owned()
}

/// Text that does nothing to a terminal.
fn plain(text: &str) -> String {
    text.replace(char::is_control, "\u{fffd}")
}

#[cfg(test)]
mod tests {
    use super::super::likeness::tests::facts;
    use super::super::read::ReportGallery;
    use super::*;
    use crate::config::Config;
    use serde_json::json;
    use trainer::Settings;

    fn run(name: &str, metrics: Value) -> Compared {
        let mut facts = facts();
        facts.metrics = metrics;
        Compared {
            name: name.to_owned(),
            config: Config::of(Settings::default()),
            facts,
            gallery: ReportGallery {
                factor: 1,
                views: Vec::new(),
            },
        }
    }

    fn row<'a>(rows: &'a [Row], label: &str) -> Option<&'a Row> {
        rows.iter().find(|row| row.label == label)
    }

    #[test]
    fn the_best_score_is_marked_and_what_is_none_is_a_dash() {
        let runs = [
            run(
                "a",
                json!({ "test": { "psnr": 25.114, "ssim": 0.8 }, "frames": [{ "blur_px": 1.0 }, { "blur_px": 2.0 }] }),
            ),
            run("b", json!({ "test": { "psnr": 26.2, "ssim": 0.80001 } })),
            run("c", Value::Null),
            // What a file has where a number was none.
            run("d", json!({ "test": { "psnr": null } })),
        ];
        let rows = figures(&runs, true);
        let psnr = row(&rows, "test PSNR, dB").expect("a row");
        assert_eq!(psnr.cells, ["25.11", "26.20", "–", "–"]);
        assert_eq!(psnr.best, [false, true, false, false]);
        let ssim = row(&rows, "test SSIM").expect("a row");
        assert_eq!(ssim.best, [false; 4], "they look the same");
        let path = row(&rows, "mean path, px").expect("a row");
        assert_eq!(path.cells, ["1.50", "–", "–", "–"]);
        assert_eq!(row(&rows, "aperture"), None, "nobody has one");
        let apart = figures(&runs, false);
        assert_eq!(
            row(&apart, "test PSNR, dB").expect("a row").best,
            [false; 4]
        );
    }

    #[test]
    fn only_settings_that_differ_are_listed() {
        let mut runs = [
            run("a", Value::Null),
            run("b", Value::Null),
            run("c", Value::Null),
        ];
        assert_eq!(settings(&runs), []);
        runs[1].config.settings.blur.kernel_size = 7;
        runs[2].config.run.downscale = Some(2);
        let rows = settings(&runs);
        let told: Vec<(&str, &[String])> = rows
            .iter()
            .map(|row| (row.label.as_str(), &row.cells[..]))
            .collect();
        let usual = Settings::default().blur.kernel_size.to_string();
        assert_eq!(
            told,
            [
                ("downscale", &["1", "1", "2"].map(str::to_owned)[..]),
                (
                    "blur.kernel_size",
                    &[usual.clone(), "7".to_owned(), usual][..]
                ),
            ]
        );
    }

    #[test]
    fn settings_with_short_names_are_listed_of_runs_without_scores() {
        let mut runs = [run("a", Value::Null), run("b", Value::Null)];
        runs[1].config.settings.seed = 2;
        let text = text(&["a", "b"], &figures(&runs, true), &settings(&runs));
        let lines: Vec<&str> = text.lines().collect();
        let heading = lines.iter().position(|line| *line == SETTINGS);
        let below = heading.and_then(|heading| lines.get(heading + 1));
        assert!(
            below.is_some_and(|line| line.starts_with("seed ")),
            "{text}"
        );
    }

    #[test]
    fn a_table_fits_a_terminal_and_does_nothing_to_it() {
        let names: Vec<String> = (0..9).map(|k| format!("a-run-{k}\u{1b}[2J")).collect();
        let runs: Vec<Compared> = names
            .iter()
            .map(|name| run(name, json!({ "test": { "psnr": 20.0 } })))
            .collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        let text = text(&names, &figures(&runs, true), &[]);
        assert!(
            text.lines().all(|line| line.chars().count() <= COLUMNS),
            "{text}"
        );
        assert!(!text.contains('\u{1b}'), "{text}");
        assert_eq!(text.matches("20.00").count(), 9, "every run once: {text}");
        assert_eq!(text.matches("a-run-8").count(), 1, "{text}");
    }
}
