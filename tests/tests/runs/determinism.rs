//! The same seed gives the same bits: in processes of their own, with one and two threads, and with a save and load in the middle.

use burn::tensor::Device;
use limpid_tests::{tiny, values};
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::Command;
use trainer::settings::BlurKind;
use trainer::{BlurModel, Trainer};

/// Tells a process of this test that it is one of the runs: with which blur model, and at which iteration it saves and loads
/// (0: never).
const RUN: &str = "LIMPID_DETERMINISM_RUN";
const ITERATIONS: usize = 200;

/// Trains with every part of the method on, and writes down the losses and parameters bit by bit.
fn train(blur: BlurKind, reload_at: usize) -> String {
    let device = Device::flex();
    let mut settings = tiny::settings();
    settings.blur.model = blur;
    let mut trainer = Trainer::new(tiny::scene(), settings, &device).expect("a trainer");
    let (mut unseen, mut sizes) = (0, Vec::new());
    let mut text = String::new();
    for iteration in 1..=ITERATIONS {
        let report = trainer.step().expect("a step");
        unseen +=
            usize::from(report.view.contains("parallel") || report.view.contains("perpendicular"));
        sizes.push(report.gaussians);
        write!(text, "{:016x} ", report.loss.to_bits()).expect("writing to a string");
        if iteration == reload_at {
            let folder = tempfile::tempdir().expect("a temporary folder");
            trainer.save(folder.path()).expect("saved");
            trainer = Trainer::load(folder.path(), tiny::scene(), &device).expect("loaded");
        }
    }
    sizes.dedup();
    assert!(unseen > 10, "{unseen} unseen views");
    assert!(sizes.len() > 2, "density control did nothing: {sizes:?}");
    let model = trainer.model();
    assert!(
        !matches!(model.blur, BlurModel::Off) && model.world.motion.is_some(),
        "a part is missing"
    );
    for (parameter, tensor) in trainer.model().parameters() {
        // FNV-1a.
        let bits = values(tensor)
            .into_iter()
            .fold(0xcbf2_9ce4_8422_2325_u64, |hash, v| {
                (hash ^ v.to_bits()).wrapping_mul(0x0100_0000_01b3)
            });
        write!(text, "\n{} {bits:016x}", parameter.name).expect("writing to a string");
    }
    text
}

#[test]
fn processes_threads_and_reloading_change_no_bit() {
    if let Ok(run) = std::env::var(RUN) {
        let (blur, reload_at) = run.split_once(' ').expect("a model and a number");
        let blur = match blur {
            "kernels" => BlurKind::Kernels,
            "both" => BlurKind::Both,
            _ => BlurKind::Camera,
        };
        let text = train(blur, reload_at.parse().expect("a number"));
        writeln!(std::io::stdout(), "<run>{text}</run>").expect("a line to stdout");
        return;
    }
    let run = |blur: &str, threads: &str, reload_at: &str| -> String {
        let this = std::env::current_exe().expect("this test's program");
        let output = Command::new(this)
            .args([
                "--exact",
                "determinism::processes_threads_and_reloading_change_no_bit",
                "--nocapture",
            ])
            .env(RUN, format!("{blur} {reload_at}"))
            .env("RAYON_NUM_THREADS", threads)
            .output()
            .expect("a second process");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{text}{errors}");
        let (_, rest) = text.split_once("<run>").expect("a result");
        rest.split_once("</run>")
            .expect("a whole result")
            .0
            .to_owned()
    };
    // With both, kernels come in after the last trial, at iteration 170.
    for (blur, middle) in [("kernels", "110"), ("camera", "110"), ("both", "185")] {
        let one = run(blur, "1", "0");
        assert_eq!(one, run(blur, "2", "0"), "{blur}: one and two threads");
        let saved = run(blur, "2", middle);
        assert_eq!(one, saved, "{blur}: saved and loaded in the middle");
    }
}
