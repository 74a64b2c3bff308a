#![allow(clippy::print_stdout)]
use limpid_bench::spans::Stages;
use limpid_bench::workload::{Blur, Workload};
use std::time::Instant;
use trainer::Device;
#[global_allocator]
static GLOBAL: mimalloc::MiMalloc = mimalloc::MiMalloc;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let n = |k: usize, d: usize| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(d);
    let blur = match args.get(1).map(String::as_str) {
        Some("trained") => Blur::Trained,
        Some("frozen") => Blur::Frozen,
        Some("half") => Blur::Half,
        _ => Blur::Off,
    };
    let w = Workload {
        width: n(2, 256),
        height: n(3, 144),
        gaussians: n(4, 20_000),
        blur,
        kernel_size: n(5, 9),
    };
    let count = n(6, 30);
    let stages = Stages::default();
    tracing::subscriber::set_global_default(stages.clone()).expect("first");
    let mut t = w.trainer(&Device::flex()).expect("good");
    while t.iteration() + 1 < w.first_full_iteration() {
        t.step().expect("step");
    }
    let _ = stages.take();
    let mut times = Vec::new();
    for _ in 0..count {
        let s = Instant::now();
        t.step().expect("step");
        times.push(s.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    println!(
        "{w:?}: median {:.2} fastest {:.2}",
        times[times.len() / 2],
        times[0]
    );
    let mut st: Vec<_> = stages.take().into_iter().collect();
    st.sort_by_key(|(_, s)| std::cmp::Reverse(s.time));
    for (name, s) in st {
        println!(
            "{name:28} {:8.3} ms  x{}",
            s.time.as_secs_f64() * 1e3 / count as f64,
            s.count / count
        );
    }
}
