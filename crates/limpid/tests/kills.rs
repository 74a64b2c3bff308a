//! A run that is killed at random moments and goes on each time ends as one that was left alone, bit for bit.
//!
//! `LIMPID_KILLS` says how many kills; 6 without it. docs/RELIABILITY.md speaks of 200.

use std::error::Error;
use std::fs;
use std::io::{Read as _, Seek as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use trainer::{CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE};

const KILLS: usize = 6;
const SEED: u64 = 1;

/// The demo at 32x18 with kernels and unseen views, the shortest run there is, and a checkpoint every few iterations.
fn new_run(out: &Path, more: &[&str]) -> Command {
    let demo = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args([
        "train",
        "--scene",
        demo,
        "--downscale",
        "5",
        "--iterations",
        "200",
        "--blur",
        "kernels",
    ]);
    // Fitting motion to tracks is not what is killed here, and would be half of a run.
    for set in ["checkpoint_every=7", "motion.first_fit_steps=40"] {
        command.args(["--set", set]);
    }
    command.arg("--out");
    command.arg(out).args(more);
    command
}

fn resumed(out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(["train", "--resume", "--out"]).arg(out);
    command
}

/// Starts it, and kills it after a while, unless it is done by then. Says whether it was killed.
fn killed(command: &mut Command, after: Duration) -> Result<bool, Box<dyn Error>> {
    let mut said = tempfile::tempfile()?;
    let mut child: Child = command.stderr(said.try_clone()?).spawn()?;
    std::thread::sleep(after);
    if let Some(status) = child.try_wait()? {
        let mut text = String::new();
        said.rewind()?;
        said.read_to_string(&mut text)?;
        assert!(status.success(), "{command:?}: {status}\n{text}");
        return Ok(false);
    }
    child.kill()?;
    child.wait()?;
    Ok(true)
}

/// Numbers in [0, 1) that look random (a linear congruential generator).
struct Chance(u64);

impl Chance {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }
}

#[test]
fn runs_that_are_killed_end_as_those_that_are_not() -> Result<(), Box<dyn Error>> {
    let wanted = match std::env::var("LIMPID_KILLS") {
        Ok(number) => number.parse()?,
        Err(_) => KILLS,
    };
    let folder = tempfile::tempdir()?;
    let alone = folder.path().join("alone");
    let started = Instant::now();
    assert!(
        new_run(&alone, &[])
            .stderr(Stdio::null())
            .status()?
            .success()
    );
    let whole = started.elapsed();
    // Parameters to the last bit, and what they look like.
    let results = ["scene.ply", "renders/blur.png"];
    let expected: Vec<Vec<u8>> = results
        .iter()
        .map(|name| fs::read(alone.join(name)))
        .collect::<Result<_, _>>()?;

    let (mut chance, mut kills, mut runs, mut begun_anew) = (Chance(SEED), 0, 0, 0);
    while kills < wanted {
        let out = folder.path().join("run");
        let mut command = new_run(&out, &["--force"]);
        while kills < wanted {
            // At any time, from the start to after the last iteration.
            if !killed(&mut command, whole.mul_f64(chance.next()))? {
                break;
            }
            kills += 1;
            let saved = [CHECKPOINT_FILE, PREVIOUS_CHECKPOINT_FILE];
            let is_saved = saved
                .iter()
                .any(|name| out.join("checkpoint").join(name).exists());
            command = if is_saved {
                resumed(&out)
            } else {
                begun_anew += 1;
                new_run(&out, &["--force"])
            };
        }
        if kills == wanted {
            let status = command.stderr(Stdio::null()).status()?;
            assert!(status.success(), "after {kills} kills");
        }
        for (name, expected) in results.iter().zip(&expected) {
            assert!(
                fs::read(out.join(name))? == *expected,
                "{name} differs after {kills} kills"
            );
        }
        runs += 1;
    }
    eprintln!(
        "{kills} kills in {runs} runs, {begun_anew} of them before the first checkpoint: all end alike"
    );
    Ok(())
}
