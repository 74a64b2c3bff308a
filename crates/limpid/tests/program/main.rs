//! The program as a user meets it: what it says, with which exit code, and what is left when something is in its way.

mod checkpoints;
#[path = "../common/mod.rs"]
mod common;

use common::{copy, skipped};
use std::error::Error;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::time::{Duration, SystemTime};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");

type Outcome = Result<(), Box<dyn Error>>;

fn limpid(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(args);
    command
}

fn output(args: &[&str]) -> Result<Output, Box<dyn Error>> {
    Ok(limpid(args).output()?)
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn path(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// The demo at 32x18 into a folder, the shortest run there is, with its standard error to be read.
fn start(out: &Path, more: &[&str]) -> Result<(Child, BufReader<ChildStderr>), Box<dyn Error>> {
    started(&mut limpid(&[]), out, more)
}

/// The same, by a command that takes the program's arguments.
fn started(
    command: &mut Command,
    out: &Path,
    more: &[&str],
) -> Result<(Child, BufReader<ChildStderr>), Box<dyn Error>> {
    let short = [
        "--downscale",
        "5",
        "--iterations",
        "200",
        "--blur",
        "camera",
        "--set",
        "motion.first_fit_steps=40",
    ];
    command.args(["train", "--scene", DEMO, "--out", path(out)]);
    command.args(short).args(more).stderr(Stdio::piped());
    let mut child = command.spawn()?;
    let lines = BufReader::new(child.stderr.take().ok_or("it is piped")?);
    Ok((child, lines))
}

/// Waits until a run has written its configuration: from then on it trains.
fn wait_for(file: &Path) -> Outcome {
    for _ in 0..6000 {
        if file.exists() {
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Err(format!("{} did not come", file.display()).into())
}

#[test]
fn a_run_needs_no_reader_has_its_folder_to_itself_and_can_be_asked_for_scores() -> Outcome {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let all_of_the_camera = [
        "--set",
        "camera.path=always",
        "--set",
        "camera.lens=always",
        "--set",
        "frames.offsets=true",
    ];
    let (mut first, lines) = start(&out, &all_of_the_camera)?;
    // As with `limpid train 2>&1 | head`: what is said from now on, nobody reads.
    drop(lines);
    wait_for(&out.join("config.json"))?;
    let (second, lines) = start(&out, &["--force"])?;
    let refused = second.wait_with_output()?;
    let said: Vec<String> = lines.lines().collect::<Result<_, _>>()?;
    assert!(!refused.status.success());
    assert!(
        said.iter()
            .any(|line| line.contains("another run is writing")),
        "{said:?}"
    );
    assert!(first.wait()?.success(), "nobody read what it said");
    // What the camera did is a result.
    let metrics: serde_json::Value = io::read_json(&out.join("metrics.json"))?;
    let is_some = |value: &serde_json::Value| value.as_f64().is_some_and(|number| number > 0.0);
    assert!(
        is_some(&metrics["shutter"]) && is_some(&metrics["aperture"]),
        "{metrics}"
    );
    for (list, fields) in [
        (
            "frames",
            &["blur_px", "disc_px", "focus", "samples", "psnr"][..],
        ),
        ("corrections", &["offset_px"]),
    ] {
        let frames = metrics[list].as_array().ok_or(list)?;
        assert_eq!(frames.len(), 16, "{metrics}");
        for field in fields {
            // A frame may be sharp.
            let are_numbers = frames.iter().all(|frame| frame[field].is_number());
            let is_told = are_numbers && frames.iter().any(|frame| is_some(&frame[field]));
            assert!(is_told, "{list}, {field}: {metrics}");
        }
    }

    // Going on with a finished run scores it again, and takes away what a killed one had not finished.
    let leftovers = [
        out.join(".scene.ply.4711.tmp"),
        out.join("checkpoint/.a.b.12.tmp"),
    ];
    let others = [out.join(".hidden"), out.join("my.12.tmp")];
    for file in leftovers.iter().chain(&others) {
        fs::write(file, "half")?;
    }
    // Nor does a picture of another time stay among its own.
    let older = out.join("renders/test/00099.png");
    fs::write(&older, "older")?;
    let resumed = output(&["train", "--resume", "--out", path(&out)])?;
    assert!(resumed.status.success(), "{}", text(&resumed.stderr));
    assert!(!older.exists() && out.join("renders/test/00000.png").exists());
    assert!(leftovers.iter().all(|file| !file.exists()), "removed");
    assert!(others.iter().all(|file| file.exists()), "not ours");

    // A profile's defaults count for nothing beside a file that has all settings.
    let config_file = out.join("config.json");
    let both = [
        "train",
        "--config",
        path(&config_file),
        "--profile",
        "paper",
        "--dry-run",
    ];
    let refused = output(&both)?;
    assert!(!refused.status.success(), "{}", text(&refused.stdout));
    assert!(text(&refused.stderr).contains("--profile"));

    // What a run was trained with is in its checkpoint; a file that says something else is no account of it.
    let config = fs::read_to_string(out.join("config.json"))?;
    let mut edited: serde_json::Value = serde_json::from_str(&config)?;
    edited["settings"]["blur"]["kernel_size"] = 5.into();
    fs::write(out.join("config.json"), edited.to_string())?;
    let refused = output(&["train", "--resume", "--out", path(&out)])?;
    assert!(!refused.status.success());
    let said = text(&refused.stderr);
    assert!(
        said.contains("config.json: `blur.kernel_size` is 5 here and 9 in the checkpoint"),
        "{said}"
    );
    fs::write(out.join("config.json"), &config)?;

    // Where the scene is not the run's, what is advised is what each command takes.
    let mut edited: serde_json::Value = serde_json::from_str(&config)?;
    edited["run"]["downscale"] = 4.into();
    fs::write(out.join("config.json"), edited.to_string())?;
    let resume = ["train", "--resume", "--out", path(&out)];
    let render = ["render", path(&out), "--scene", DEMO];
    for command in [&resume[..], &["eval", path(&out)], &render] {
        let refused = output(command)?;
        let said = text(&refused.stderr);
        assert!(!refused.status.success(), "{command:?}");
        assert!(
            said.contains("--scene") && !said.contains("--downscale"),
            "{said}"
        );
    }
    fs::write(out.join("config.json"), &config)?;

    let scores = output(&["eval", path(&out)])?;
    assert!(scores.status.success(), "{}", text(&scores.stderr));
    assert!(text(&scores.stdout).contains("test views: PSNR"));
    let scores = output(&["eval", path(&out), "--json"])?;
    let json: serde_json::Value = serde_json::from_slice(&scores.stdout)?;
    assert!(json["test"]["psnr"].as_f64() > Some(10.0), "{json}");

    for time in ["-1", "1000", "NaN"] {
        let export = ["export", path(&out), "--format", "ply", "--at", time];
        let freeze = ["render", path(&out), "--path", "ellipse", "--freeze", time];
        for command in [&["render", path(&out), "--at", time][..], &export, &freeze] {
            let refused = output(command)?;
            let said = text(&refused.stderr);
            assert!(!refused.status.success(), "{command:?}");
            let flag = command[command.len() - 2];
            assert!(said.contains(flag) && said.contains("from 0 to"), "{said}");
        }
    }

    // More blur than the video's, on purpose: by a longer exposure, and by a wider lens that looks elsewhere.
    let shots = folder.path().join("shots");
    let fine_contrast = |more: &[&str]| -> Result<f64, Box<dyn Error>> {
        let shot = ["render", path(&out), "--at", "1.5", "--out", path(&shots)];
        let taken = output(&[&shot, more].concat())?;
        assert!(taken.status.success(), "{}", text(&taken.stderr));
        let image = io::read_image(&shots.join("at_1.5.png"))?;
        let next = image.pixels.iter().skip(3);
        let steps = image
            .pixels
            .iter()
            .zip(next)
            .map(|(a, b)| f64::from((a - b).abs()));
        Ok(steps.sum())
    };
    let sharp = fine_contrast(&[])?;
    for more in [
        &["--shutter", "8"][..],
        &["--aperture", "0.4", "--focus", "2"],
    ] {
        let blurred = fine_contrast(more)?;
        assert!(blurred < 0.9 * sharp, "{more:?}: {blurred} of {sharp}");
    }

    // What is wrong or idle is refused before a folder is made.
    let nowhere = folder.path().join("nowhere");
    for (more, why) in [
        (&["--shutter=-1"][..], "shutter"),
        (&["--aperture", "inf"], "aperture"),
        (&["--aperture", "0.1", "--focus", "0"], "focus"),
        (&["--shutter", "1", "--samples", "0"], "1 to 1024"),
        (&["--focus", "2"], "--focus is for --aperture"),
        (&["--samples", "8"], "--samples is for --shutter"),
    ] {
        let shot = ["render", path(&out), "--at", "1", "--out", path(&nowhere)];
        let said = refusal(&[&shot, more].concat())?;
        assert!(said.contains(why), "{more:?}: {said}");
        assert!(!nowhere.exists(), "{more:?}");
    }

    // The report is written again with the pictures, but for where it would lose its blurry frames or they go elsewhere.
    let report = out.join("report.html");
    let whole = fs::read_to_string(&report)?;
    let pictures = |html: &str| html.matches("/9j/").count();
    assert!(pictures(&whole) > 16, "JPEGs");
    let elsewhere = folder.path().join("pictures");
    for (args, is_written) in [
        (
            &["render", path(&out), "--out", path(&elsewhere)][..],
            false,
        ),
        (&["render", path(&out)], true),
    ] {
        fs::write(&report, "old")?;
        let rendered = output(args)?;
        assert!(rendered.status.success(), "{}", text(&rendered.stderr));
        assert_eq!(
            fs::read_to_string(&report)? != "old",
            is_written,
            "{args:?}"
        );
    }
    assert_eq!(pictures(&fs::read_to_string(&report)?), pictures(&whole));
    let mut edited: serde_json::Value = serde_json::from_str(&config)?;
    edited["run"]["scene"] = "/nowhere".into();
    fs::write(out.join("config.json"), edited.to_string())?;
    let rendered = output(&["render", path(&out)])?;
    assert!(rendered.status.success(), "{}", text(&rendered.stderr));
    assert_eq!(pictures(&fs::read_to_string(&report)?), pictures(&whole));
    // Nor where a copy of the folder has made it seem older than the checkpoint.
    let copied = folder.path().join("copy");
    copy(&out, &copied)?;
    let report = copied.join("report.html");
    let file = fs::File::options().append(true).open(&report)?;
    file.set_modified(SystemTime::UNIX_EPOCH)?;
    let page = folder.path().join("compare.html");
    let compared = output(&["compare", path(&out), path(&copied), "--out", path(&page)])?;
    assert!(compared.status.success(), "{}", text(&compared.stderr));
    assert_eq!(pictures(&fs::read_to_string(&report)?), pictures(&whole));
    Ok(())
}

/// What a run that is refused says.
fn refusal(args: &[&str]) -> Result<String, Box<dyn Error>> {
    let refused = output(args)?;
    let said = text(&refused.stderr);
    assert!(!refused.status.success(), "{args:?}: {said}");
    Ok(said)
}

#[test]
fn a_mistake_in_a_setting_is_named_with_its_place() -> Outcome {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("a.toml");
    fs::write(&file, "iterations = 500\n[blur]\nkernal_size = 7\n")?;
    let train = ["train", "--scene", path(folder.path())];
    let wrong = limpid(&train)
        .args(["--set", "blur.kernel_size=abc"])
        .output()?;
    let said = text(&wrong.stderr);
    assert!(!wrong.status.success());
    assert!(
        said.contains("--set blur.kernel_size=abc: `blur.kernel_size`"),
        "{said}"
    );
    let wrong = limpid(&train).args(["--config", path(&file)]).output()?;
    let said = text(&wrong.stderr);
    assert!(!wrong.status.success());
    for part in ["line 3", "a.toml", "did you mean `blur.kernel_size`?"] {
        assert!(said.contains(part), "{said}");
    }
    Ok(())
}

#[test]
fn a_check_says_what_presets_would_take_if_it_is_asked() -> Outcome {
    let checked = output(&["check", DEMO, "--downscale", "5", "--time"])?;
    let said = text(&checked.stdout);
    assert_eq!(checked.status.code(), Some(0), "{said}");
    let (_, told) = said
        .split_once("training itself would take")
        .ok_or("no time")?;
    let presets = told.lines().filter(|line| line.contains("--preset "));
    assert_eq!(presets.count(), 3, "{told}");
    assert!(told.contains("--preset draft, 500 iterations: "), "{told}");
    assert!(told.contains(" MiB of memory at its peak"), "{told}");
    Ok(())
}

#[test]
fn a_scene_is_checked_by_itself_and_before_it_is_trained_on() -> Outcome {
    let checked = output(&["check", DEMO])?;
    let said = text(&checked.stdout);
    assert_eq!(checked.status.code(), Some(0), "{said}");
    for part in [
        "Shape-of-Motion",
        "depth maps: 16",
        "pass  masks",
        "training would",
    ] {
        assert!(said.contains(part), "{said}");
    }
    assert!(!said.contains("would take"), "nobody asked: {said}");

    let folder = tempfile::tempdir()?;
    let nothing = output(&["check", path(folder.path())])?;
    assert_eq!(nothing.status.code(), Some(2));
    assert!(text(&nothing.stdout).contains("not a scene"));

    let wrong = folder.path().join("demo");
    copy(Path::new(DEMO), &wrong)?;
    for entry in fs::read_dir(wrong.join("masks"))? {
        let file = entry?.path();
        let mut mask = io::read_map(&file)?;
        mask.values.iter_mut().for_each(|v| *v = 1.0 - *v);
        io::write_map_png(&file, &mask)?;
    }
    let checked = output(&["check", path(&wrong)])?;
    let said = text(&checked.stdout);
    assert_eq!(checked.status.code(), Some(2), "{said}");
    assert!(said.contains("wrong  masks"), "{said}");

    let flat = folder.path().join("flat");
    copy(Path::new(DEMO), &flat)?;
    fs::remove_dir_all(flat.join("flow3d_preprocessed/aligned_depth_anything_colmap"))?;
    let checked = output(&["check", path(&flat), "--time"])?;
    let said = text(&checked.stdout);
    assert_eq!(checked.status.code(), Some(2), "{said}");
    for part in ["depth maps: none", "training cannot begin", "--static"] {
        assert!(said.contains(part), "{said}");
    }

    let out = folder.path().join("run");
    let train = ["train", "--scene", path(&wrong), "--out", path(&out)];
    let short = ["--downscale", "5", "--iterations", "200", "--blur", "off"];
    let refused = limpid(&train).args(short).output()?;
    let said = text(&refused.stderr);
    assert!(!refused.status.success(), "{said}");
    assert!(
        said.contains("--unchecked") && said.contains("wrong  masks"),
        "{said}"
    );
    assert!(!out.exists(), "nothing was begun");
    let replacing = limpid(&train).args(short).arg("--force").output()?;
    assert!(!replacing.status.success(), "{}", text(&replacing.stderr));
    let unchecked = limpid(&train).args(short).arg("--unchecked").output()?;
    assert!(unchecked.status.success(), "{}", text(&unchecked.stderr));
    Ok(())
}

#[test]
fn results_cannot_go_into_a_file() -> Outcome {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("file");
    fs::write(&file, "mine")?;
    for out in [file.clone(), file.join("run"), file.join("a/run")] {
        let said = refusal(&["train", "--scene", DEMO, "--out", path(&out)])?;
        assert!(said.contains("file is no folder"), "{said}");
        assert!(
            !said.contains("Gaussians"),
            "before anything is read: {said}"
        );
    }
    assert_eq!(fs::read_to_string(&file)?, "mine");
    Ok(())
}

#[test]
fn a_port_that_is_taken_is_told_before_a_scene_is_looked_for() -> Outcome {
    let taken = std::net::TcpListener::bind("127.0.0.1:0")?;
    let port = taken.local_addr()?.port().to_string();
    let watched = ["train", "--scene", "/nowhere", "--watch", "--port"];
    let refused = limpid(&watched).arg(&port).output()?;
    let said = text(&refused.stderr);
    assert!(!refused.status.success(), "{said}");
    assert!(said.contains(&format!("port {port}")), "{said}");
    assert!(!said.contains("nowhere"), "{said}");
    Ok(())
}

#[test]
fn what_may_not_fit_into_memory_is_told_before_training_with_a_size_that_would() -> Outcome {
    if !Path::new("/proc/self/limits").exists() {
        let why = "this system does not say how much there is";
        return Ok(skipped("what may not fit into memory", why)?);
    }
    let folder = tempfile::tempdir()?;
    for (most, warns) in [("3", false), ("100000", true)] {
        let out = folder.path().join(most);
        let mut command = Command::new("sh");
        // 16 GiB, if the machine has so many.
        command.args(["-c", "ulimit -v 16777216 && exec \"$@\"", "sh"]);
        command.args([env!("CARGO_BIN_EXE_limpid"), "train", "--scene", DEMO]);
        command.args(["--out", path(&out), "--downscale", "5", "--blur", "off"]);
        command.args(["--iterations", "200", "--set", "motion.first_fit_steps=40"]);
        let trained = command
            .arg("--set")
            .arg(format!("gaussians.max_per_pixel={most}"))
            .output()?;
        let said = text(&trained.stderr);
        assert!(trained.status.success(), "{said}");
        let warning = said.lines().find(|l| l.contains("training may take"));
        assert_eq!(warning.is_some(), warns, "{said}");
        let advises = |line: &str| line.contains("--downscale") && line.contains("max_per_pixel");
        assert!(warning.is_none_or(advises), "{said}");
    }
    Ok(())
}
