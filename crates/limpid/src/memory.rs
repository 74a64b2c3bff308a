//! Whether memory will do, before a run finds out.

use crate::config::Config;
use crate::say::say;
use std::fs;
use std::path::Path;
use trainer::{Gpu, MemoryNeed, Trainer};

/// What trials and the report take besides, about: whole runs of the studies took 30 to 150 MiB more than training is said to.
const BESIDES: u64 = 40 << 20;
/// No picture is made smaller than by this.
const LARGEST_FACTOR: usize = 64;

/// Warns where a run may take more than there is, and says what makes it smaller.
pub(crate) fn warn(trainer: &Trainer, config: &Config) {
    let downscale = config.run.factor();
    if config.run.backend.is_cpu() {
        warn_of_all(trainer, downscale);
    } else if let Ok(gpu) = Gpu::best(config.run.backend.name()) {
        warn_of_a_table(trainer, &gpu, downscale);
    }
}

/// Of more main memory than the system will give. Says nothing where the system does not tell.
fn warn_of_all(trainer: &Trainer, downscale: usize) {
    let (most, need) = (trainer.most_gaussians(), need_at(trainer, 1.0));
    let Some((given, by)) = given() else {
        return;
    };
    let total_at = |share: f64| need_at(trainer, share).total();
    let up_to = if trainer.limits_gaussians() {
        "up to"
    } else {
        "today's"
    };
    if let Some(advice) = advice(total_at, given, downscale) {
        say!(
            "warning: training may take {} MiB of memory ({} for the program, {} for the pictures, {} for {up_to} {most} Gaussians, {} for a \
             view and its blur), and there are {} MiB ({by}): {advice}",
            mib(need.total()),
            mib(need.program),
            mib(need.pictures),
            mib(need.gaussians),
            mib(need.view),
            mib(given)
        );
    }
}

/// Of a larger table than a GPU's buffers hold.
fn warn_of_a_table(trainer: &Trainer, gpu: &Gpu, downscale: usize) {
    let bytes_at = |share: f64| trainer.largest_table_at(share).bytes;
    if let Some(advice) = advice(bytes_at, gpu.largest_buffer, downscale) {
        let table = trainer.largest_table_at(1.0);
        say!(
            "warning: training may make a table of {} MiB ({}), and a buffer of {} holds {}: {advice}",
            mib(table.bytes),
            table.name,
            gpu.name,
            mib(gpu.largest_buffer)
        );
    }
}

/// In MiB, as people are told.
pub(crate) fn mib(bytes: u64) -> u64 {
    bytes >> 20
}

/// Bytes of main memory that a run takes at its peak, about; `None` where tensors live elsewhere.
pub(crate) fn expected(trainer: &Trainer, config: &Config) -> Option<u64> {
    let total = || need_at(trainer, 1.0).total();
    config.run.backend.is_cpu().then(total)
}

/// What training takes with pictures that have this share of the pixels, and the program with what it takes besides.
fn need_at(trainer: &Trainer, share: f64) -> MemoryNeed {
    let need = trainer.memory_need_at(share);
    MemoryNeed {
        program: need.program + BESIDES,
        ..need
    }
}

/// What makes a need fit into what is given; `None` where it fits. `need` is that of pictures with a share of the pixels.
fn advice(need: impl Fn(f64) -> u64, given: u64, downscale: usize) -> Option<String> {
    if need(1.0) <= given {
        return None;
    }
    let share = |factor: usize| (downscale as f64 / factor as f64).powi(2);
    let mut factors = downscale + 1..=LARGEST_FACTOR;
    let fits = match factors.find(|factor| need(share(*factor)) <= given) {
        Some(factor) => format!("--downscale {factor} would fit, about"),
        None => "no --downscale would do by itself".to_owned(),
    };
    Some(format!(
        "{fits}; lower `gaussians.max_per_pixel` and `gaussians.initial_static_per_pixel`, fewer `camera.samples` and, with kernels, \
         `blur.downscale = 2` take less too"
    ))
}

