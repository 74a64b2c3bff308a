//! A report as a picture.

use crate::error::LabError;
use crate::files::write_whole;
use crate::report::{Report, Row, SceneTable};
use crate::score::Score;
use crate::statistics::{Summary, pareto_front};
use crate::study::Plot;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::path::Path;

/// Width of a panel without the names beside it, px.
const WIDTH: u32 = 420;
/// Height of a panel with curves, px.
const HEIGHT: u32 = 380;
/// Height of a row where arms stand below each other, px.
const ROW: u32 = 20;
/// Width of a letter of a name there, px, hardly less than it takes.
const LETTER: i32 = 7;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;
/// A scene, and the score that its panel has upwards.
type Shown<'a> = (&'a SceneTable, usize);

/// Draws a panel a scene; false where no run is finished yet, so that there is nothing to draw.
///
/// # Errors
/// The plot shows a score that the report has not, or the file cannot be written.
pub fn draw(report: &Report, plot: &Plot, path: &Path) -> Result<bool, LabError> {
    let column = |score: &Score| {
        let found = report.scores.iter().position(|s| s == score);
        found.ok_or_else(|| {
            let name = score.name();
            LabError::Asked(format!("the plot shows `{name}`, which is not in `score`"))
        })
    };
    let upwards = std::iter::once(&plot.y).chain(&plot.otherwise);
    let upwards: Vec<usize> = upwards.map(column).collect::<Result<_, _>>()?;
    let x = plot.x.as_ref().map(column).transpose()?;
    let shown = report.scenes.iter().filter_map(|table| {
        let has = |y: &usize| table.rows.iter().any(|row| mean(row, *y).is_some());
        Some((table, upwards.iter().copied().find(has)?))
    });
    let tables: Vec<Shown<'_>> = shown.collect();
    if tables.is_empty() {
        return Ok(false);
    }
    let mut picture = String::new();
    let drawn = match x {
        Some(x) => curves(report, &tables, x, plot.front, &mut picture),
        None => side_by_side(report, &tables, &mut picture),
    };
    drawn.map_err(|e| LabError::content(path, e))?;
    write_whole(path, &picture)?;
    Ok(true)
}

fn mean(row: &Row, score: usize) -> Option<Summary> {
    row.cells[score].mean
}

/// An area a panel, in two columns.
fn panels<'a>(area: &Area<'a>, count: usize) -> Vec<Area<'a>> {
    area.split_evenly((count.div_ceil(2), count.min(2)))
}

/// The size of so many panels, in two columns.
fn size(count: usize, (width, height): (u32, u32)) -> (u32, u32) {
    let lines = u32::try_from(count.div_ceil(2)).unwrap_or(1);
    (width * (1 + u32::from(count > 1)), height * lines)
}

/// The lowest and the highest of values, with a margin.
fn range(values: impl Iterator<Item = f64>, margin: f64) -> (f64, f64) {
    let (low, high) = values.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    let margin = margin * (high - low).max(1e-3 * high.abs()).max(1e-9);
    (low - margin, high + margin)
}

/// A value and what it would be one standard error less and more.
fn with_error(s: &Summary) -> [f64; 3] {
    let error = s.standard_error.unwrap_or(0.0);
    [s.mean - error, s.mean, s.mean + error]
}

