//! `--until-done`: runs of growing length, until one gains no more.

use serde_json::Value;
use std::error::Error;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");

fn train(out: &Path, args: &[&str]) -> Result<Output, Box<dyn Error>> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(["train", "--scene", DEMO, "--downscale", "5"]);
    Ok(command.args(args).arg("--out").arg(out).output()?)
}

#[test]
fn lengths_double_up_to_the_most_and_the_last_run_can_be_repeated() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let run = train(&out, &["--until-done", "--iterations", "800"])?;
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{said}");
    for told in [
        "750 iterations: ",
        "800 iterations, from the beginning",
        "800 iterations: ",
        ": done",
    ] {
        assert!(said.contains(told), "{told}: {said}");
    }
    let config: Value = serde_json::from_slice(&fs::read(out.join("config.json"))?)?;
    assert_eq!(config["settings"]["iterations"], 800);
    assert_eq!(config["settings"]["frames"]["held_back"], 0.03);
    let log = fs::read_to_string(out.join("metrics.jsonl"))?;
    let iterations = log.lines().map(|line| -> Result<u64, Box<dyn Error>> {
        let line: Value = serde_json::from_str(line)?;
        Ok(line["iteration"].as_u64().ok_or("a number")?)
    });
    let iterations = iterations.collect::<Result<Vec<_>, _>>()?;
    assert!(
        iterations.is_sorted(),
        "of the last run alone: {iterations:?}"
    );

    let again = folder.path().join("again");
    let config = out.join("config.json");
    let run = train(&again, &["--config", config.to_str().ok_or("UTF-8")?])?;
    assert!(run.status.success());
    assert!(
        fs::read(out.join("scene.ply"))? == fs::read(again.join("scene.ply"))?,
        "the same bits"
    );
    Ok(())
}

#[test]
fn it_is_no_way_to_go_on_and_knows_no_time() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    for other in [&["--minutes", "1"][..], &["--resume"]] {
        let run = train(folder.path(), &[&["--until-done"], other].concat())?;
        assert_eq!(run.status.code(), Some(2), "{other:?}");
    }
    Ok(())
}
