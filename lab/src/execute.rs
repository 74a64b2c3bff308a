//! One run, from where it stands to its end.

use crate::children::Children;
use crate::error::LabError;
use crate::files::write_json;
use crate::machine::{Machine, only_processor};
use crate::plan::{PlannedRun, Program};
use crate::score::Measured;
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// What became of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It has its scores.
    Finished,
    /// It had them already.
    WasThere,
    /// It was ended, and can go on.
    Stopped,
    /// Another process is at it.
    Elsewhere,
    /// It died.
    Failed(Failed),
}

/// A run that died.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failed {
    /// How it ended.
    pub how: String,
    /// The last lines that it said.
    pub last_lines: Vec<String>,
}

/// What was measured of each time that a run was started; stands beside its folder.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Record {
    /// In their order.
    pub(crate) attempts: Vec<Attempt>,
}

/// A process that trained, until its end.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Attempt {
    /// When it began, seconds since 1970.
    pub(crate) began: u64,
    /// Time on the clock, s; absent, as the processor's, while it runs, and where this program was killed before it ended.
    pub(crate) wall_seconds: Option<f64>,
    /// Processor time, s.
    pub(crate) cpu_seconds: Option<f64>,
    /// Most memory that was in use at once, MiB.
    pub(crate) peak_mib: Option<f64>,
    /// Whether it went on from a checkpoint of the one before.
    #[serde(default = "yes")]
    pub(crate) resumed: bool,
    /// How it died; absent where it finished or was asked to end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) failed: Option<Failed>,
    /// Where.
    pub(crate) machine: Machine,
}

/// Of records that do not say it.
fn yes() -> bool {
    true
}

impl Record {
    /// The record of a run; an empty one where none was kept.
    ///
    /// # Errors
    /// The file is there, and cannot be read or is no record.
    pub(crate) fn read(run: &Path) -> Result<Self, LabError> {
        let path = beside(run, "json");
        match fs::read(&path) {
            Ok(text) => serde_json::from_slice(&text).map_err(|e| LabError::content(&path, e)),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(e) => Err(LabError::file(&path)(e)),
        }
    }

    /// The processor of all attempts; `None` where it was none, or several.
    pub(crate) fn processor(&self) -> Option<String> {
        only_processor(self.attempts.iter().map(|attempt| &attempt.machine))
    }

    /// All attempts together since the last that began from nothing: a run that went on from a checkpoint took what they all took.
    /// `None` where that is not known of all.
    pub(crate) fn measured(&self) -> Option<Measured> {
        let last = self.attempts.last()?;
        let fresh = self.attempts.iter().rposition(|a| !a.resumed);
        let counted = &self.attempts[fresh.unwrap_or(0)..];
        let peaks = counted.iter().filter_map(|a| a.peak_mib);
        let sum = |of: fn(&Attempt) -> Option<f64>| counted.iter().map(of).sum();
        let [cpu, wall]: [Option<f64>; 2] = [sum(|a| a.cpu_seconds), sum(|a| a.wall_seconds)];
        Some(Measured {
            cpu_seconds: cpu?,
            wall_seconds: wall?,
            peak_mib: last.peak_mib.map(|last| peaks.fold(last, f64::max)),
        })
    }
}

/// A file beside a run's folder.
fn beside(run: &Path, extension: &str) -> PathBuf {
    run.with_extension(extension)
}

/// Whether a run has its scores.
pub(crate) fn is_finished(run: &Path) -> bool {
    run.join("metrics.json").exists()
}

fn has_checkpoint(run: &Path) -> bool {
    let files = ["state.safetensors", PREVIOUS_CHECKPOINT];
    files
        .iter()
        .any(|file| run.join("checkpoint").join(file).exists())
}

/// The checkpoint before the last, which a finished run does without.
const PREVIOUS_CHECKPOINT: &str = "previous.safetensors";

