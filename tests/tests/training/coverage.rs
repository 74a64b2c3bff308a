//! At the start of a run every pixel of the training frames is covered by Gaussians.

use io::Scene;
use limpid_tests::{devices, tiny, values};
use splat_core::{Extra, Viewpoint, render};
use trainer::{Settings, Trainer};

/// Pixels of all frames that show nothing that moves and through which more than nine tenths of the light pass.
fn holes(trainer: &Trainer, scene: &Scene) -> usize {
    let views = trainer.run().views().train.iter();
    let in_frame = views.zip(&scene.frames).map(|(view, frame)| {
        let splats = trainer.model().detached().world.pose(view.time).splats;
        let viewpoint = Viewpoint::new(&view.camera, &view.cam_from_world, 0, &splats);
        let rendered = render(splats, &viewpoint, Extra::default()).expect("a render");
        let mask = frame.mask.as_ref().expect("the scene has masks");
        let alpha = values(rendered.alpha());
        let pixels = alpha.iter().zip(&mask.values);
        pixels.filter(|(a, m)| **a < 0.1 && **m <= 0.5).count()
    });
    in_frame.sum()
}

/// Takes the depth of all frames where `is_missing` says so of a pixel.
fn without_depth(is_missing: impl Fn(usize, usize) -> bool) -> Scene {
    let mut scene = tiny::scene();
    for frame in &mut scene.frames {
        let depth = frame.depth.as_mut().expect("the scene has depth");
        for (i, z) in depth.values.iter_mut().enumerate() {
            if is_missing(i % tiny::WIDTH, i / tiny::WIDTH) {
                *z = 0.0;
            }
        }
    }
    scene
}

#[test]
fn what_no_gaussian_covers_is_filled_and_reported() {
    for (name, device) in devices() {
        let start = |scene: &Scene| {
            // As many as there are by default: so many leave no hole where there is depth.
            let mut settings = tiny::settings();
            settings.gaussians = Settings::default().gaussians;
            let trainer = Trainer::new(scene.clone(), settings, &device);
            trainer.expect("a trainer")
        };
        let whole = start(&tiny::scene());
        assert_eq!(holes(&whole, &tiny::scene()), 0, "{name}");
        let notes = &whole.survey().notes;
        assert!(
            notes.iter().any(|n| n.starts_with("every pixel")),
            "{name}: {notes:?}"
        );

        // The seven lower rows are without depth in every frame, a corner as well; half of the rows in one frame is the least.
        let scene = without_depth(|x, y| y > 20 || (x < 8 && y < 6));
        let filled = start(&scene);
        assert_eq!(holes(&filled, &scene), 0, "{name}");
        let notes = &filled.survey().notes;
        let told = notes.iter().find(|n| n.contains("covered by no Gaussian"));
        let told = told.unwrap_or_else(|| panic!("{name}: {notes:?}"));
        let number = told.split(' ').next().expect("a number");
        assert!(
            number.parse::<usize>().expect("a number") > 7 * tiny::WIDTH / 2,
            "{name}: {told}"
        );
    }
}
