//! A report as Markdown.

use crate::report::{Cell, Origin, Report, Row};
use crate::score::{Kind, Score};
use crate::statistics::Summary;
use std::fmt::Write as _;

/// The whole report; `plot` is the name of its picture.
#[must_use]
pub fn markdown(report: &Report, plot: Option<&str>) -> String {
    let mut out = String::new();
    write_all(&mut out, report, plot).expect("a string takes text");
    out
}

fn write_all(out: &mut String, report: &Report, plot: Option<&str>) -> std::fmt::Result {
    writeln!(out, "# {}\n\n{}\n", report.title, report.about)?;
    writeln!(out, "    cargo xtask lab {}\n", report.study)?;
    writeln!(out, "{}", origins(report))?;
    writeln!(out, "{}", state(report))?;
    writeln!(out, "{}\n", legend(report))?;
    if let Some(plot) = plot {
        writeln!(out, "![{}]({plot})\n", report.title)?;
    }
    for table in &report.scenes {
        writeln!(out, "## `{}`\n", table.scene)?;
        head(out, "runs", &report.scores)?;
        for row in &table.rows {
            let cells = row.cells.iter().zip(&report.scores);
            let cells = cells.map(|(cell, score)| text(cell, score));
            write_row(out, row, row.runs, report, cells)?;
        }
        writeln!(out)?;
    }
    if report.scenes.len() > 1 {
        writeln!(out, "## Over all scenes\n")?;
        writeln!(
            out,
            "What is gained on each scene, averaged; the error is that of the seeds, and says nothing of other scenes. Behind a figure \
             that not all scenes of its row have stands of how many it is.\n"
        )?;
        head(out, "scenes", &report.scores)?;
        for row in report.overall.iter().filter(|row| row.against.is_some()) {
            let cells = row.cells.iter().zip(&report.scores);
            let cells =
                cells.map(|(cell, score)| gain(cell, score, Some(row.scenes)).unwrap_or_else(none));
            write_row(out, row, row.scenes, report, cells)?;
        }
        writeln!(out)?;
    }
    if !report.failed.is_empty() {
        writeln!(out, "## Runs that died\n")?;
        for run in &report.failed {
            let last = run.failed.last_lines.last().map_or("", String::as_str);
            writeln!(
                out,
                "- `{}`, {}, seed {} (`{}`): {}: {last}",
                run.scene, run.arm, run.seed, run.run, run.failed.how
            )?;
        }
    }
    while out.ends_with("\n\n") {
        out.pop();
    }
    Ok(())
}

/// Commit, date and machine.
fn origin(of: &Origin) -> String {
    let dates = match &of.dates {
        Some((first, last)) if first == last => format!(", {first}"),
        Some((first, last)) => format!(", {first} to {last}"),
        None => String::new(),
    };
    let machines: Vec<String> = of
        .machines
        .iter()
        .map(|m| {
            let cores = if m.cores == 1 { "core" } else { "cores" };
            format!("{}, {} {cores}", m.processor, m.cores)
        })
        .collect();
    let machines = match machines.len() {
        0 => String::new(),
        _ => format!(", on {}", machines.join("; ")),
    };
    of.program() + &dates + &machines
}

/// The same of all programs that made runs.
fn origins(report: &Report) -> String {
    let mut text = origin(&report.origin) + "; one thread a run.";
    for earlier in &report.earlier {
        write!(text, " Other runs: {}.", origin(earlier)).expect("a string takes text");
    }
    text
}

fn state(report: &Report) -> String {
    let (planned, finished) = (report.planned, report.finished);
    let failed = match report.failed.len() {
        0 => String::new(),
        n => format!(", and {n} died"),
    };
    if planned == finished {
        format!("All {planned} runs are finished.")
    } else {
        format!("**{finished} of {planned} runs are finished{failed}.**")
    }
}

fn legend(report: &Report) -> String {
    let seeds: Vec<String> = report.seeds.iter().map(u64::to_string).collect();
    let mut text = if seeds.len() > 1 {
        format!(
            "Means over seeds {} with their standard errors; in brackets what is gained against `{}` with the same seed \
             (of costs: how many times as much)",
            seeds.join(", "),
            report.baseline
        )
    } else {
        format!(
            "Seed {}; in brackets what is gained against `{}` (of costs: how many times as much)",
            seeds.join(", "),
            report.baseline
        )
    };
    text.push_str(", **bold** beyond two standard errors");
    if let Some(chance) = by_chance(seeds.len()) {
        write!(text, " (of gains that are nothing {chance} % would be)")
            .expect("a string takes text");
    }
    if let Some(bound) = &report.bound {
        write!(text, ", and the share of the way to `{bound}`").expect("a string takes text");
    }
    if report.overall.iter().any(|row| row.is_mixed) {
        write!(text, "; {MIXED} where runs of two programs are compared")
            .expect("a string takes text");
    }
    let mut cells = report.overall.iter().flat_map(|row| &row.cells);
    if cells.any(|cell| cell.is_elsewhere) {
        write!(
            text,
            "; {ELSEWHERE} where costs on two kinds of processor are compared, never bold"
        )
        .expect("a string takes text");
    }
    text.push('.');
    text
}

