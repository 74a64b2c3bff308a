//! The program on other backends than the first: what is built in, what there is, and what it says where something is missing.

#[path = "common/skipped.rs"]
mod skipped;

use skipped::skipped;
use std::error::Error;
use std::process::{Command, Output};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");

fn output(arguments: &[&str]) -> std::io::Result<Output> {
    Command::new(env!("CARGO_BIN_EXE_limpid"))
        .args(arguments)
        .output()
}

/// All backends that `--backend` knows, and whether this build has them; the first is the default.
const BACKENDS: [(&str, bool); 4] = [
    ("flex", cfg!(feature = "flex")),
    ("ndarray", cfg!(feature = "ndarray")),
    ("wgpu", cfg!(feature = "wgpu")),
    ("cuda", cfg!(feature = "cuda")),
];

#[test]
fn a_run_is_scored_and_shown_by_every_backend_that_is_built_in() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run").to_string_lossy().into_owned();
    let train = ["train", "--scene", DEMO, "--downscale", "5", "--out", &out];
    let short = ["--iterations", "200", "--blur", "off"];
    let fit = ["--set", "motion.first_fit_steps=40"];
    let trained = output(&[&train[..], &short, &fit].concat())?;
    let said = String::from_utf8_lossy(&trained.stderr);
    assert!(trained.status.success(), "{said}");
    for command in ["eval", "render"] {
        for (backend, is_built) in BACKENDS {
            let tried = output(&[command, &out, "--backend", backend])?;
            let said = String::from_utf8_lossy(&tried.stderr);
            if is_built && said.contains("no adapter") {
                skipped(&format!("{command} on {backend}"), "no adapter")?;
            } else if is_built {
                assert!(tried.status.success(), "{backend}: {said}");
            } else {
                assert!(said.contains(&format!("--features {backend}")), "{said}");
            }
        }
    }
    Ok(())
}

#[test]
fn a_backend_that_is_not_built_in_is_an_error_that_says_what_to_do() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    for (backend, is_built) in BACKENDS.into_iter().skip(1) {
        if is_built {
            skipped(&format!("a build without {backend}"), "this one has it")?;
            continue;
        }
        let out = folder.path().join(backend);
        let tried = Command::new(env!("CARGO_BIN_EXE_limpid"))
            .args(["train", "--scene", DEMO, "--backend", backend, "--out"])
            .arg(&out)
            .output()?;
        let said = String::from_utf8_lossy(&tried.stderr);
        assert_eq!(tried.status.code(), Some(1), "{said}");
        assert!(!said.contains("panicked"), "{said}");
        assert!(said.contains(&format!("--features {backend}")), "{said}");
        assert!(!out.exists(), "{backend}: nothing was begun");
    }
    Ok(())
}

/// Without drivers of Vulkan and EGL there is no adapter, where these can be hidden.
#[cfg(all(feature = "wgpu", target_os = "linux"))]
#[test]
fn a_machine_without_an_adapter_is_an_error_that_says_what_to_do() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().join("run");
    let hidden = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_limpid"));
        for variable in [
            "VK_DRIVER_FILES",
            "VK_ICD_FILENAMES",
            "__EGL_VENDOR_LIBRARY_FILENAMES",
        ] {
            command.env(variable, folder.path().join("none.json"));
        }
        command.env_remove("VK_ADD_DRIVER_FILES");
        command.args(args).output()
    };
    let listed = hidden(&["devices"])?;
    let said = String::from_utf8_lossy(&listed.stdout);
    assert!(listed.status.success(), "{said}");
    if !said.contains("wgpu     no adapter") {
        skipped(
            "a machine without an adapter",
            "its drivers cannot be hidden",
        )?;
        return Ok(());
    }
    let run = out.to_string_lossy();
    let tried = hidden(&["train", "--scene", DEMO, "--backend", "wgpu", "--out", &run])?;
    let said = String::from_utf8_lossy(&tried.stderr);
    assert_eq!(tried.status.code(), Some(1), "{said}");
    for part in ["no adapter", "install its driver", "--backend flex"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!said.contains("panicked") && !out.exists(), "{said}");
    Ok(())
}

/// What there is, with its limits, and whether a scene fits.
#[cfg(feature = "wgpu")]
#[test]
fn devices_are_listed_with_their_limits_and_whether_a_scene_fits() -> Result<(), Box<dyn Error>> {
    let listed = output(&["devices", "--scene", DEMO])?;
    let said = String::from_utf8(listed.stdout)?;
    assert!(listed.status.success(), "{said}");
    assert!(said.contains("flex     the CPU"), "{said}");
    if said.contains("wgpu     no adapter") {
        skipped("devices and what fits", "no adapter")?;
        return Ok(());
    }
    for part in [
        "a buffer",
        "buffers a kernel",
        "units a cube",
        "the scene fits: with",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    Ok(())
}