/// Trains a run to its end, from its checkpoint where it has one.
///
/// # Errors
/// Files of the laboratory cannot be written, or the program cannot be started.
pub fn execute(
    run: &PlannedRun,
    program: &Program,
    children: &Children,
) -> Result<Outcome, LabError> {
    let folder = &run.folder;
    if let Some(runs) = folder.parent() {
        fs::create_dir_all(runs).map_err(LabError::file(runs))?;
    }
    let path = beside(folder, "lock");
    let lock = File::options()
        .create(true)
        .truncate(false)
        .write(true)
        .open(&path);
    let lock = lock.map_err(LabError::file(&path))?;
    let is_alone = match lock.try_lock() {
        Ok(()) => true,
        // Some file systems have no locks.
        Err(TryLockError::Error(_)) => false,
        Err(TryLockError::WouldBlock) => return Ok(Outcome::Elsewhere),
    };
    let outcome = train(run, program, children, (&lock, is_alone));
    // Closing it is not enough: a process that another thread is just starting holds a copy of it for a moment.
    lock.unlock().ok();
    outcome
}

/// See [`execute`]; `lock` is held on the run, if `is_alone` says so.
fn train(
    run: &PlannedRun,
    program: &Program,
    children: &Children,
    (mut lock, is_alone): (&File, bool),
) -> Result<Outcome, LabError> {
    let folder = &run.folder;
    if is_finished(folder) {
        return Ok(Outcome::WasThere);
    }
    let mut record = Record::read(folder)?;
    let log = beside(folder, "log");
    let mut command = Command::new(&program.path);
    command.args(&run.arguments);
    let resumed = has_checkpoint(folder);
    if resumed {
        // With all arguments: the program refuses a checkpoint that is of another run.
        command.arg("--resume");
    } else if folder.exists() && !is_alone {
        return Ok(Outcome::Failed(Failed {
            how: format!(
                "{} is there without a checkpoint, and this file system has no locks, which would tell whether another process is at \
                 it; remove it if none is",
                folder.display()
            ),
            last_lines: Vec::new(),
        }));
    } else if folder.exists() {
        // What was begun and saved nothing.
        fs::remove_dir_all(folder).map_err(LabError::file(folder))?;
    }
    let said = File::options().create(true).append(true).open(&log);
    let said = said.map_err(LabError::file(&log))?;
    let from = said.metadata().map_err(LabError::file(&log))?.len();
    // The lock stays as long as the process lives, even where this one does not.
    command.stdin(lock.try_clone().map_err(LabError::file(folder))?);
    command.stdout(said.try_clone().map_err(LabError::file(&log))?);
    command.stderr(said);
    // Runs go side by side, and a thread each is the most that all of them together can use.
    command.env("RAYON_NUM_THREADS", "1");

    // A process is measured from before it becomes another program, when it still has this one's memory: of this one's peak, which
    // planning may have made, it would be said to have used as much.
    fs::write("/proc/self/clear_refs", "5").ok();

    let clock = Instant::now();
    let mut attempt = Attempt {
        began: now(),
        wall_seconds: None,
        cpu_seconds: None,
        peak_mib: None,
        resumed,
        failed: None,
        machine: Machine::here(),
    };
    let before = record.attempts.len();
    record.attempts.push(attempt.clone());
    let records = beside(folder, "json");
    let ended = children.run(&mut command, |process| {
        // Where this program is killed before the other ends, nobody measures that.
        write_json(&records, &record).ok();
        // For who wants to look at it or to end it; nothing depends on it.
        lock.set_len(0)
            .and_then(|()| writeln!(lock, "{process}"))
            .ok();
    });
    let Some(ended) = ended.map_err(LabError::file(&program.path))? else {
        return Ok(Outcome::Stopped);
    };
    let outcome = if ended.status.success() && is_finished(folder) {
        Outcome::Finished
    } else if children.are_stopped() {
        Outcome::Stopped
    } else {
        Outcome::Failed(Failed {
            how: how(ended.status),
            last_lines: tail(&log, from, 12),
        })
    };
    let usage = ended.rusage;
    attempt.wall_seconds = Some(clock.elapsed().as_secs_f64());
    attempt.cpu_seconds = Some((usage.utime + usage.stime).as_secs_f64());
    attempt.peak_mib = (usage.maxrss > 0).then(|| usage.maxrss as f64 / f64::from(1 << 20));
    if let Outcome::Failed(failed) = &outcome {
        attempt.failed = Some(failed.clone());
    }
    record.attempts[before] = attempt;
    write_json(&records, &record)?;
    if outcome == Outcome::Finished {
        let previous = folder.join("checkpoint").join(PREVIOUS_CHECKPOINT);
        // A study has hundreds of runs; where it stays it is only untidy.
        fs::remove_file(previous).ok();
    }
    Ok(outcome)
}