/// Arms below each other, with their standard errors.
fn side_by_side(report: &Report, tables: &[Shown<'_>], picture: &mut String) -> Drawn {
    let most = tables.iter().map(|(t, _)| t.rows.len()).max().unwrap_or(1);
    let height = 70 + ROW * u32::try_from(most).unwrap_or(1);
    let names = tables.iter().flat_map(|(t, _)| &t.rows);
    let longest = names.map(|row| row.arm.chars().count()).max().unwrap_or(1);
    let label = 16 + LETTER * i32::try_from(longest.min(60)).unwrap_or(60);
    let width = WIDTH + label.unsigned_abs();
    let size = size(tables.len(), (width, height));
    let area = SVGBackend::with_string(picture, size).into_drawing_area();
    area.fill(&WHITE)?;
    for (panel, &(table, y)) in panels(&area, tables.len()).iter().zip(tables) {
        let rows: Vec<&Row> = table.rows.iter().collect();
        let values = rows.iter().filter_map(|row| mean(row, y));
        let (low, high) = range(values.flat_map(|s| with_error(&s)), 0.05);
        let bottom = rows.len() as f64 - 0.5;
        let mut chart = ChartBuilder::on(panel)
            .caption(&table.scene, ("sans-serif", 15))
            .margin(8)
            .margin_left(label)
            .x_label_area_size(32)
            .build_cartesian_2d(low..high, bottom..-0.5)?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .disable_y_axis()
            .x_labels(5)
            .x_desc(report.scores[y].heading())
            .light_line_style(WHITE)
            .draw()?;
        for (i, row) in rows.iter().enumerate() {
            let at = i as f64;
            let (_, pixel) = chart.backend_coord(&(low, at));
            let (_, top) = panel.get_base_pixel();
            let place = (label - 8, pixel - top);
            let style = ("sans-serif", 12).into_font().color(&BLACK);
            let style = style.pos(Pos::new(HPos::Right, VPos::Center));
            panel.draw(&Text::new(row.arm.clone(), place, style))?;
            if let Some(s) = mean(row, y) {
                let [less, middle, more] = with_error(&s);
                chart.draw_series([PathElement::new([(less, at), (more, at)], BLUE)])?;
                chart.draw_series([Circle::new((middle, at), 4, BLUE.filled())])?;
            }
        }
    }
    area.present()?;
    Ok(())
}

/// Quality against cost, every knob a curve through the arm that it is turned on.
fn curves(
    report: &Report,
    tables: &[Shown<'_>],
    x: usize,
    front: bool,
    picture: &mut String,
) -> Drawn {
    let mut knobs: Vec<&str> = Vec::new();
    for row in tables.iter().flat_map(|(table, _)| &table.rows) {
        if let Some(knob) = row.knob.as_deref().filter(|k| !knobs.contains(k)) {
            knobs.push(knob);
        }
    }
    let (width, height) = size(tables.len(), (WIDTH, HEIGHT));
    let area = SVGBackend::with_string(picture, (width, height + 34 + 9 * knobs.len() as u32));
    let area = area.into_drawing_area();
    area.fill(&WHITE)?;
    let (top, bottom) = area.split_vertically(height);
    for (panel, &(table, y)) in panels(&top, tables.len()).iter().zip(tables) {
        // Costs by their logarithms: an axis of plotters' own would have marks at powers of ten alone.
        let points: Vec<(&Row, f64, Summary)> = table
            .rows
            .iter()
            .filter_map(|row| Some((row, mean(row, x)?.mean.ln(), mean(row, y)?)))
            .filter(|(_, cost, _)| cost.is_finite())
            .collect();
        if points.is_empty() {
            continue;
        }
        let (left, right) = range(points.iter().map(|(_, cost, _)| *cost), 0.08);
        let (low, high) = range(points.iter().flat_map(|(.., s)| with_error(s)), 0.08);
        let mut chart = ChartBuilder::on(panel)
            .caption(&table.scene, ("sans-serif", 15))
            .margin(8)
            .x_label_area_size(34)
            .y_label_area_size(46)
            .build_cartesian_2d(left..right, low..high)?;
        chart
            .configure_mesh()
            .x_desc(report.scores[x].heading())
            .y_desc(report.scores[y].heading())
            .x_labels(6)
            .y_labels(6)
            .x_label_formatter(&|v| two_digits(v.exp()))
            .light_line_style(WHITE)
            .draw()?;
        if front {
            // Inputs are not chosen: neither the truth nor worse ones.
            let is_choice = |row: &Row| !row.is_given_truth && !row.is_perturbed;
            let choices = points.iter().filter(|(row, ..)| is_choice(row));
            let all: Vec<(f64, f64)> = choices.map(|(_, c, s)| (*c, s.mean)).collect();
            let best = pareto_front(&all).into_iter().map(|i| all[i]);
            let grey = BLACK.mix(0.25).stroke_width(4);
            chart.draw_series(LineSeries::new(best, grey))?;
        }
        for (i, knob) in knobs.iter().enumerate() {
            let color = Palette99::pick(i).to_rgba();
            let of_knob = points
                .iter()
                .filter(|(row, ..)| row.knob.as_deref() == Some(*knob));
            let of_knob: Vec<_> = of_knob.collect();
            let on = of_knob.first().and_then(|(row, ..)| row.against.as_deref());
            let on = points
                .iter()
                .filter(|(row, ..)| Some(row.arm.as_str()) == on);
            let mut line: Vec<(f64, f64)> = of_knob
                .iter()
                .copied()
                .chain(on)
                .map(|(_, cost, s)| (*cost, s.mean))
                .collect();
            line.sort_by(|a, b| a.0.total_cmp(&b.0));
            chart.draw_series(LineSeries::new(line, color.stroke_width(1)))?;
            for (_, cost, s) in of_knob {
                let [less, middle, more] = with_error(s);
                chart.draw_series([PathElement::new([(*cost, less), (*cost, more)], color)])?;
                chart.draw_series([Circle::new((*cost, middle), 3, color.filled())])?;
            }
        }
        for (row, cost, s) in points.iter().filter(|(row, ..)| row.knob.is_none()) {
            let [less, middle, more] = with_error(s);
            chart.draw_series([PathElement::new([(*cost, less), (*cost, more)], BLACK)])?;
            chart.draw_series([EmptyElement::at((*cost, middle))
                + Circle::new((0, 0), 4, BLACK.filled())
                + Text::new(row.arm.clone(), (7, -6), ("sans-serif", 12))])?;
        }
    }
    key(&bottom, &knobs, front)?;
    area.present()?;
    Ok(())
}

/// A number with two digits that count.
fn two_digits(value: f64) -> String {
    let digits = (1.0 - value.abs().log10().floor()).clamp(0.0, 9.0);
    format!("{value:.*}", digits as usize)
}

/// Which colour is which knob, two a line.
fn key(area: &Area<'_>, knobs: &[&str], front: bool) -> Drawn {
    let front = front.then_some("nothing beats these (Pareto front)");
    let entries = knobs.iter().copied().chain(front);
    for (i, name) in entries.enumerate() {
        let (column, line) = (i32::try_from(i % 2)?, i32::try_from(i / 2)?);
        let (left, top) = (54 + column * (WIDTH as i32 / 2 + 20), 10 + 18 * line);
        let style = if i < knobs.len() {
            Palette99::pick(i).to_rgba().stroke_width(2)
        } else {
            BLACK.mix(0.25).stroke_width(4)
        };
        area.draw(&PathElement::new([(left, top), (left + 22, top)], style))?;
        let text = Text::new(name, (left + 28, top - 6), ("sans-serif", 12));
        area.draw(&text)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{Cell, Origin};
    use std::collections::BTreeMap;

    fn row(arm: &str, knob: Option<&str>, cost: f64, quality: f64) -> Row {
        let cell = |value: f64| Cell {
            mean: Summary::of(&[value - 0.1, value + 0.1]),
            ..Cell::default()
        };
        Row {
            arm: arm.to_owned(),
            asks: String::new(),
            against: (arm != "base").then(|| "base".to_owned()),
            knob: knob.map(str::to_owned),
            is_given_truth: arm == "bound",
            is_perturbed: arm == "perturbed",
            scenes: 1,
            runs: 2,
            programs: BTreeMap::new(),
            processors: BTreeMap::new(),
            is_mixed: false,
            cells: vec![cell(cost), cell(quality)],
        }
    }

    fn report(scenes: usize) -> Report {
        let rows = vec![
            row("base", None, 10.0, 30.0),
            row("bound", None, 9.0, 35.0),
            row("perturbed", None, 9.5, 32.0),
            row("K = 3", Some("K"), 5.0, 28.0),
            row("K < 9", Some("K"), 20.0, 31.0),
        ];
        let table = |i: usize| SceneTable {
            scene: format!("scene-{i}"),
            rows: rows.clone(),
        };
        Report {
            study: "s".to_owned(),
            title: "S".to_owned(),
            about: String::new(),
            origin: Origin {
                version: "limpid 0".to_owned(),
                commit: None,
                changed: false,
                fingerprint: None,
                dates: None,
                machines: Vec::new(),
            },
            earlier: Vec::new(),
            planned: 8,
            finished: 8,
            failed: Vec::new(),
            seeds: vec![1, 2],
            baseline: "base".to_owned(),
            bound: Some("bound".to_owned()),
            scores: ["cpu", "all"]
                .map(|name| Score::from(name.to_owned()))
                .to_vec(),
            scenes: (0..scenes).map(table).collect(),
            overall: Vec::new(),
        }
    }

    #[test]
    fn a_picture_names_what_is_in_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.svg");
        let score = |name: &str| Score::from(name.to_owned());
        for x in [None, Some(score("cpu"))] {
            let plot = Plot {
                front: x.is_some(),
                x: x.clone(),
                y: score("all"),
                otherwise: None,
            };
            assert!(
                draw(&report(3), &plot, &path).expect("drawn"),
                "there are points"
            );
            let text = std::fs::read_to_string(&path).expect("a picture");
            let names = ["scene-0", "scene-2", "all, dB", "base", "bound"];
            let curves = ["processor, s", "K", "Pareto"];
            let arms = ["K = 3", "K &lt; 9"];
            let more = if x.is_some() { &curves[..] } else { &arms[..] };
            for name in names.iter().chain(more) {
                assert!(text.contains(name), "{name}");
            }
        }
    }

    #[test]
    fn a_front_is_of_what_can_be_chosen() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.svg");
        let score = |name: &str| Score::from(name.to_owned());
        let plot = Plot {
            x: Some(score("cpu")),
            y: score("all"),
            otherwise: None,
            front: true,
        };
        draw(&report(1), &plot, &path).expect("drawn");
        let text = std::fs::read_to_string(&path).expect("a picture");
        let wide = text
            .split("<polyline")
            .find(|l| l.contains("stroke-width=\"4\""));
        let points = wide.and_then(|line| line.split("points=\"").nth(1)?.split('"').next());
        let points = points.expect("a front").split_whitespace().count();
        assert_eq!(points, 3, "K = 3, base and K < 9: {text}");
    }

    #[test]
    fn without_runs_there_is_no_picture_and_a_score_must_be_there() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.svg");
        let plot = |y: &str| Plot {
            x: None,
            y: Score::from(y.to_owned()),
            otherwise: None,
            front: false,
        };
        let mut empty = report(1);
        for row in &mut empty.scenes[0].rows {
            row.cells = vec![Cell::default(), Cell::default()];
        }
        assert!(
            !draw(&empty, &plot("all"), &path).expect("nothing wrong"),
            "nothing"
        );
        let said = draw(&report(1), &plot("ssim"), &path).expect_err("no such column");
        assert!(said.to_string().contains("`ssim`"), "{said}");
    }

    #[test]
    fn a_scene_without_the_score_shows_the_other_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("p.svg");
        let score = |name: &str| Score::from(name.to_owned());
        let mut report = report(2);
        report.scores.push(score("psnr"));
        for (i, table) in report.scenes.iter_mut().enumerate() {
            for row in &mut table.rows {
                let psnr = row.cells[1].clone();
                row.cells.push(psnr);
                if i == 1 {
                    row.cells[1] = Cell::default();
                }
            }
        }
        for (otherwise, panels) in [(None, 1), (Some("psnr"), 2)] {
            let plot = Plot {
                x: Some(score("cpu")),
                y: score("all"),
                otherwise: otherwise.map(score),
                front: true,
            };
            assert!(draw(&report, &plot, &path).expect("drawn"), "points");
            let text = std::fs::read_to_string(&path).expect("a picture");
            let count = |what: &str| text.matches(what).count();
            assert_eq!(count("all, dB"), 1, "{otherwise:?}");
            assert_eq!(count("PSNR, dB"), panels - 1, "{otherwise:?}");
            assert_eq!(count("scene-1"), panels - 1, "{otherwise:?}");
        }
    }

    #[test]
    fn marks_have_two_digits() {
        for (value, text) in [
            (0.123, "0.12"),
            (7.39, "7.4"),
            (12.4, "12"),
            (1096.6, "1097"),
        ] {
            assert_eq!(two_digits(value), text);
        }
    }
}
