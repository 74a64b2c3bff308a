//! Sixty iterations with each model of blur: the loss falls, every part of the method is used, and everything on a device is
//! launched ahead of it, but for what has to come back.

use limpid_tests::tiny::{parameter, scene, settings};
use limpid_tests::{devices, devices_for_long_trainings};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};
use trainer::settings::{BlurKind, When};
use trainer::{StepReport, Trainer};

/// Counts the spans in which values are read back.
#[derive(Clone, Default)]
struct Waits(Arc<AtomicUsize>);

impl Subscriber for Waits {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.name() == host::WAIT
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        self.0.fetch_add(1, Ordering::Relaxed);
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn event(&self, _: &Event<'_>) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

/// The next iteration, and how often it waited.
fn step(trainer: &mut Trainer) -> (StepReport, usize) {
    let counted = Waits::default();
    let step = || trainer.step().expect("a step");
    let report = tracing::subscriber::with_default(counted.clone(), step);
    (report, counted.0.load(Ordering::Relaxed))
}

/// How often the next iteration may wait on a backend; none where it is one of the rare ones that look at many frames, which
/// are trials and the dynamic densification.
fn most_waits(trainer: &Trainer, name: &str) -> Option<usize> {
    let (it, schedule) = (trainer.iteration() + 1, trainer.schedule());
    if schedule.blur_moments.contains(&(it - 1)) || schedule.densify_dynamic_at == Some(it) {
        return None;
    }
    let is_blurred = schedule.blur_moments.first().is_some_and(|from| it > *from);
    // An account at the end and a sharp render; with the camera, what it did, which decides how many samples there are, and these.
    let exposes = is_blurred && trainer.settings().blur.model == BlurKind::Camera;
    let renders = 1 + usize::from(exposes);
    // Only a GPU is waited for in a render: its buffers are made for the number of slots.
    let sorts = usize::from(!matches!(name, "flex" | "ndarray"));
    Some((1 + sorts) * renders + usize::from(schedule.controls_density(it)))
}

/// Iterations between two acts of density control, each of which disturbs what was fitted until then.
const CONTROL_EVERY: usize = 25;

/// Sixty iterations, in which the pictures' loss must fall until density control acts for the second time, and again behind it;
/// no iteration may wait for more than has to come back. The terms of the loss that there were.
fn sixty_steps(trainer: &mut Trainer, name: &str) -> BTreeSet<&'static str> {
    let mut terms = BTreeSet::new();
    let mut losses = Vec::new();
    let mut controlled = 0;
    for it in 1..=60 {
        let most = most_waits(trainer, name);
        controlled += usize::from(trainer.schedule().controls_density(it));
        let (report, waited) = step(trainer);
        // A thread without a subscriber that meets the span first may hide it until the next subscriber comes, which is the next
        // iteration's.
        assert!(
            waited >= 1 || it == 1,
            "{name}, iteration {it}: its losses come back"
        );
        assert!(
            most.is_none_or(|most| waited <= most),
            "{name}, iteration {it}: waited {waited} times, not {most:?}"
        );
        terms.extend(report.terms.iter().map(|(term, _)| *term));
        let images = report.terms.iter().filter(|(term, _)| *term == "image");
        losses.push(images.map(|(_, value)| value).sum::<f64>());
    }
    assert!(controlled > 0, "density control is among the iterations");
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    let (before, behind) = losses.split_at(2 * CONTROL_EVERY);
    assert!(
        mean(&before[40..]) < 0.5 * mean(&before[..10]),
        "{name}: {losses:?}"
    );
    assert!(
        mean(&behind[5..]) < 0.8 * mean(&behind[..5]),
        "{name}, behind density control: {losses:?}"
    );
    terms
}

#[test]
fn sixty_steps_lower_the_loss_use_every_part_and_wait_for_no_more_than_comes_back() {
    for (name, device) in devices() {
        let mut trainer = Trainer::new(scene(), settings(), &device).expect("a trainer");
        assert!(
            trainer.survey().movers,
            "{name}: {:?}",
            trainer.survey().notes
        );
        let start = trainer.model().clone();
        let terms = sixty_steps(&mut trainer, name);
        let wanted = [
            "along_ray",
            "bases_acceleration",
            "depth",
            "gauge",
            "image",
            "mask",
            "means_acceleration",
        ];
        for term in wanted {
            assert!(terms.contains(term), "{name}: no term {term} in {terms:?}");
        }
        assert!(
            trainer.model().num_dynamic() > start.num_dynamic(),
            "{name}: dynamic densification adds Gaussians"
        );
        for (parameter, after) in trainer.model().parameters() {
            let before = start
                .parameters()
                .into_iter()
                .find(|(n, _)| *n == parameter)
                .expect("same names")
                .1;
            let moved = before.dims() != after.dims()
                || (before.inner() - after.inner())
                    .abs()
                    .max()
                    .into_scalar::<f32>()
                    > 0.0;
            assert!(moved, "{name}: {} has not moved", parameter.name);
        }
    }
}

#[test]
fn sixty_steps_with_the_camera_lower_the_loss_open_paths_and_wait_for_no_more_than_comes_back() {
    for (name, device) in devices() {
        let mut settings = settings();
        settings.blur.model = BlurKind::Camera;
        let mut trainer = Trainer::new(scene(), settings, &device).expect("a trainer");
        sixty_steps(&mut trainer, name);
        for (parameter, values) in trainer.model().parameters() {
            let values = values.try_into_vec_as::<f32>().expect("readable");
            let finite = values.iter().all(|value| value.is_finite());
            assert!(finite, "{name}: {}", parameter.name);
            let is_path = parameter.name == "camera.paths";
            assert!(!is_path || values.iter().any(|v| *v != 0.0), "{name}");
        }
    }
}

/// Also with kernels on top of it, which have moments of their own, some of which never come.
#[test]
fn an_aperture_learns_once_trials_leave_the_camera_alone() {
    for (name, device) in devices_for_long_trainings() {
        for model in [BlurKind::Camera, BlurKind::Both] {
            let mut settings = settings();
            settings.blur.model = model;
            settings.camera.lens = When::Always;
            settings.loss.downsample_after = usize::MAX;
            let mut trainer = Trainer::new(scene(), settings, &device).expect("a trainer");
            let aperture = |trainer: &Trainer| parameter(trainer, "camera.aperture");
            let start = aperture(&trainer);
            let settled = trainer.schedule().camera_settled.expect("a camera");
            for _ in 0..settled {
                trainer.step().expect("a step");
            }
            assert_eq!(aperture(&trainer), start, "{name}, {model:?}");
            // The last trial may leave another one.
            trainer.step().expect("a step");
            let freed = aperture(&trainer);
            trainer.step().expect("a step");
            assert_ne!(aperture(&trainer), freed, "{name}, {model:?}");
        }
    }
}
