//! Checkpoints, and a folder that is taken away: what is left of a run that something ended or got in the way of.

use super::{Outcome, output, path, refusal, start, started, text, wait_for};
use std::fs;
use std::io::BufRead as _;
use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

/// As `kill -9` does.
fn kill(mut run: Child) -> Outcome {
    run.kill()?;
    run.wait()?;
    Ok(())
}

#[test]
fn a_run_that_was_killed_before_its_first_checkpoint_starts_anew() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let (run, _lines) = start(&out, &[])?;
    wait_for(&out.join("config.json"))?;
    kill(run)?;
    let (again, lines) = start(&out, &[])?;
    let said = lines.lines().collect::<Result<Vec<_>, _>>()?.concat();
    assert!(!again.wait_with_output()?.status.success(), "{said}");
    assert!(
        said.contains("nothing was saved") && said.contains("--force starts anew"),
        "{said}"
    );
    assert!(!said.contains("--resume"), "{said}");
    let said = refusal(&["train", "--resume", "--out", path(&out)])?;
    assert!(
        said.contains("no checkpoint was saved") && said.contains("--force and without --resume"),
        "{said}"
    );
    let (anew, _lines) = start(&out, &["--force"])?;
    wait_for(&out.join("checkpoint"))?;
    kill(anew)
}

/// Checkpoints by time, and by the number of iterations not at all.
#[test]
fn a_run_that_was_killed_goes_on_with_its_own_settings_or_names_the_difference() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let by_time = [
        "--set",
        "checkpoint_every=0",
        "--set",
        "checkpoint_minutes=0.001",
    ];
    let (run, lines) = start(&out, &by_time)?;
    let last = out.join("checkpoint").join("state.safetensors");
    let before = out.join("checkpoint").join("previous.safetensors");
    wait_for(&before)?;
    kill(run)?;
    drop(lines);
    assert!(!out.join("metrics.json").exists(), "it was on its way");
    if !last.exists() {
        // Killed while the last checkpoint became the one before it: here one of the two is damaged later on.
        fs::copy(&before, &last)?;
    }

    for (more, said) in [
        (["--downscale", "4"], "`downscale` is 4 here and 5"),
        (
            ["--blur", "kernels"],
            "`blur.model` is \"kernels\" here and \"camera\"",
        ),
        (["--seed", "3"], "`seed` is 3 here and 1"),
        (["--set", "learning_rates.means=0.001"], "--allow-change"),
    ] {
        let mut args = vec!["train", "--resume", "--out", path(&out)];
        args.extend(more);
        let refused = refusal(&args)?;
        assert!(refused.contains(said), "{refused}");
    }

    // A byte that fell over in the last checkpoint costs one interval, and it is said.
    let mut bytes = fs::read(&last)?;
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(&last, bytes)?;
    let (mut resumed, lines) = start(
        &out,
        &[
            "--resume",
            "--iterations",
            "210",
            "--set",
            "learning_rates.sh_dc=0.002",
            "--allow-change",
        ],
    )?;
    let said: Vec<String> = lines.lines().collect::<Result<_, _>>()?;
    assert!(resumed.wait()?.success(), "{said:?}");
    for words in [
        "it is damaged",
        "taken is the one before it",
        "The schedule stays that of 200 iterations",
        "learning_rates.sh_dc: 0.002 in the place of 0.0025",
    ] {
        assert!(
            said.iter().any(|line| line.contains(words)),
            "{words}: {said:?}"
        );
    }
    for file in ["config.json", "metrics.json"] {
        let json: serde_json::Value = serde_json::from_str(&fs::read_to_string(out.join(file))?)?;
        assert_eq!(json["settings"]["iterations"], 210, "{file}");
        let changes = json["changes"].as_array().ok_or("changes")?;
        let named: Vec<&str> = changes
            .iter()
            .filter_map(|c| c["setting"].as_str())
            .collect();
        assert_eq!(named, ["iterations", "learning_rates.sh_dc"], "{file}");
        assert!(
            changes.iter().all(|c| c["iteration"].as_u64() > Some(0)),
            "{file}"
        );
    }

    // The same settings are no difference, however they are given, and a preset's length is no wish for another one.
    let again = output(&[
        "train",
        "--resume",
        "--preset",
        "full",
        "--set",
        "motion.first_fit_steps=40",
        "--out",
        path(&out),
    ])?;
    assert!(again.status.success(), "{}", text(&again.stderr));
    assert!(
        text(&again.stderr).contains("going on after iteration 210 of 210"),
        "{}",
        text(&again.stderr)
    );
    let config = out.join("config.json");
    let again = output(&[
        "train",
        "--resume",
        "--out",
        path(&out),
        "--config",
        path(&config),
    ])?;
    assert!(again.status.success(), "{}", text(&again.stderr));
    fs::remove_file(&last)?;
    let scores = output(&["eval", path(&out)])?;
    assert!(scores.status.success(), "{}", text(&scores.stderr));
    assert!(text(&scores.stderr).contains("taken is the one before it"));
    fs::write(&before, "")?;
    fs::write(&last, "")?;
    let said = refusal(&["eval", path(&out)])?;
    assert!(
        said.contains("previous.safetensors") && said.contains("state.safetensors"),
        "{said}"
    );
    Ok(())
}