/// How many iterations of a run are done, as far as it has said.
pub(crate) fn progress(run: &PlannedRun) -> usize {
    let said = tail(&beside(&run.folder, "log"), 0, 6);
    let done = said.iter().rev().find_map(|line| {
        let (done, rest) = line.split_once('/')?;
        let total = rest.split(' ').next()?;
        (total.parse::<usize>().ok()? == run.iterations).then(|| done.parse().ok())?
    });
    done.unwrap_or(0)
}

/// The last lines of a file from a place on; none where it cannot be read.
fn tail(path: &Path, from: u64, lines: usize) -> Vec<String> {
    const MOST: u64 = 8192;
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(from.max(length.saturating_sub(MOST))))?;
        let mut bytes = Vec::new();
        file.take(MOST).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let bytes = read().unwrap_or_default();
    let text = String::from_utf8_lossy(&bytes);
    let all: Vec<&str> = text.lines().collect();
    let last = &all[all.len().saturating_sub(lines)..];
    last.iter().map(|line| (*line).to_owned()).collect()
}

#[cfg(unix)]
fn how(status: ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt as _;
    match status.signal() {
        Some(signal) => format!("killed by signal {signal}"),
        None => format!("exit code {}", status.code().unwrap_or(-1)),
    }
}

#[cfg(not(unix))]
fn how(status: ExitStatus) -> String {
    format!("exit code {}", status.code().unwrap_or(-1))
}

