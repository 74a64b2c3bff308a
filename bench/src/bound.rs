//! The least time of an iteration on a GPU: computed from what it launches, moves, computes and waits for, and not measured.

use serde::Serialize;

use crate::floor::Work;

/// A GPU by its data sheet, and what drives it.
#[derive(Clone, Copy, Debug)]
pub struct Card {
    /// Its name.
    pub name: &'static str,
    /// What its adapter's name has in it.
    pub adapter: &'static str,
    /// What launches kernels on it.
    pub runtime: &'static str,
    /// Peak of its memory, GB/s.
    pub gigabytes: f64,
    /// Peak of f32 outside of tensor cores, TFLOP/s.
    pub teraflops: f64,
    /// What a launch costs at least and at most, µs.
    pub launch_us: [f64; 2],
}

/// What a launch costs by CUDA, µs. An assumption.
const CUDA_US: [f64; 2] = [5.0, 5.0];
/// Through wgpu, µs. The most: a dispatch by WebGPU on Vulkan, 24 to 36, and on Metal, 32 to 71 (arXiv:2604.02344, abstract). The
/// least is an assumption: CubeCL submits many dispatches at once.
const VULKAN_US: [f64; 2] = [10.0, 36.0];
const METAL_US: [f64; 2] = [10.0, 71.0];

/// What the host waits at least and at most beyond the work itself when it reads something back, µs. An assumption.
pub const WAIT_US: [f64; 2] = [30.0, 100.0];

/// GPUs that a bound is given for.
pub const CARDS: [Card; 5] = [
    card(["H100 SXM", "H100"], "CUDA", 3350.0, 67.0, CUDA_US),
    card(
        ["H100 SXM", "H100"],
        "wgpu, Vulkan",
        3350.0,
        67.0,
        VULKAN_US,
    ),
    card(["RTX 3090"; 2], "CUDA", 936.0, 35.6, CUDA_US),
    card(["RTX 3090"; 2], "wgpu, Vulkan", 936.0, 35.6, VULKAN_US),
    card(["M3 Max"; 2], "wgpu, Metal", 400.0, 14.0, METAL_US),
];

const fn card(
    [name, adapter]: [&'static str; 2],
    runtime: &'static str,
    gigabytes: f64,
    teraflops: f64,
    launch_us: [f64; 2],
) -> Card {
    Card {
        name,
        adapter,
        runtime,
        gigabytes,
        teraflops,
        launch_us,
    }
}

/// The least time of an iteration and its parts, ms; pairs are with the least and the most that is assumed.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Bound {
    /// See [`Card::name`].
    pub card: &'static str,
    /// See [`Card::runtime`].
    pub runtime: &'static str,
    /// Of every stage the longer of moving its bytes and doing its operations.
    pub work_ms: f64,
    /// Launching.
    pub launch_ms: [f64; 2],
    /// Waiting.
    pub wait_ms: [f64; 2],
    /// Work and launches overlap, waits do not.
    pub total_ms: [f64; 2],
}

impl Card {
    /// The card that an adapter of this name is, as a runtime (`wgpu` or `cuda`) drives it; `None` for one that no bound is given for.
    #[must_use]
    pub fn of(adapter: &str, runtime: &str) -> Option<&'static Self> {
        CARDS.iter().find(|card| {
            adapter.contains(card.adapter) && card.runtime.to_lowercase().starts_with(runtime)
        })
    }

    /// The bound of an iteration that does this work, stage by stage, in so many launches, and waits so often.
    #[must_use]
    pub fn bound(&self, work: &[Work], launches: usize, waits: usize) -> Bound {
        let stage = |w: &Work| {
            let moving = w.bytes / (self.gigabytes * 1e6);
            moving.max(w.operations / (self.teraflops * 1e9))
        };
        let work_ms: f64 = work.iter().map(stage).sum();
        let launch_ms = self.launch_us.map(|us| us * 1e-3 * launches as f64);
        let wait_ms = WAIT_US.map(|us| us * 1e-3 * waits as f64);
        Bound {
            card: self.name,
            runtime: self.runtime,
            work_ms,
            launch_ms,
            wait_ms,
            total_ms: [0, 1].map(|i| launch_ms[i].max(work_ms) + wait_ms[i]),
        }
    }
}

