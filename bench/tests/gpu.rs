//! What an iteration launches on a GPU and waits for: the least times in docs/PERFORMANCE.md rest on it.
#![cfg(feature = "wgpu")]

use std::io::Write as _;

use limpid_bench::gpu::launches::count_launches;
use limpid_bench::spans::Stages;
use trainer::Gpu;

#[test]
fn an_iteration_launches_and_waits_no_more_than_its_least_time_says() {
    let gpu = match Gpu::best("wgpu") {
        Ok(gpu) => gpu,
        Err(why) => {
            let line = format!("skipped: launches of an iteration: {why}\n");
            std::io::stderr().write_all(line.as_bytes()).ok();
            return;
        }
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
    for (iteration, (launches, waits)) in counted.iter().zip([(210, 2), (410, 2), (400, 4)]) {
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
