//! What the program tells about itself.

use std::error::Error;
use std::process::{Command, Output};

fn output(arguments: &[&str]) -> Result<Output, Box<dyn Error>> {
    Ok(Command::new(env!("CARGO_BIN_EXE_limpid"))
        .args(arguments)
        .output()?)
}

fn told(arguments: &[&str]) -> Result<String, Box<dyn Error>> {
    let done = output(arguments)?;
    let problem = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{arguments:?}: {problem}");
    Ok(String::from_utf8(done.stdout)?)
}

#[test]
fn the_version_names_commit_and_backends() -> Result<(), Box<dyn Error>> {
    let version = told(&["--version"])?;
    let known = version.contains("(commit ") && version.contains("backends: ");
    assert!(version.starts_with("limpid ") && known, "{version}");
    if cfg!(feature = "flex") {
        assert!(version.contains("flex"), "{version}");
    }
    Ok(())
}

#[test]
fn settings_are_listed_with_default_range_and_meaning() -> Result<(), Box<dyn Error>> {
    let all = told(&["settings"])?;
    assert!(
        all.contains("blur.kernel_size=9  (odd, 1 to 15)\n    Side K of the blur kernels"),
        "{all}"
    );
    // As they are listed, they can be given.
    let lines = all.lines().filter(|line| !line.starts_with(' '));
    assert!(lines.clone().count() > 90);
    for line in lines {
        let (key, rest) = line.split_once('=').ok_or(line)?;
        assert!(
            key.bytes()
                .all(|b| b.is_ascii_lowercase() || b"_.".contains(&b)),
            "{line}"
        );
        assert!(!rest.is_empty(), "{line}");
    }
    let some = told(&["settings", "camera."])?;
    assert!(some.lines().count() < all.lines().count() / 4, "{some}");
    let nothing = output(&["settings", "weather"])?;
    assert!(!nothing.status.success());
    Ok(())
}

#[test]
fn shells_can_complete_it() -> Result<(), Box<dyn Error>> {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = told(&["completions", shell])?;
        assert!(script.contains("sh-degree"), "{shell}");
    }
    Ok(())
}

#[test]
fn threads_are_one_or_more() -> Result<(), Box<dyn Error>> {
    told(&["--threads", "1", "devices"])?;
    told(&["devices", "--threads", "3"])?;
    let none = output(&["--threads", "0", "devices"])?;
    assert!(!none.status.success());
    Ok(())
}

/// Whether a line begins with a time as `2026-01-31T12:00:00Z `.
fn has_time(line: &str) -> bool {
    let shape: String = line
        .chars()
        .take(21)
        .map(|c| if c.is_ascii_digit() { '0' } else { c })
        .collect();
    shape == "0000-00-00T00:00:00Z "
}

#[test]
fn quiet_says_what_came_of_it_and_a_log_has_every_line_with_its_time() -> Result<(), Box<dyn Error>>
{
    let folder = tempfile::tempdir()?;
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (out, log) = (path("run"), path("run/train.log"));
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");
    let train = ["train", "--scene", scene, "--out", &out, "--downscale", "5"];
    let short = ["--iterations", "200", "--blur", "camera"];
    let fit = ["--set", "motion.first_fit_steps=40"];
    let trained = output(&[&train[..], &short, &fit, &["--quiet", "--log", &log]].concat())?;
    let said = String::from_utf8(trained.stderr)?;
    assert!(trained.status.success(), "{said}");
    let lines: Vec<&str> = said.lines().collect();
    assert!(
        matches!(lines[..], [test, sharp, gaussians, end]
            if test.starts_with("test views: PSNR") && sharp.starts_with("sharp training views")
            && gaussians.contains("Gaussians") && end.contains("of training; results in")),
        "{said}"
    );
    let logged = std::fs::read_to_string(&log)?;
    assert!(logged.lines().all(has_time), "{logged}");
    for part in [
        "\"--iterations\", \"200\"",
        "reading the scene …",
        "10/200 loss",
        "200/200 loss",
        "checkpoint after iteration 200",
        "test views: PSNR",
        "of training; results in",
    ] {
        assert!(logged.contains(part), "{part}: {logged}");
    }

    // A log is gone on with; what is only for those who ask is said to those who ask.
    let rendered = output(&["--quiet", "render", &out, "--log", &log])?;
    let said = String::from_utf8(rendered.stderr)?;
    assert!(
        said.lines().count() == 1 && said.starts_with("written to"),
        "{said}"
    );
    let longer = std::fs::read_to_string(&log)?;
    assert!(
        longer.starts_with(&logged) && longer.contains("written to"),
        "{longer}"
    );
    let resume = ["train", "--resume", "--out", &out];
    let usual = String::from_utf8(output(&resume)?.stderr)?;
    let verbose = String::from_utf8(output(&[&resume[..], &["--verbose"]].concat())?.stderr)?;
    assert!(!usual.contains("checkpoint after"), "{usual}");
    assert!(
        verbose.contains("checkpoint after iteration 200 in"),
        "{verbose}"
    );

    let wrong = output(&["--quiet", "eval", &path("none")])?;
    assert!(!wrong.status.success());
    assert!(String::from_utf8(wrong.stderr)?.starts_with("limpid: "));
    let wrong = output(&["--log", &path("run/config.json/a.log"), "devices"])?;
    let said = String::from_utf8(wrong.stderr)?;
    assert!(!wrong.status.success() && said.contains("--log"), "{said}");
    let both = output(&["--quiet", "--verbose", "devices"])?;
    assert_eq!(both.status.code(), Some(2));
    Ok(())
}