/// From least to most, ms.
#[must_use]
pub fn range([from, to]: [f64; 2]) -> String {
    let (from, to) = (format!("{from:.1}"), format!("{to:.1}"));
    if from == to {
        from
    } else {
        format!("{from} to {to}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::floor::work_of;
    use crate::workload::{Blur, Workload};

    /// Cells of the rows of a Markdown table that begins with this line.
    fn rows(text: &str, header: &str) -> Vec<Vec<String>> {
        let lines = text.lines().skip_while(|line| !line.starts_with(header));
        let table = lines.skip(2).take_while(|line| line.starts_with('|'));
        let cells = |line: &str| -> Vec<String> {
            let cells = line.trim_matches('|').split('|');
            cells.map(|cell| cell.trim().to_owned()).collect()
        };
        table.map(cells).collect()
    }

    /// What docs/PERFORMANCE.md computes, from the launches and waits that it has counted.
    #[test]
    fn the_least_times_that_are_told_follow_from_what_was_counted() {
        let text = include_str!("../../docs/PERFORMANCE.md");
        let counted = rows(text, "| | launches | waits |");
        let told = rows(text, "| ms | | no blur model |");
        assert_eq!((counted.len(), told.len()), (3, 8), "tables of the docs");
        let number = |cell: &str| -> usize { cell.replace(',', "").parse().expect("a number") };
        let blurs = [Blur::Off, Blur::Trained, Blur::Camera];
        for (column, (blur, row)) in blurs.into_iter().zip(&counted).enumerate() {
            let workload = Workload {
                width: 512,
                height: 288,
                gaussians: 100_000,
                blur,
                kernel_size: 9,
            };
            let works = work_of(&workload);
            let megabytes = works.iter().map(|w| w.bytes).sum::<f64>() * 1e-6;
            let operations = works.iter().map(|w| w.operations).sum::<f64>() * 1e-9;
            assert_eq!(number(&row[3]), megabytes.round() as usize, "{row:?}");
            assert_eq!(row[4], format!("{operations:.1}"), "{row:?}");
            // Of each card its work, and then what each runtime adds up to.
            let (mut expected, mut last) = (Vec::new(), "");
            for card in &CARDS {
                let bound = card.bound(&works, number(&row[1]), number(&row[2]));
                if card.name != last {
                    expected.push(format!("{:.2}", bound.work_ms));
                    last = card.name;
                }
                expected.push(range(bound.total_ms));
            }
            let told: Vec<&str> = told.iter().map(|line| &*line[2 + column]).collect();
            assert_eq!(told, expected, "{row:?}");
        }
    }

    #[test]
    fn a_card_is_known_by_its_adapter_and_its_runtime() {
        let of =
            |adapter, runtime| Card::of(adapter, runtime).map(|card| (card.name, card.runtime));
        assert_eq!(
            of("NVIDIA H100 80GB HBM3", "cuda"),
            Some(("H100 SXM", "CUDA"))
        );
        let through_vulkan = of("NVIDIA GeForce RTX 3090", "wgpu");
        assert_eq!(through_vulkan, Some(("RTX 3090", "wgpu, Vulkan")));
        assert_eq!(of("SwiftShader Device (Subzero)", "wgpu"), None);
    }

    #[test]
    fn launches_hide_behind_work_and_waits_do_not() {
        let card = card(["a card"; 2], "a runtime", 1000.0, 10.0, [5.0, 10.0]);
        // 2 ms of moving, though it computes for 1 ms, and then 3 ms of computing.
        let work = [(1e10, 2e9), (3e10, 1e9)].map(|(operations, bytes)| Work { operations, bytes });
        let bound = card.bound(&work, 800, 10);
        assert!((bound.work_ms - 5.0).abs() < 1e-9, "{bound:?}");
        assert_eq!(bound.launch_ms, [4.0, 8.0], "of 800 launches");
        let expected = [5.0 + 0.3, 8.0 + 1.0];
        for (found, expected) in bound.total_ms.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-9, "{bound:?}");
        }
    }
}
