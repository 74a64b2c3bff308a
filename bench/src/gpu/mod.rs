//! On a GPU: what an iteration launches and waits for, and what it and its parts take.

use std::path::Path;

use serde::Serialize;
use trainer::Gpu;

pub mod adapter;
pub mod counted;
pub mod launches;
pub mod parts;
pub mod report;

type Failure = Box<dyn std::error::Error>;

/// The GPU that the program would take, too.
///
/// # Errors
/// The build lacks the runtime, or it reaches no GPU that is large enough.
pub fn open(runtime: &str) -> Result<Gpu, Failure> {
    let here = [
        ("wgpu", cfg!(feature = "wgpu")),
        ("cuda", cfg!(feature = "cuda")),
    ];
    if !here.contains(&(runtime, true)) {
        let how = format!("`cargo xtask bench --backend {runtime}` makes one that has it");
        return Err(format!("--backend {runtime}: this build lacks it; {how}").into());
    }
    let gpu = Gpu::best(runtime).map_err(|why| format!("--backend {runtime}: {why}"))?;
    eprintln!("on {}", gpu.name);
    Ok(gpu)
}

/// Writes results as JSON into a folder, which is made where there is none.
///
/// # Errors
/// It cannot be written.
pub fn write(results: &impl Serialize, folder: &Path, name: &str) -> Result<(), Failure> {
    std::fs::create_dir_all(folder)?;
    let text = serde_json::to_string_pretty(results)?;
    Ok(std::fs::write(folder.join(name), text)?)
}
