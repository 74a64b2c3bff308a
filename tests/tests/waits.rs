//! What an iteration waits for: everything on a device is launched ahead of it, but for what has to come back.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use limpid_tests::devices;
use limpid_tests::tiny::{scene, settings};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};
use trainer::Trainer;
use trainer::settings::BlurKind;

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

#[test]
fn an_iteration_waits_for_its_own_account_and_for_what_sorting_needs() {
    for (name, device) in devices() {
        // Only a GPU is waited for in a render: its buffers are made for the number of slots.
        let sorts = usize::from(!matches!(name, "flex" | "ndarray"));
        for (model, waits, renders) in [
            (BlurKind::Kernels, 1, 1),
            // What the camera did decides how many samples there are, beside the sharp render.
            (BlurKind::Camera, 2, 2),
        ] {
            let mut settings = settings();
            settings.blur.model = model;
            let mut trainer = Trainer::new(scene(), settings, &device).expect("a trainer");
            let schedule = trainer.schedule().clone();
            let counted = Waits::default();
            let (mut seen, mut controlled) = (0, 0);
            for it in 1..=60 {
                let before = counted.0.load(Ordering::Relaxed);
                let step = || trainer.step().map(|_| ());
                tracing::subscriber::with_default(counted.clone(), step).expect("a step");
                let found = counted.0.load(Ordering::Relaxed) - before;
                let on = schedule.blur_moments.first().is_some_and(|from| it > *from);
                let most = if on {
                    waits + sorts * renders
                } else {
                    1 + sorts
                };
                // Trials and the dynamic densification are rare, and look at many frames.
                let rare = schedule.blur_moments.contains(&(it - 1))
                    || schedule.densify_dynamic_at == Some(it);
                let controls = schedule.controls_density(it);
                if !rare {
                    assert!(
                        found <= most + usize::from(controls),
                        "{name}, {model:?}, iteration {it}: waited {found} times, not {most}"
                    );
                    seen = seen.max(found);
                }
                controlled += usize::from(controls);
            }
            assert!(seen >= 1, "{name}: an iteration's losses come back");
            assert!(controlled > 0, "density control is among the iterations");
        }
    }
}
