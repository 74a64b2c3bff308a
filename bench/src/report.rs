//! Results as JSON, as tables and as plots.

use std::fmt::Write as _;
use std::path::Path;

use plotters::prelude::*;
use serde::Serialize;

use crate::growth::{Growth, Point};
use crate::iteration::Breakdown;
use crate::machine::Machine;

/// Everything that a run measured.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The machine's peaks.
    pub machine: Machine,
    /// Iterations, stage by stage.
    pub iterations: Vec<Breakdown>,
    /// Sweeps.
    pub growth: Vec<Growth>,
}

impl Report {
    /// Writes `bench.json`, `bench.md` and a plot for each sweep into a folder.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), Box<dyn std::error::Error>> {
        std::fs::create_dir_all(folder)?;
        std::fs::write(
            folder.join("bench.json"),
            serde_json::to_string_pretty(self)?,
        )?;
        std::fs::write(folder.join("bench.md"), self.tables()?)?;
        for growth in &self.growth {
            let name = match growth.axis {
                "K²" => "kernel",
                axis => axis,
            };
            plot(growth, &folder.join(format!("{}.svg", name.to_lowercase())))?;
        }
        Ok(())
    }

    /// All tables in Markdown.
    ///
    /// # Errors
    /// None: writing into a string cannot fail, but its interface says it could.
    pub fn tables(&self) -> Result<String, std::fmt::Error> {
        let m = &self.machine;
        let mut out = format!(
            "{} threads; at most {:.0} GFLOP/s in registers, {:.1} GB/s copying\n",
            m.threads, m.gflops, m.gigabytes
        );
        for b in &self.iterations {
            table(&mut out, b)?;
        }
        for g in &self.growth {
            write!(
                out,
                "\n{}: {}\n\n| {} | ms | MiB |\n|---|---|---|\n",
                g.axis, g.fixed, g.axis
            )?;
            for p in &g.points {
                let mib = p.mib.map_or_else(|| "–".to_owned(), |v| format!("{v:.0}"));
                writeln!(out, "| {} | {:.1} | {mib} |", p.size, p.ms)?;
            }
            let memory = g.memory_exponent;
            let memory = memory.map_or_else(|| "–".to_owned(), |v| format!("{v:.2}"));
            writeln!(
                out,
                "\nUpper half: time grows with the power {:.2}, memory with {memory}.",
                g.time_exponent
            )?;
        }
        Ok(out)
    }
}

fn table(out: &mut String, b: &Breakdown) -> std::fmt::Result {
    let floor = b
        .floor_ms
        .map_or_else(String::new, |f| format!(", floor {f:.1} ms"));
    write!(
        out,
        "\n{}: median {:.1} ms, fastest {:.1} ms of {}{floor}; {:.0} % outside splatting and blur model\n\n\
         | stage | ms | share | MFLOP | MB | of the floor |\n|---|---|---|---|---|---|\n",
        b.name,
        b.median_ms,
        b.fastest_ms,
        b.iterations,
        100.0 * b.rest_share
    )?;
    let mega = |v: Option<f64>| v.map_or_else(String::new, |v| format!("{:.1}", v * 1e-6));
    for s in b.stages.iter().filter(|s| s.ms >= 0.01) {
        let of_floor = s
            .of_floor
            .map_or_else(String::new, |v| format!("{:.0} %", 100.0 * v));
        writeln!(
            out,
            "| {} | {:.2} | {:.1} % | {} | {} | {of_floor} |",
            s.name,
            s.ms,
            100.0 * s.share,
            mega(s.operations),
            mega(s.bytes)
        )?;
    }
    Ok(())
}

/// Time and memory on logarithmic axes, each beside a straight line of slope 1 through its last point.
fn plot(growth: &Growth, path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::new(path, (760, 320)).into_drawing_area();
    area.fill(&WHITE)?;
    let (left, right) = area.split_horizontally(380);
    let time = |p: &Point| Some(p.ms);
    panel(&left, growth, "ms an iteration", time)?;
    panel(&right, growth, "MiB at most", |p| p.mib)?;
    area.present()?;
    Ok(())
}

fn panel(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    growth: &Growth,
    title: &str,
    value: impl Fn(&Point) -> Option<f64>,
) -> Result<(), Box<dyn std::error::Error>> {
    let points: Vec<(f64, f64)> = growth
        .points
        .iter()
        .filter_map(|p| Some((p.size, value(p)?)))
        .collect();
    let (Some(&first), Some(&last)) = (points.first(), points.last()) else {
        return Ok(());
    };
    let lowest = points.iter().fold(f64::MAX, |m, p| m.min(p.1));
    let highest = points.iter().fold(0.0_f64, |m, p| m.max(p.1));
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 16))
        .margin(8)
        .x_label_area_size(36)
        .y_label_area_size(52)
        .build_cartesian_2d(
            (first.0..last.0 * 1.2).log_scale(),
            (lowest * 0.7..highest * 1.4).log_scale(),
        )?;
    chart
        .configure_mesh()
        .x_desc(growth.axis)
        .x_labels(6)
        .y_labels(6)
        .x_label_formatter(&|v| format!("{v:.0}"))
        .y_label_formatter(&|v| format!("{v:.0}"))
        .light_line_style(WHITE)
        .draw()?;
    // Linear growth, as far as it stays in the picture.
    let start = first.0.max(last.0 * lowest * 0.7 / last.1);
    let linear = [(start, last.1 * start / last.0), last];
    chart.draw_series(LineSeries::new(linear, BLACK.mix(0.35)))?;
    chart.draw_series(LineSeries::new(points.clone(), &BLUE))?;
    chart.draw_series(points.iter().map(|p| Circle::new(*p, 3, BLUE.filled())))?;
    Ok(())
}