#[cfg(unix)]
#[test]
fn sigusr1_asks_for_a_checkpoint_and_no_end() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let (mut run, lines) = start(&out, &[])?;
    wait_for(&out.join("config.json"))?;
    let mut signal = Command::new("kill");
    signal.args(["-USR1", &run.id().to_string()]);
    assert!(signal.status()?.success(), "the signal was sent");
    let said: Vec<String> = lines.lines().collect::<Result<_, _>>()?;
    assert!(run.wait()?.success(), "{said:?}");
    let checkpoint = out.join("checkpoint");
    assert!(checkpoint.join("state.safetensors").exists(), "at the end");
    assert!(
        checkpoint.join("previous.safetensors").exists(),
        "on the way"
    );
    Ok(())
}

#[test]
fn a_checkpoint_that_cannot_be_written_is_a_warning_until_the_end() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    // Half of the run is time enough to be in its way.
    let (mut run, lines) = start(&out, &["--set", "checkpoint_every=100"])?;
    wait_for(&out.join("config.json"))?;
    // A file where the folder of checkpoints should be.
    let obstacle = out.join("checkpoint");
    fs::write(&obstacle, "")?;
    let mut warned = false;
    for line in lines.lines() {
        if line?.contains("warning: no checkpoint after iteration") && !warned {
            warned = true;
            fs::remove_file(&obstacle)?;
        }
    }
    assert!(warned, "it said so");
    assert!(run.wait()?.success(), "the last one could be written");
    assert!(obstacle.is_dir() && out.join("metrics.json").exists());
    Ok(())
}

/// Waits until a run has a line in its log: from then on it trains, and writes to what is open.
fn wait_for_a_line(out: &Path, run: &mut Child) -> Outcome {
    let log = out.join("metrics.jsonl");
    wait_for(&log)?;
    while fs::metadata(&log)?.len() == 0 && run.try_wait()?.is_none() {
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(())
}

#[cfg(unix)]
#[test]
fn a_run_that_is_to_outlive_its_terminal_does() -> Outcome {
    let folder = tempfile::tempdir()?;
    // The first as by `nohup`; of SIGHUP it is not known whether these tests ignore it themselves.
    for (trap, signal, code) in [("trap '' HUP; ", "-HUP", 0), ("", "-TERM", 130)] {
        let out = folder.path().join(format!("run_{code}"));
        let line = format!("{trap}exec \"$0\" \"$@\"");
        let mut command = Command::new("sh");
        command
            .args(["-c", &line])
            .arg(env!("CARGO_BIN_EXE_limpid"));
        let (mut run, lines) = started(&mut command, &out, &[])?;
        wait_for_a_line(&out, &mut run)?;
        let mut kill = Command::new("kill");
        kill.args([signal, &run.id().to_string()]);
        assert!(kill.status()?.success(), "the signal was sent");
        let said = lines.lines().collect::<Result<Vec<_>, _>>()?;
        assert_eq!(run.wait()?.code(), Some(code), "{said:?}");
        assert!(out.join("checkpoint/state.safetensors").exists());
    }
    Ok(())
}

/// Windows moves no folder in which a file is open.
#[cfg(unix)]
#[test]
fn a_folder_that_is_moved_away_is_not_looked_for_in_the_run_that_took_its_place() -> Outcome {
    let folder = tempfile::tempdir()?;
    let [out, moved] = ["run", "moved"].map(|name| folder.path().join(name));
    let (mut first, lines) = start(&out, &[])?;
    wait_for_a_line(&out, &mut first)?;
    fs::rename(&out, &moved)?;
    fs::create_dir(&out)?;
    fs::write(out.join("config.json"), "another run's")?;
    let said = lines.lines().collect::<Result<Vec<_>, _>>()?.concat();
    assert_eq!(first.wait()?.code(), Some(1), "{said}");
    assert!(said.contains("is another run's by now"), "{said}");
    assert!(!said.contains("the last checkpoint is"), "{said}");
    assert_eq!(
        fs::read_to_string(out.join("config.json"))?,
        "another run's"
    );
    assert!(!out.join("checkpoint").exists() && !out.join("metrics.json").exists());
    assert!(moved.join("config.json").exists());
    Ok(())
}

#[test]
fn a_run_whose_lock_is_removed_knows_its_folder() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let (mut run, lines) = start(&out, &[])?;
    wait_for_a_line(&out, &mut run)?;
    fs::remove_file(out.join(".lock"))?;
    let said = lines.lines().collect::<Result<Vec<_>, _>>()?.concat();
    assert!(run.wait()?.success(), "{said}");
    assert!(out.join("metrics.json").exists() && out.join(".lock").exists());
    Ok(())
}

#[test]
fn a_folder_that_is_removed_while_a_run_trains_is_made_anew_with_a_word() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let (mut run, lines) = start(&out, &[])?;
    wait_for_a_line(&out, &mut run)?;
    fs::remove_dir_all(&out)?;
    let said = lines.lines().collect::<Result<Vec<_>, _>>()?.concat();
    assert!(run.wait()?.success(), "{said}");
    assert!(said.contains("config.json is gone"), "{said}");
    let scores = output(&["eval", path(&out)])?;
    assert!(scores.status.success(), "{}", text(&scores.stderr));
    Ok(())
}