/// Bytes that this process may have in all, and who says so; the least of what Linux tells, elsewhere nothing.
fn given() -> Option<(u64, &'static str)> {
    let read = |path: &str| fs::read_to_string(path).ok();
    let own = read("/proc/self/status").and_then(|text| kib(&text, "VmRSS:"));
    let free = read("/proc/meminfo").and_then(|text| kib(&text, "MemAvailable:"));
    let limits = read("/proc/self/limits").and_then(|text| address_space(&text));
    let group = read("/proc/self/cgroup").and_then(|text| group_limit(&text));
    let found = [
        // What it has already is no longer free.
        (
            free.map(|free| free + own.unwrap_or(0)),
            "free on this machine",
        ),
        (limits, "the limit of its address space, `ulimit -v`"),
        (group, "the limit of its control group"),
    ];
    let found = found
        .into_iter()
        .filter_map(|(bytes, by)| Some((bytes?, by)));
    found.min_by_key(|(bytes, _)| *bytes)
}

/// A line `KEY 123 kB`, in bytes.
fn kib(text: &str, key: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    let number: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    number.checked_mul(1024)
}

/// The soft limit in `/proc/self/limits`; `None` without one.
fn address_space(text: &str) -> Option<u64> {
    let line = text
        .lines()
        .find_map(|l| l.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// The least limit of the control group that `/proc/self/cgroup` names, of either version, and of those that hold it; `None` without
/// one.
fn group_limit(text: &str) -> Option<u64> {
    let root = Path::new("/sys/fs/cgroup");
    let groups = text.lines().filter_map(|line| {
        let (_, rest) = line.split_once(':')?;
        let (controllers, path) = rest.split_once(':')?;
        match controllers {
            "" => Some((root.to_owned(), "memory.max", path)),
            "memory" => Some((root.join("memory"), "memory.limit_in_bytes", path)),
            _ => None,
        }
    });
    let limits = groups.filter_map(|(root, file, path)| least_limit(&root, file, path));
    limits.min()
}

/// The least number in files of this name in the folder `path` below `root` and in those that hold it, `root` with them: a scheduler
/// limits a job, and the process is in a group of its own within.
fn least_limit(root: &Path, file: &str, path: &str) -> Option<u64> {
    let groups = Path::new(path.trim_start_matches('/')).ancestors();
    let limits = groups.filter_map(|group| {
        let limit = fs::read_to_string(root.join(group).join(file)).ok()?;
        limit.trim().parse().ok()
    });
    limits.min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_system_says_is_read() {
        let meminfo = "MemTotal:       100 kB\nMemAvailable:    50 kB\n";
        assert_eq!(kib(meminfo, "MemAvailable:"), Some(50 << 10));
        assert_eq!(kib(meminfo, "MemFree:"), None);
        assert_eq!(kib("VmRSS: many kB", "VmRSS:"), None);
        let limits = |soft: &str| {
            format!(
                "Max cpu time  1 2 seconds\nMax address space         {soft}  unlimited  bytes\n"
            )
        };
        assert_eq!(address_space(&limits("4096")), Some(4096));
        assert_eq!(address_space(&limits("unlimited")), None);
        assert_eq!(group_limit("0::/no/such/group\nnonsense\n"), None);
    }

    #[test]
    fn a_limit_of_any_group_that_holds_this_one_counts() {
        let root = tempfile::tempdir().expect("a folder");
        let put = |group: &str, limit: &str| {
            let folder = root.path().join(group);
            fs::create_dir_all(&folder).expect("a group");
            fs::write(folder.join("memory.max"), limit).expect("its limit");
        };
        put("jobs/1/task", "max\n");
        put("jobs/1", "4096\n");
        put("jobs", "8192\n");
        let of = |path: &str| least_limit(root.path(), "memory.max", path);
        assert_eq!(of("/jobs/1/task"), Some(4096));
        assert_eq!(
            of("/jobs/2"),
            Some(8192),
            "there is no such group, but one that holds it"
        );
        assert_eq!(of("/"), None);
    }

    #[test]
    fn a_need_that_does_not_fit_comes_with_a_size_that_does() {
        // A part that no picture makes smaller, and one that its pixels make.
        let of = |fixed: f64, pixels: f64| move |share: f64| (fixed + pixels * share) as u64;
        assert_eq!(advice(of(40.0, 60.0), 100, 1), None);
        let said = |need, downscale| advice(need, 100, downscale).expect("it does not fit");
        assert!(said(of(0.0, 101.0), 1).starts_with("--downscale 2 "));
        assert!(said(of(0.0, 1000.0), 2).starts_with("--downscale 7 "));
        assert!(said(of(80.0, 1100.0), 2).starts_with("--downscale 15 "));
        assert!(said(of(101.0, 1.0), 1).starts_with("no --downscale "));
    }
}
