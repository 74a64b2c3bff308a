//! A picture of the demo after a fixed number of iterations, against the one that was kept.
//!
//! `cargo xtask bless` trains it again and keeps it. Bits differ between processors, so that the pictures may differ by
//! [`CLOSE`]; what is broken differs by far more. A rate that is off by a millionth differs by 52 dB or more, but by 31 to 39 dB where
//! density control chooses what to clone and to split: that is left out.

use io::{LoadOptions, Scene};
use std::path::Path;
use trainer::metrics::psnr;
use trainer::{Device, Settings, Trainer};

/// PSNR from which two pictures count as the same, dB.
const CLOSE: f64 = 40.0;

#[test]
fn the_demo_looks_as_it_did() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let options = LoadOptions {
        downscale: 2,
        ..LoadOptions::default()
    };
    let scene = Scene::open_with(&root.join("demo"), &options).expect("the demo");
    let mut settings = Settings {
        iterations: 200,
        ..Settings::default()
    };
    settings.motion.first_fit_steps = 100;
    settings.motion.densify = false;
    settings.gaussians.control_until = 0;
    let mut trainer = Trainer::new(scene, settings, &Device::flex()).expect("a trainer");
    for _ in 0..120 {
        trainer.step().expect("a step");
    }
    let view = &trainer.run().views().test[5];
    let picture = trainer
        .run()
        .render_view(&view.camera, &view.cam_from_world, view.time)
        .expect("a picture");

    let golden = root.join("tests/golden/demo.png");
    if std::env::var_os("LIMPID_BLESS").is_some() {
        io::write_png(&golden, &picture).expect("the picture is kept");
        return;
    }
    let kept = io::read_image(&golden).expect("a picture that was kept");
    let found = psnr(&kept.pixels, &picture.pixels);
    assert!(
        found > CLOSE,
        "{found:.1} dB from {}; if that is right, `cargo xtask bless` keeps the new one",
        golden.display()
    );
}