/// How many per cent of gains that are nothing, with normal noise, lie beyond two standard errors of so many seeds, which are
/// themselves estimated: the tails of Student's t beyond 2.
fn by_chance(seeds: usize) -> Option<usize> {
    let few = [30, 18, 14, 12, 10];
    few.get(seeds.checked_sub(2)?).copied()
}

/// Behind a row whose gains may be between two programs.
const MIXED: &str = "†";
/// Behind what a cost is compared with another processor's.
const ELSEWHERE: &str = "‡";

fn head(out: &mut String, counted: &str, scores: &[Score]) -> std::fmt::Result {
    write!(out, "| | {counted} |")?;
    for score in scores {
        write!(out, " {} |", score.heading())?;
    }
    write!(out, "\n|---|---|")?;
    writeln!(out, "{}", "---|".repeat(scores.len()))
}

fn write_row(
    out: &mut String,
    row: &Row,
    count: usize,
    report: &Report,
    cells: impl Iterator<Item = String>,
) -> std::fmt::Result {
    let against = match &row.against {
        Some(against) if *against != report.baseline => format!(", against {against}"),
        _ => String::new(),
    };
    let mixed = if row.is_mixed { MIXED } else { "" };
    let arm = row.arm.replace('|', "\\|");
    write!(out, "| {arm}{against}{mixed} | {count} |")?;
    for cell in cells {
        write!(out, " {cell} |")?;
    }
    writeln!(out)
}

fn none() -> String {
    "–".to_owned()
}

fn text(cell: &Cell, score: &Score) -> String {
    let Some(mean) = &cell.mean else {
        return none();
    };
    let value = number(mean, score.digits(), |v, digits| format!("{v:.digits$}"));
    match gain(cell, score, None) {
        Some(gain) => format!("{value} ({gain})"),
        None => value,
    }
}

/// What is gained, and the share of the way to the bound; in a row over so many scenes.
fn gain(cell: &Cell, score: &Score, scenes: Option<usize>) -> Option<String> {
    let gain = cell.gain?;
    let (text, is_clear) = match score.kind() {
        Kind::Quality | Kind::Finding => {
            let signed = |v: f64, digits: usize| format!("{v:+.digits$}");
            (number(&gain, score.digits(), signed), gain.is_clear())
        }
        Kind::Cost => {
            let from_one = Summary {
                mean: gain.mean - 1.0,
                ..gain
            };
            let times = |v: f64, digits: usize| format!("×{v:.digits$}");
            (number(&gain, 2, times), from_one.is_clear())
        }
    };
    let text = match (cell.is_elsewhere, is_clear) {
        (true, _) => text + ELSEWHERE,
        (false, true) => format!("**{text}**"),
        (false, false) => text,
    };
    let of = |figure: usize| {
        let count = cell.over.map(|over| over[figure]);
        let fewer = count.filter(|count| scenes.is_some_and(|all| *count < all));
        fewer.map_or_else(String::new, |count| format!(" (of {count})"))
    };
    let text = text + &of(0);
    Some(match &cell.closed {
        Some(closed) => format!("{text}; {:.0} %{}", 100.0 * closed.mean, of(1)),
        None => text,
    })
}

fn number(of: &Summary, digits: usize, write: impl Fn(f64, usize) -> String) -> String {
    let mean = write(of.mean, digits);
    match of.standard_error {
        Some(error) => format!("{mean} ± {error:.digits$}"),
        None => mean,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(values: &[f64]) -> Option<Summary> {
        Summary::of(values)
    }

    #[test]
    fn cells_say_mean_error_gain_and_share() {
        let score = |name: &str| Score::from(name.to_owned());
        let cell = Cell {
            mean: summary(&[31.0, 31.5]),
            gain: summary(&[5.0, 5.5]),
            closed: summary(&[0.8, 0.84]),
            ..Cell::default()
        };
        assert_eq!(
            text(&cell, &score("all")),
            "31.25 ± 0.25 (**+5.25 ± 0.25**; 82 %)"
        );
        let unclear = Cell {
            mean: summary(&[31.0]),
            gain: summary(&[-0.1]),
            ..Cell::default()
        };
        assert_eq!(text(&unclear, &score("all")), "31.00 (-0.10)");
        let cost = Cell {
            mean: summary(&[100.0, 102.0]),
            gain: summary(&[1.02, 0.98]),
            ..Cell::default()
        };
        assert_eq!(text(&cost, &score("seconds")), "101.0 ± 1.0 (×1.00 ± 0.02)");
        let dear = Cell {
            gain: summary(&[2.0, 2.1]),
            ..cost
        };
        assert_eq!(
            text(&dear, &score("seconds")),
            "101.0 ± 1.0 (**×2.05 ± 0.05**)"
        );
        let elsewhere = Cell {
            is_elsewhere: true,
            ..dear.clone()
        };
        assert_eq!(
            text(&elsewhere, &score("seconds")),
            "101.0 ± 1.0 (×2.05 ± 0.05‡)"
        );
        assert_eq!(text(&Cell::default(), &score("all")), "–");
        let over = Cell {
            over: Some([7, 4]),
            ..cell
        };
        assert_eq!(
            gain(&over, &score("all"), Some(7)).as_deref(),
            Some("**+5.25 ± 0.25**; 82 % (of 4)")
        );
        assert_eq!(
            text(
                &Cell {
                    mean: summary(&[0.5]),
                    ..Cell::default()
                },
                &score("shutter")
            ),
            "0.5000"
        );
    }
}
