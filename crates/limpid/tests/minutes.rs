//! `--minutes`: a run as long as fits, which can be repeated.

use serde_json::Value;
use std::error::Error;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Instant;

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");

fn train(out: &Path, args: &[&str]) -> Result<Output, Box<dyn Error>> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(["train", "--scene", DEMO, "--downscale", "5"]);
    Ok(command.args(args).arg("--out").arg(out).output()?)
}

/// The iterations in a run's configuration.
fn length(out: &Path) -> Result<u64, Box<dyn Error>> {
    let config: Value = serde_json::from_slice(&fs::read(out.join("config.json"))?)?;
    Ok(config["settings"]["iterations"]
        .as_u64()
        .ok_or("a number")?)
}

#[test]
fn as_many_iterations_as_fit_and_the_run_can_be_repeated() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let began = Instant::now();
    let run = train(&out, &["--minutes", "0.2"])?;
    let took = began.elapsed().as_secs_f64();
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(run.status.success(), "{said}");
    let chosen = length(&out)?;
    assert!(
        said.contains(&format!("{chosen} iterations in the place of 40000")),
        "{said}"
    );
    assert!(said.contains("is expected"), "{said}");
    assert!((200..40_000).contains(&chosen), "{chosen}");
    // The length is kept, not the time, and a machine that others use may become slower on the way: by this much it does not.
    assert!(chosen == 200 || took < 180.0, "{took} s in the place of 12");

    let again = folder.path().join("again");
    let config = out.join("config.json");
    let run = train(&again, &["--config", config.to_str().ok_or("UTF-8")?])?;
    assert!(run.status.success());
    assert_eq!(length(&again)?, chosen);
    assert!(
        fs::read(out.join("scene.ply"))? == fs::read(again.join("scene.ply"))?,
        "the same bits"
    );
    Ok(())
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
    let run = train(&out, &["--minutes", "0.001"])?;
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
