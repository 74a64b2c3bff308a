//! The length of a run, chosen by the program: `--minutes`, as long as fits, and `--until-done`, until twice the length gains no more.

use serde_json::Value;
use std::error::Error;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");

/// Where it does not matter how well movers begin: a second or two.
const FIT: &str = "motion.first_fit_steps=40";

fn command(out: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(["train", "--scene", DEMO, "--downscale", "5"]);
    command.args(args).arg("--out").arg(out);
    command
}

fn train(out: &Path, args: &[&str]) -> Result<Output, Box<dyn Error>> {
    Ok(command(out, args).output()?)
}

/// The settings in a run's configuration.
fn settings(out: &Path) -> Result<Value, Box<dyn Error>> {
    let mut config: Value = serde_json::from_slice(&fs::read(out.join("config.json"))?)?;
    Ok(config["settings"].take())
}

/// The iterations in a run's configuration.
fn length(out: &Path) -> Result<u64, Box<dyn Error>> {
    Ok(settings(out)?["iterations"].as_u64().ok_or("a number")?)
}

/// A run's configuration makes the same run again, as long as it and with the same bits.
fn assert_repeats(out: &Path) -> Result<(), Box<dyn Error>> {
    let again = tempfile::tempdir()?;
    let config = out.join("config.json");
    let run = train(again.path(), &["--config", config.to_str().ok_or("UTF-8")?])?;
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{said}");
    assert_eq!(length(again.path())?, length(out)?, "as long as it");
    assert!(
        fs::read(out.join("scene.ply"))? == fs::read(again.path().join("scene.ply"))?,
        "the same bits"
    );
    Ok(())
}

#[test]
fn as_many_iterations_as_fit_and_the_run_can_be_repeated() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let began = Instant::now();
    // More than any machine has time for.
    let most: u64 = 1_000_000;
    let asked = ["--minutes", "0.1", "--iterations", &most.to_string()];
    let run = train(&out, &[&asked[..], &["--set", FIT]].concat())?;
    let took = began.elapsed().as_secs_f64();
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{said}");
    let chosen = length(&out)?;
    assert!(
        said.contains(&format!("{chosen} iterations in the place of {most}")),
        "{said}"
    );
    assert!(said.contains("is expected"), "{said}");
    assert!((200..most).contains(&chosen), "{chosen}");
    // The length is kept, not the time, and a machine that others use may become slower on the way: by this much it does not.
    assert!(chosen == 200 || took < 90.0, "{took} s in the place of 6");
    assert_repeats(&out)
}

#[test]
fn a_time_that_is_too_short_is_said_and_no_time_is_refused() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    for wrong in ["0", "-1", "inf", "soon"] {
        let refused = train(&out, &["--minutes", wrong])?;
        assert_eq!(refused.status.code(), Some(2), "{wrong}");
        assert!(!out.exists(), "{wrong}");
    }
    let run = train(&out, &["--minutes", "0.001", "--set", FIT])?;
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{said}");
    assert_eq!(length(&out)?, 200);
    assert!(
        said.contains("no run is shorter than 200 iterations"),
        "{said}"
    );
    assert!(said.contains("expects about"), "{said}");
    let resumed = train(&out, &["--resume", "--minutes", "1"])?;
    assert_eq!(resumed.status.code(), Some(2), "they exclude each other");
    Ok(())
}

#[test]
fn a_run_until_done_is_refused_where_no_pixels_are_to_be_held_back() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let run = train(&out, &["--until-done", "--set", "frames.held_back=0"])?;
    let said = String::from_utf8_lossy(&run.stderr);
    assert_eq!(run.status.code(), Some(1), "{said}");
    assert!(said.contains("--set frames.held_back=0.03"), "{said}");
    assert!(!out.exists());
    Ok(())
}

#[test]
fn lengths_double_up_to_the_most_and_the_run_that_is_kept_can_be_repeated()
-> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let run = train(&out, &["--until-done", "--iterations", "800"])?;
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{said}");
    for told in ["750 iterations: ", "800 iterations, from the beginning"] {
        assert!(said.contains(told), "{told}: {said}");
    }
    // Which of the two is the better one hangs on the last bits of a processor's arithmetic.
    let decision = said.lines().find(|line| line.contains("800 iterations: "));
    let decision = decision.ok_or("a decision")?;
    let (kept, told) = match decision.contains(", -") {
        true => (750, ": back to 750"),
        false => (800, ": done"),
    };
    assert!(decision.contains(told), "{said}");
    assert_eq!(length(&out)?, kept, "{said}");
    assert_eq!(settings(&out)?["frames"]["held_back"], 0.03);
    let log = fs::read_to_string(out.join("metrics.jsonl"))?;
    let iterations = log.lines().map(|line| -> Result<u64, Box<dyn Error>> {
        let line: Value = serde_json::from_str(line)?;
        Ok(line["iteration"].as_u64().ok_or("a number")?)
    });
    let iterations = iterations.collect::<Result<Vec<_>, _>>()?;
    assert!(
        iterations.is_sorted() && iterations.last() == Some(&kept),
        "of the run that is kept alone: {iterations:?}"
    );
    assert_repeats(&out)
}

#[test]
fn a_length_that_was_killed_is_finished_and_not_the_one_before_made_longer()
-> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let mut run = command(&out, &["--until-done", "--iterations", "760", "--set", FIT])
        .stderr(Stdio::null())
        .spawn()?;
    let waits = Instant::now();
    while length(&out).ok() != Some(760) {
        assert!(run.try_wait()?.is_none(), "it ended");
        assert!(waits.elapsed() < Duration::from_secs(600), "too slow");
        sleep(Duration::from_millis(5));
    }
    run.kill()?;
    run.wait()?;
    // Nor where the last checkpoint is damaged: the one before it is of this length, too.
    let last = out.join("checkpoint").join(trainer::CHECKPOINT_FILE);
    fs::write(last, "no checkpoint")?;
    let resumed = command(&out, &["--resume"]).output()?;
    let said = String::from_utf8_lossy(&resumed.stderr).into_owned();
    assert!(resumed.status.success(), "{said}");
    assert!(said.contains(" of 760"), "{said}");
    assert!(!said.contains("in the place of"), "made longer: {said}");

    // As where it ends on its way back to a shorter length, of which the checkpoint is written last.
    let config = fs::read_to_string(out.join("config.json"))?;
    let shorter = config.replace("\"iterations\": 760", "\"iterations\": 750");
    assert_ne!(config, shorter);
    fs::write(out.join("config.json"), shorter)?;
    let resumed = command(&out, &["--resume"]).output()?;
    let said = String::from_utf8_lossy(&resumed.stderr).into_owned();
    assert!(resumed.status.success(), "{said}");
    assert_eq!(length(&out)?, 760, "{said}");
    assert_repeats(&out)
}

#[test]
fn until_done_is_no_way_to_go_on_and_knows_no_time() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    for other in [&["--minutes", "1"][..], &["--resume"]] {
        let run = train(folder.path(), &[&["--until-done"], other].concat())?;
        assert_eq!(run.status.code(), Some(2), "{other:?}");
    }
    Ok(())
}
