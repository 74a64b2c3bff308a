//! Time by stage: a subscriber that adds up how long each span was entered, without the spans inside it.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};

/// Time of a stage in itself, and how often it ran.
#[derive(Clone, Copy, Debug, Default)]
pub struct Stage {
    /// Without what ran inside it.
    pub time: Duration,
    /// How often it was entered.
    pub count: usize,
}

/// Adds up time by the name of the span. Spans are entered and left on one thread; what that thread waits for counts as its own.
#[derive(Clone, Debug, Default)]
pub struct Stages(Arc<Mutex<Table>>);

#[derive(Debug, Default)]
struct Table {
    /// A span's id is one more than the place of its name.
    names: Vec<&'static str>,
    stages: BTreeMap<&'static str, Stage>,
}

/// A span that is entered: its name, since when, and the time inside it that belongs to others.
type Open = (&'static str, Instant, Duration);

thread_local! {
    static OPEN: RefCell<Vec<Open>> = const { RefCell::new(Vec::new()) };
}

/// The innermost span that this thread has entered, if [`Stages`] watches.
#[must_use]
pub fn innermost() -> Option<&'static str> {
    OPEN.with_borrow(|open| Some(open.last()?.0))
}

impl Stages {
    fn table(&self) -> std::sync::MutexGuard<'_, Table> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What was added up since the last call, by name.
    #[must_use]
    pub fn take(&self) -> BTreeMap<&'static str, Stage> {
        std::mem::take(&mut self.table().stages)
    }
}

impl Subscriber for Stages {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_span()
    }

    fn new_span(&self, span: &Attributes<'_>) -> Id {
        let name = span.metadata().name();
        let names = &mut self.table().names;
        let place = names.iter().position(|n| *n == name).unwrap_or_else(|| {
            names.push(name);
            names.len() - 1
        });
        Id::from_u64(place as u64 + 1)
    }

    fn record(&self, _span: &Id, _values: &Record<'_>) {}

    fn record_follows_from(&self, _span: &Id, _follows: &Id) {}

    fn event(&self, _event: &Event<'_>) {}

    fn enter(&self, span: &Id) {
        let name = self.table().names[span.into_u64() as usize - 1];
        OPEN.with_borrow_mut(|open| open.push((name, Instant::now(), Duration::ZERO)));
    }

    fn exit(&self, _span: &Id) {
        OPEN.with_borrow_mut(|open| {
            let Some((name, since, others)) = open.pop() else {
                return;
            };
            let whole = since.elapsed();
            if let Some((_, _, others)) = open.last_mut() {
                *others += whole;
            }
            let mut table = self.table();
            let stage = table.stages.entry(name).or_default();
            stage.time += whole.saturating_sub(others);
            stage.count += 1;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::sleep;

    #[test]
    fn time_belongs_to_the_innermost_span() {
        let stages = Stages::default();
        let wait = Duration::from_millis(20);
        let began = Instant::now();
        tracing::subscriber::with_default(stages.clone(), || {
            let _outer = tracing::trace_span!("outer").entered();
            sleep(wait);
            for _ in 0..2 {
                let _inner = tracing::trace_span!("inner").entered();
                assert_eq!(innermost(), Some("inner"), "while it is entered");
                sleep(wait);
            }
        });
        let whole = began.elapsed();
        let times = stages.take();
        assert_eq!((times["outer"].count, times["inner"].count), (1, 2));
        assert!(times["outer"].time >= wait && times["inner"].time >= 2 * wait);
        assert!(
            times["outer"].time + times["inner"].time <= whole,
            "{times:?} of {whole:?}: the inner spans' time is their own"
        );
        assert!(stages.take().is_empty(), "counted once");
    }
}