#[expect(
    clippy::disallowed_methods,
    reason = "the report says when runs were made; no result depends on it"
)]
fn now() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |since| since.as_secs())
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    /// A stand-in for the program, in shell, and a run of it. The shell reads the script, for a file just written cannot always be
    /// started: a process that another test is starting may hold it open for a moment more.
    fn stand_in(folder: &Path, script: &str) -> (PlannedRun, Program) {
        let path = folder.join("script");
        fs::write(&path, script).expect("a script");
        let out = folder.join("runs/aa");
        let words = |path: &Path| path.to_string_lossy().into_owned();
        let run = PlannedRun {
            id: "aa".to_owned(),
            scene: "s".to_owned(),
            arms: vec!["off".to_owned()],
            seed: 1,
            iterations: 200,
            arguments: vec![words(&path), "train".to_owned(), words(&out)],
            folder: out,
            command: Vec::new(),
        };
        let program = Program {
            path: "sh".into(),
            fingerprint: "f".to_owned(),
            version: "v".to_owned(),
            commit: None,
            changed: false,
        };
        (run, program)
    }

    fn outcome(run: &PlannedRun, program: &Program) -> Outcome {
        execute(run, program, &Children::default()).expect("files can be written")
    }

    #[test]
    fn a_run_dies_goes_on_from_its_checkpoint_and_is_not_run_again() {
        let folder = tempfile::tempdir().expect("a folder");
        // Without a checkpoint it saves one and dies; with one it ends.
        let (run, program) = stand_in(
            folder.path(),
            "echo \"threads $RAYON_NUM_THREADS: $*\" >&2\n\
             if [ \"$3\" = --resume ]; then echo {} > \"$2/metrics.json\"; exit 0; fi\n\
             mkdir -p \"$2/checkpoint\"; touch \"$2/checkpoint/state.safetensors\" \"$2/checkpoint/previous.safetensors\"\n\
             echo 50/200 loss >&2; echo the last word >&2; exit 3",
        );
        let Outcome::Failed(failed) = outcome(&run, &program) else {
            panic!("it exits with 3");
        };
        assert_eq!(failed.how, "exit code 3");
        assert_eq!(
            failed.last_lines.last().map(String::as_str),
            Some("the last word")
        );
        assert!(
            failed.last_lines[0].starts_with("threads 1: train"),
            "{failed:?}"
        );
        assert_eq!(progress(&run), 50);

        assert_eq!(outcome(&run, &program), Outcome::Finished);
        assert!(!run.folder.join("checkpoint/previous.safetensors").exists());
        assert!(run.folder.join("checkpoint/state.safetensors").exists());
        let record = Record::read(&run.folder).expect("a record");
        let [first, second] = &record.attempts[..] else {
            panic!("two attempts: {record:?}");
        };
        assert!(first.failed.is_some() && second.failed.is_none());
        let measured = record.measured().expect("measured");
        let of_both = first.cpu_seconds.zip(second.cpu_seconds).expect("measured");
        assert!((measured.cpu_seconds - of_both.0 - of_both.1).abs() < 1e-12);
        // What nobody saw the end of is not known, and neither is the sum.
        let mut killed = record.clone();
        killed.attempts[0].cpu_seconds = None;
        assert!(killed.measured().is_none());
        assert!(measured.peak_mib >= first.peak_mib && measured.peak_mib >= second.peak_mib);

        assert_eq!(outcome(&run, &program), Outcome::WasThere);
        assert_eq!(
            Record::read(&run.folder).expect("a record").attempts.len(),
            2
        );
    }

    #[test]
    fn what_saved_nothing_starts_anew_and_what_ends_without_scores_has_failed() {
        let folder = tempfile::tempdir().expect("a folder");
        let (run, program) = stand_in(
            folder.path(),
            "[ -e \"$2\" ] && exit 9\nmkdir -p \"$2\"; touch \"$2/config.json\"",
        );
        for _ in 0..2 {
            let Outcome::Failed(failed) = outcome(&run, &program) else {
                panic!("there are no scores");
            };
            assert_eq!(
                failed.how, "exit code 0",
                "the folder was taken away before"
            );
        }
        // What was thrown away is no part of what a run takes.
        let record = Record::read(&run.folder).expect("a record");
        let [mut first, second] = <[Attempt; 2]>::try_from(record.attempts).expect("two");
        let measured = |attempts: &[Attempt]| {
            let attempts = attempts.to_vec();
            Record { attempts }.measured().map(|m| m.cpu_seconds)
        };
        assert!(!first.resumed && !second.resumed);
        first.cpu_seconds = None;
        let attempts = [first, second.clone()];
        assert_eq!(measured(&attempts), second.cpu_seconds);
        let [first, mut second] = attempts;
        second.resumed = true;
        assert_eq!(
            measured(&[first, second]),
            None,
            "it went on from what nobody measured"
        );
    }

    #[test]
    fn the_laboratorys_own_memory_is_no_runs() {
        if cfg!(not(target_os = "linux")) || fs::write("/proc/self/clear_refs", "5").is_err() {
            // Past the harness, so that `cargo xtask ci` counts it.
            let why =
                "skipped: a run's memory: this system does not forget the peak of a process\n";
            std::io::stderr().write_all(why.as_bytes()).ok();
            return;
        }
        let large = std::hint::black_box(vec![1_u8; 300 << 20]);
        assert_eq!(large.last(), Some(&1));
        drop(large);
        let folder = tempfile::tempdir().expect("a folder");
        let script = "mkdir -p \"$2\"; echo {} > \"$2/metrics.json\"";
        let (run, program) = stand_in(folder.path(), script);
        assert_eq!(outcome(&run, &program), Outcome::Finished);
        let record = Record::read(&run.folder).expect("a record");
        let peak = record.measured().and_then(|measured| measured.peak_mib);
        assert!(peak.is_some_and(|mib| mib < 150.0), "{peak:?}");
    }

    #[test]
    fn nothing_is_started_once_all_was_ended_and_two_do_not_share_a_run() {
        let folder = tempfile::tempdir().expect("a folder");
        let (run, program) = stand_in(folder.path(), "exec sleep 10");
        let children = Children::default();
        std::thread::scope(|scope| {
            let first = scope.spawn(|| execute(&run, &program, &children));
            let lock = beside(&run.folder, "lock");
            while fs::read_to_string(&lock).unwrap_or_default().is_empty() {
                std::thread::yield_now();
            }
            assert_eq!(outcome(&run, &program), Outcome::Elsewhere);
            children.stop();
            let first = first.join().expect("no panic").expect("an outcome");
            assert_eq!(first, Outcome::Stopped);
        });
        let again = execute(&run, &program, &children).expect("an outcome");
        assert_eq!(again, Outcome::Stopped, "no process was started");
        assert_eq!(
            Record::read(&run.folder).expect("a record").attempts.len(),
            1
        );
    }
}
