//! What an iteration launches on a GPU and waits for: the least times in docs/PERFORMANCE.md rest on it.
#![cfg(feature = "wgpu")]

use std::io::Write as _;
use std::sync::{Mutex, MutexGuard, PoisonError};

use limpid_bench::gpu::launches::count_launches;
use limpid_bench::gpu::report::time_all;
use limpid_bench::spans::Stages;
use trainer::Gpu;

/// Launches are counted for the whole program: one test at a time.
static ALONE: Mutex<()> = Mutex::new(());

/// The adapter, where there is one, for a test that has it to itself.
fn gpu(test: &str) -> Option<(Gpu, MutexGuard<'static, ()>)> {
    let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let gpu = Gpu::best("wgpu")
        .inspect_err(|why| {
            let line = format!("skipped: {test}: {why}\n");
            std::io::stderr().write_all(line.as_bytes()).ok();
        })
        .ok()?;
    Some((gpu, alone))
}

#[test]
fn all_is_timed_and_said_with_what_it_was_timed_on() {
    let Some((gpu, _alone)) = gpu("times of a GPU") else {
        return;
    };
    let stages = Stages::default();
    let report =
        tracing::subscriber::with_default(stages.clone(), || time_all(&gpu, &stages, true));
    let parts = report.parts.iter().map(|part| {
        let ms = part.outcome.timed().map(|times| times.median_ms);
        (&part.name, ms)
    });
    let iterations = report.iterations.iter().map(|iteration| {
        let ms = iteration.outcome.timed().map(|i| i.alone.median_ms);
        (&iteration.name, ms)
    });
    assert!(parts.len() > 2, "{:?}", report.parts);
    assert_eq!(iterations.len(), 3, "without blur, kernels, camera");
    for (name, ms) in parts.chain(iterations) {
        assert!(ms.is_some_and(|ms| ms > 0.0), "{name}: {ms:?}");
    }
    assert!(report.goals.is_empty(), "goals are of full sizes");
    assert_eq!(report.adapter.software, gpu.is_software);
    let tables = report.tables().expect("tables");
    assert!(tables.contains(&gpu.name), "{tables}");
    assert_eq!(tables.contains("SOFTWARE"), gpu.is_software, "{tables}");
}

#[test]
fn an_iteration_launches_and_waits_no_more_than_its_least_time_says() {
    let Some((gpu, _alone)) = gpu("launches of an iteration") else {
        return;
    };
    let stages = Stages::default();
    // Sizes change only how many sums and digits a sort has.
    let counted = tracing::subscriber::with_default(stages.clone(), || {
        count_launches(&gpu, &stages, [64, 36], 1000)
    });
    let counted = counted.expect("iterations").iterations;
    assert_eq!(counted.len(), 3);
    // Without a blur model, with kernels, with the camera: a render each, which is waited for once, and an account at the end;
    // the camera has an exposure too, and reads what its path is.
    for (iteration, (launches, waits)) in counted.iter().zip([(130, 2), (330, 2), (290, 4)]) {
        let found = &iteration.counted;
        assert!(
            found.launches <= launches,
            "{}: {} launches, {:#?}",
            iteration.blur,
            found.launches,
            found.kernels
        );
        assert_eq!(found.waits, waits, "{}: waits", iteration.blur);
    }
}
