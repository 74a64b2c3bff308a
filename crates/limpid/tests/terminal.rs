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

#[test]
fn a_backend_that_is_not_there_is_an_error_that_says_what_to_do() -> Result<(), Box<dyn Error>> {
    let demo = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");
    let folder = tempfile::tempdir()?;
    let backends = [
        ("ndarray", cfg!(feature = "ndarray")),
        ("wgpu", cfg!(feature = "wgpu")),
        ("cuda", cfg!(feature = "cuda")),
    ];
    for (backend, is_built) in backends {
        // Vulkan finds drivers by files that these variables name; other systems' adapters cannot be hidden.
        if is_built && !(backend == "wgpu" && cfg!(target_os = "linux")) {
            println!("skipped: {backend} is in this build, and its adapter cannot be hidden");
            continue;
        }
        let out = folder.path().join(backend);
        let tried = Command::new(env!("CARGO_BIN_EXE_limpid"))
            .args(["train", "--scene", demo, "--backend", backend, "--out"])
            .arg(&out)
            .envs([("VK_DRIVER_FILES", "/none"), ("VK_ICD_FILENAMES", "/none")])
            .output()?;
        let said = String::from_utf8_lossy(&tried.stderr);
        assert_eq!(tried.status.code(), Some(1), "{said}");
        assert!(!said.contains("panicked"), "{said}");
        if is_built {
            let advises = said.contains("--backend flex") && said.contains("limpid devices");
            assert!(said.contains("no adapter") && advises, "{said}");
        } else {
            assert!(said.contains(&format!("--features {backend}")), "{said}");
        }
        assert!(!out.exists(), "{backend}: nothing was begun");
    }
    Ok(())
}
