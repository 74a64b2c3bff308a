//! How time and memory grow with Gaussians, pixels and kernel size: each point in a process of its own, so that
//! its peak of memory is its own.

use std::process::Command;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use trainer::Device;

use crate::workload::{Blur, Workload};

/// What comes out of a process that timed one workload.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Point {
    /// Gaussians, pixels or K².
    pub size: f64,
    /// Median of an iteration, ms.
    pub ms: f64,
    /// The most memory that was resident, MiB; `None` where the system does not say.
    pub mib: Option<f64>,
}

/// One sweep.
#[derive(Clone, Debug, Serialize)]
pub struct Growth {
    /// What grows.
    pub axis: &'static str,
    /// What stays.
    pub fixed: String,
    /// By size.
    pub points: Vec<Point>,
    /// Exponent of the time over the upper half of the sweep: 1 is linear.
    pub time_exponent: f64,
    /// Exponent of the memory there.
    pub memory_exponent: Option<f64>,
}

const ORDINARY: Workload = Workload {
    width: 256,
    height: 144,
    gaussians: 20_000,
    blur: Blur::Trained,
    kernel_size: 9,
};

/// The three sweeps.
///
/// # Errors
/// A process fails, or says something else than a point.
pub fn sweeps(quick: bool) -> Result<Vec<Growth>, Box<dyn std::error::Error>> {
    let gaussians: &[usize] = if quick {
        &[1_000, 10_000, 100_000]
    } else {
        &[1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000]
    };
    let widths: &[usize] = if quick {
        &[64, 128, 256]
    } else {
        &[64, 128, 256, 512, 1024]
    };
    let kernels: &[usize] = if quick {
        &[1, 9, 15]
    } else {
        &[1, 3, 5, 7, 9, 11, 13, 15]
    };
    let off = Workload {
        blur: Blur::Off,
        ..ORDINARY
    };
    Ok(vec![
        sweep(
            "Gaussians",
            "256x144, blur off",
            gaussians
                .iter()
                .map(|&gaussians| (gaussians as f64, Workload { gaussians, ..off })),
        )?,
        sweep(
            "pixels",
            "20,000 Gaussians, blur on, K = 9",
            widths.iter().map(|&width| {
                let height = width * 9 / 16;
                let workload = Workload {
                    width,
                    height,
                    ..ORDINARY
                };
                ((width * height) as f64, workload)
            }),
        )?,
        sweep(
            "K²",
            "256x144, 20,000 Gaussians, blur on",
            kernels.iter().map(|&kernel_size| {
                let workload = Workload {
                    kernel_size,
                    ..ORDINARY
                };
                ((kernel_size * kernel_size) as f64, workload)
            }),
        )?,
    ])
}

fn sweep(
    axis: &'static str,
    fixed: &str,
    workloads: impl Iterator<Item = (f64, Workload)>,
) -> Result<Growth, Box<dyn std::error::Error>> {
    let mut points = Vec::new();
    for (size, workload) in workloads {
        let output = Command::new(std::env::current_exe()?)
            .arg("point")
            .args(
                [
                    workload.width,
                    workload.height,
                    workload.gaussians,
                    workload.kernel_size,
                    usize::from(workload.blur != Blur::Off),
                ]
                .map(|v| v.to_string()),
            )
            .output()?;
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            return Err(format!("{axis} {size}: {message}").into());
        }
        let point: Point = serde_json::from_slice(&output.stdout)?;
        points.push(Point { size, ..point });
    }
    let upper = &points[points.len() / 2..];
    let (first, last) = (upper[0], upper[upper.len() - 1]);
    let exponent = |a: f64, b: f64| (b / a).ln() / (last.size / first.size).ln();
    Ok(Growth {
        axis,
        fixed: fixed.to_owned(),
        time_exponent: exponent(first.ms, last.ms),
        memory_exponent: first.mib.zip(last.mib).map(|(a, b)| exponent(a, b)),
        points,
    })
}

/// Times a few iterations in this process.
///
/// # Errors
/// The trainer refuses the workload.
pub fn time_point(workload: &Workload) -> Result<Point, trainer::TrainError> {
    let mut trainer = workload.trainer(&Device::flex())?;
    // Blur begins after 50 iterations; the two behind it warm up.
    let first = if workload.blur == Blur::Off { 3 } else { 52 };
    for _ in 0..first {
        trainer.step()?;
    }
    let mut times = Vec::new();
    for _ in 0..9 {
        let start = Instant::now();
        trainer.step()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok(Point {
        size: 0.0,
        ms: times[times.len() / 2],
        mib: peak_mib(),
    })
}

/// The most memory of this process that was resident, where the system tells.
fn peak_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}
