//! What training finds of a camera that is known, on a scene made by the rasteriser itself.

use burn::tensor::Device;
use glam::DVec2;
use limpid_tests::bodies::{Bodies, FRAMES, scene, streak};
use trainer::settings::BlurKind;
use trainer::{Settings, Trainer, ViewBlur};

/// Of a frame, rad.
const SHAKE: f64 = 0.12;
/// Paths that are shorter, px, look the same both ways.
const CLEAR: f64 = 5.0;

/// What stands still is blurred alike by a path and by the same path backwards; what moves is not.
#[test]
fn movers_tell_which_way_paths_run() {
    let device = Device::flex();
    let mut settings = Settings {
        iterations: 400,
        ..Settings::default()
    };
    settings.blur.model = BlurKind::Camera;
    let scene = scene(Bodies::Balls(3), SHAKE, &device);
    let mut trainer = Trainer::new(scene, settings, &device).expect("a trainer");
    while !trainer.is_done() {
        trainer.step().expect("a step");
    }
    let mut clear = 0;
    for frame in 0..FRAMES {
        let view = trainer.run().render_training_view(frame).expect("a view");
        let Some(ViewBlur::Camera(taken)) = view.blur else {
            panic!("no camera");
        };
        let in_the_middle = taken.spots.iter().rfind(|spot| spot.right_px == 0.0);
        let wall = in_the_middle.expect("a spot far away");
        let known = streak(frame, SHAKE, wall.depth);
        if known.length() < CLEAR {
            continue;
        }
        clear += 1;
        let [first, .., last] = wall.places[..] else {
            panic!("{wall:?}");
        };
        let found = taken.shutter.signum() * (DVec2::from(last) - DVec2::from(first));
        let along = found.dot(known) / known.length_squared();
        assert!(
            (0.6..1.2).contains(&along),
            "frame {frame}: {found} px in the place of {known}"
        );
    }
    assert!(clear > FRAMES / 2, "only {clear} frames tell");
}
