//! `limpid export` and `limpid render --path` on a short run of the demo; what they write is read by others' readers where these
//! are installed (`tests/readers/`).

#![expect(
    clippy::missing_assert_message,
    reason = "most of its assertions are in functions that a test calls, and say what they compare"
)]

use std::error::Error;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

type Outcome = Result<(), Box<dyn Error>>;

fn output(arguments: &[&str], path: Option<&Path>) -> Result<Output, Box<dyn Error>> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
    command.args(arguments);
    // Which ffmpeg there is, is the test's to say.
    command.env("PATH", path.unwrap_or(Path::new("/nowhere")));
    Ok(command.output()?)
}

/// What a command says that has to succeed.
fn said(arguments: &[&str], path: Option<&Path>) -> Result<String, Box<dyn Error>> {
    let done = output(arguments, path)?;
    let text = String::from_utf8(done.stderr)?;
    assert!(done.status.success(), "{arguments:?}: {text}");
    Ok(text)
}

/// What a command says that has to fail.
fn refusal(arguments: &[&str]) -> Result<String, Box<dyn Error>> {
    let done = output(arguments, None)?;
    let text = String::from_utf8(done.stderr)?;
    assert!(!done.status.success(), "{arguments:?}: {text}");
    Ok(text)
}

fn utf8(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Names in a folder, in order.
fn names(folder: &Path) -> Result<Vec<String>, Box<dyn Error>> {
    let entries = fs::read_dir(folder)?.collect::<Result<Vec<_>, _>>()?;
    let mut names: Vec<_> = entries
        .iter()
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    Ok(names)
}

fn train(out: &Path, more: &[&str]) -> Outcome {
    let demo = format!("{ROOT}/../../demo");
    let short = ["--downscale", "5", "--iterations", "200", "--blur", "off"];
    let arguments = [
        &["train", "--scene", &demo, "--out", utf8(out)],
        &short[..],
        &["--set", "motion.first_fit_steps=40"],
        more,
    ]
    .concat();
    said(&arguments, None).map(|_| ())
}

#[test]
fn a_run_can_be_carried_away_and_filmed() -> Outcome {
    let folder = tempfile::tempdir()?;
    let run = folder.path().join("run");
    train(&run, &[])?;
    exports(&run)?;
    paths(&run)?;
    videos(&run, folder.path())
}

fn exports(run: &Path) -> Outcome {
    let name = utf8(run);
    let all = "canonical,ply,ply-sequence,spz,transforms,colmap,glb";
    said(&["export", name, "--format", all, "--at", "3"], None)?;
    let out = run.join("export");
    assert_eq!(
        fs::read(out.join("canonical.ply"))?,
        fs::read(run.join("scene.ply"))?
    );
    let frames = names(&run.join("renders/train"))?.len();
    let sequence = names(&out.join("ply"))?;
    assert_eq!(sequence.len(), frames);
    assert_eq!(sequence[0], "frame_0000.ply");
    assert_eq!(
        fs::read(out.join("ply/frame_0003.ply"))?,
        fs::read(out.join("scene_at_3.ply"))?
    );

    // The sequence of another rate takes the place of the one before.
    said(
        &[
            "export",
            name,
            "--format",
            "ply-sequence",
            "--from",
            "1",
            "--to",
            "2.2",
            "--step",
            "0.25",
            "--sh-degree",
            "0",
        ],
        None,
    )?;
    assert_eq!(names(&out.join("ply"))?.len(), 5, "1, 1.25, 1.5, 1.75, 2");
    let small = io::read_ply(&out.join("ply/frame_0004.ply"))?;
    assert_eq!(small.sh_degree, 0);
    fs::write(out.join("ply/notes.txt"), "mine")?;
    let text = refusal(&["export", name, "--format", "ply-sequence"])?;
    assert!(
        text.contains("notes.txt") && text.contains("--out"),
        "{text}"
    );
    assert_eq!(names(&out.join("ply"))?.len(), 6, "nothing is gone");
    fs::remove_file(out.join("ply/notes.txt"))?;
    said(&["export", name, "--format", "ply-sequence"], None)?;

    // What would change nothing is no flag of this.
    for (asked, flag, is_for) in [
        (&["ply", "--fps", "12"][..], "--fps", "is for glb"),
        (
            &["glb", "--at", "3", "--nodes", "4"],
            "--nodes",
            "without --at",
        ),
        (&["canonical,colmap", "--at", "3"], "--at", "ply, glb, spz"),
        (
            &["ply", "--at", "3", "--from", "1"],
            "--from",
            "ply-sequence",
        ),
        (&["spz", "--step", "2"], "--step", "ply-sequence"),
        (
            &["transforms", "--sh-degree", "0"],
            "--sh-degree",
            "canonical",
        ),
    ] {
        let text = refusal(&[&["export", name, "--format"], asked].concat())?;
        assert!(text.contains(flag) && text.contains(is_for), "{text}");
    }

    // In one part movers are not what they are, and to those who ask for less they are.
    let text = refusal(&[
        "export",
        name,
        "--format",
        "glb",
        "--fidelity",
        "119",
        "--nodes",
        "1",
    ])?;
    for way_out in [
        "movers bend",
        "--fidelity",
        "--nodes 4",
        "--at TIME",
        "ply-sequence",
    ] {
        assert!(text.contains(way_out), "{text}");
    }
    assert!(!out.join("scene.glb").exists());
    said(
        &["export", name, "--format", "glb", "--fidelity", "0"],
        None,
    )?;

    for (bad, why) in [
        (["--step", "0"], "--step"),
        (["--step", "1e-9"], "--step"),
        (["--from", "99"], "--from"),
        (["--to", "-2"], "--to"),
        (["--sh-degree", "4"], "--sh-degree"),
        (["--format", "obj"], "--format"),
    ] {
        let text = refusal(&[&["export", name, "--format", "ply-sequence"], &bad[..]].concat())?;
        assert!(text.contains(why), "{bad:?}: {text}");
    }
    let text = refusal(&["export", name, "--format", "glb", "--from", "1"])?;
    assert!(
        text.contains("all moments") && text.contains("--at"),
        "{text}"
    );
    let text = refusal(&["export", name, "--format", "glb", "--fps", "-1"])?;
    assert!(text.contains("--fps"), "{text}");
    read_by_others(&out)
}

/// The readers of `tests/readers/`, by the Python of `LIMPID_PYTHON` and the node_modules of `LIMPID_NODE_MODULES`.
fn read_by_others(out: &Path) -> Outcome {
    let python = std::env::var_os("LIMPID_PYTHON").unwrap_or_else(|| "python3".into());
    let modules = std::env::var_os("LIMPID_NODE_MODULES").unwrap_or_default();
    let needed = ["-c", "import numpy, plyfile, PIL"];
    let mut say = std::io::stderr().lock();
    if !Command::new(&python)
        .args(needed)
        .output()
        .is_ok_and(|run| run.status.success())
    {
        // Past the test harness, which keeps what a passing test prints.
        writeln!(
            say,
            "skipped: exports by others' readers: {} has not numpy, plyfile and pillow",
            PathBuf::from(python).display()
        )?;
        return Ok(());
    }
    let script = format!("{ROOT}/tests/readers/read_exports.py");
    let read = Command::new(&python)
        .arg("-B")
        .arg(script)
        .arg(out)
        .arg("3")
        .arg(modules)
        .output()?;
    say.write_all(&read.stdout)?;
    assert!(
        read.status.success(),
        "{}",
        String::from_utf8_lossy(&read.stderr)
    );
    Ok(())
}

fn paths(run: &Path) -> Outcome {
    let name = utf8(run);
    let renders = run.join("renders");
    said(
        &[
            "render",
            name,
            "--path",
            "ellipse",
            "--what",
            "color,depth,movers",
            "--from",
            "2",
            "--to",
            "6",
            "--step",
            "2",
        ],
        None,
    )?;
    for what in ["color", "depth", "movers"] {
        assert_eq!(
            names(&renders.join("ellipse").join(what))?,
            ["00000.png", "00001.png", "00002.png"]
        );
    }
    let movers = io::read_map(&renders.join("ellipse/movers/00001.png"))?;
    let bright = movers.values.iter().filter(|v| **v > 0.5).count();
    assert!(
        bright > 0 && bright < movers.values.len() / 2,
        "{bright} pixels show movers"
    );

    // On the cameras' own path, pictures are those of the training views.
    said(
        &[
            "render", name, "--path", "cameras", "--to", "3", "--step", "1.5",
        ],
        None,
    )?;
    let here = io::read_image(&renders.join("cameras/color/00002.png"))?;
    let there = io::read_image(&renders.join("train/00003.png"))?;
    assert_eq!(here, there);

    // With time standing still, only the camera changes the picture, and on a path of one place nothing does.
    let keys = run.join("still camera.json");
    let pose = "[1,0,0,0, 0,1,0,0, 0,0,1,0]";
    let key = |second: u8, time: u8| {
        format!(r#"{{"second": {second}, "time": {time}, "cam_from_world": {pose}}}"#)
    };
    fs::write(
        &keys,
        format!(r#"{{"keyframes": [{}, {}]}}"#, key(0, 0), key(1, 10)),
    )?;
    said(
        &[
            "render",
            name,
            "--path",
            utf8(&keys),
            "--freeze",
            "1.5",
            "--fps",
            "4",
        ],
        None,
    )?;
    let folder = renders.join("still camera/color");
    let pictures = names(&folder)?;
    assert_eq!(pictures.len(), 5, "a second of four, and its end");
    for picture in &pictures {
        assert_eq!(
            fs::read(folder.join(picture))?,
            fs::read(folder.join(&pictures[0]))?
        );
    }

    fs::write(&keys, format!(r#"{{"keyframes": [{}]}}"#, key(0, 99)))?;
    for (arguments, why) in [
        (["--path", utf8(&keys), "--fps", "24"], "key frame 0"),
        (["--step", "2", "--from", "1"], "go with --path"),
        (["--path", utf8(&keys), "--step", "2"], "paths by name"),
        (
            ["--path", "circle", "--fps", "24"],
            "cameras, ellipse and spiral",
        ),
        (["--path", "ellipse", "--reach", "0"], "--reach"),
        (["--path", "ellipse", "--fps", "inf"], "--fps"),
        (["--path", "ellipse", "--at", "1"], "--path"),
    ] {
        let text = refusal(&[&["render", name], &arguments[..]].concat())?;
        assert!(text.contains(why), "{arguments:?}: {text}");
    }
    Ok(())
}

/// Without ffmpeg, its line; with one, what that makes; with one that fails, the line again.
#[cfg(unix)]
fn videos(run: &Path, folder: &Path) -> Outcome {
    use std::os::unix::fs::PermissionsExt as _;

    let arguments = [
        "render",
        utf8(run),
        "--path",
        "spiral",
        "--to",
        "1",
        "--video",
    ];
    let text = said(&arguments, None)?;
    assert!(
        text.contains("no ffmpeg on the path") && text.contains("\n  ffmpeg -framerate 24 -i "),
        "{text}"
    );
    let video = run.join("renders/spiral/color.mp4");
    assert!(!video.exists());
    let ffmpeg = folder.join("ffmpeg");
    let script = |body: &str| -> Outcome {
        fs::write(&ffmpeg, format!("#!/bin/sh\n{body}\n"))?;
        Ok(fs::set_permissions(
            &ffmpeg,
            fs::Permissions::from_mode(0o755),
        )?)
    };
    script(r#"for last; do :; done; echo "$@" > "$last""#)?;
    said(&arguments, Some(folder))?;
    let asked = fs::read_to_string(&video)?;
    assert!(
        asked.contains("-frames:v 2") && asked.contains("color/%05d.png"),
        "{asked}"
    );
    script("echo no such encoder >&2; exit 1")?;
    let text = said(&arguments, Some(folder))?;
    assert!(
        text.contains("no such encoder") && text.contains("\n  ffmpeg "),
        "{text}"
    );
    Ok(())
}

#[cfg(not(unix))]
fn videos(_run: &Path, _folder: &Path) -> Outcome {
    Ok(())
}

#[test]
fn what_stands_still_has_no_movers_to_show_and_no_animation() -> Outcome {
    let folder = tempfile::tempdir()?;
    let run = folder.path().join("run");
    train(&run, &["--static"])?;
    let text = refusal(&[
        "render",
        utf8(&run),
        "--path",
        "ellipse",
        "--what",
        "movers",
    ])?;
    assert!(text.contains("nothing moves"), "{text}");
    said(
        &["export", utf8(&run), "--format", "glb", "--fidelity", "120"],
        None,
    )?;
    let glb = fs::read(run.join("export/scene.glb"))?;
    let json = String::from_utf8_lossy(&glb[..4000]).into_owned();
    assert!(
        json.contains("\"static\"") && !json.contains("animations"),
        "{json}"
    );
    Ok(())
}
