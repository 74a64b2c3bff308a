//! What a piece of the program launches on the device, and how often it waits for it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use cubecl::logging::{LaunchObservation, LaunchObserver};
use host::WAIT;
use serde::Serialize;

use crate::spans::{Stages, innermost};

/// What was launched and waited for.
#[derive(Clone, Debug, Serialize)]
pub struct Counted {
    /// Kernels that were launched.
    pub launches: usize,
    /// How often something was waited for.
    pub waits: usize,
    /// Launches by kernel, most of them first.
    pub kernels: Vec<Row>,
    /// Launches by the innermost span that was open, most of them first.
    pub stages: Vec<Row>,
}

/// How often something was launched.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// What.
    pub name: String,
    /// How often.
    pub launches: usize,
}

/// Launches by the kernel's name and the span.
type Table = BTreeMap<(&'static str, &'static str), usize>;

#[derive(Default)]
struct Observer(Mutex<Table>);

impl Observer {
    fn table(&self) -> MutexGuard<'_, Table> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl LaunchObserver for Observer {
    fn launched(&self, kernel: &'static str) {
        let stage = innermost().unwrap_or("no span");
        *self.table().entry((kernel, stage)).or_default() += 1;
    }
}

/// Does something and counts what it launches, on any device, and how often it waits, if `stages` is the program's subscriber.
pub fn count<T>(stages: &Stages, piece: impl FnOnce() -> T) -> (T, Counted) {
    drop(stages.take());
    let observer = Arc::new(Observer::default());
    let watching = LaunchObservation::new(observer.clone());
    let result = piece();
    drop(watching);
    let waits = stages.take().get(WAIT).map_or(0, |stage| stage.count);
    let table = observer.table();
    let counted = Counted {
        launches: table.values().sum(),
        waits,
        kernels: rows(&table, |(kernel, _)| short(kernel)),
        stages: rows(&table, |(_, stage)| stage.to_owned()),
    };
    drop(table);
    (result, counted)
}

fn rows(table: &Table, name: impl Fn((&'static str, &'static str)) -> String) -> Vec<Row> {
    let mut sums: BTreeMap<String, usize> = BTreeMap::new();
    for (&key, launches) in table {
        *sums.entry(name(key)).or_default() += launches;
    }
    let mut rows: Vec<Row> = sums
        .into_iter()
        .map(|(name, launches)| Row { name, launches })
        .collect();
    rows.sort_by_key(|row| std::cmp::Reverse(row.launches));
    rows
}

/// A kernel's crate, file and function: `a::cube::b::c::C<f32>` is `a b::c`.
fn short(name: &str) -> String {
    let path = name.split('<').next().unwrap_or(name);
    match path.split("::").collect::<Vec<_>>()[..] {
        [owner, .., file, function, _] => format!("{owner} {file}::{function}"),
        _ => path.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_span_of_a_wait_counts() {
        let stages = Stages::default();
        let (_, counted) = tracing::subscriber::with_default(stages.clone(), || {
            count(&stages, || {
                for _ in 0..3 {
                    let _render = tracing::trace_span!("render").entered();
                    let _wait = tracing::trace_span!(WAIT).entered();
                }
            })
        });
        assert_eq!((counted.waits, counted.launches), (3, 0));
    }

    #[test]
    fn launches_are_counted_by_kernel_and_by_stage() {
        let observer = Observer::default();
        let kernels = ["a::cube::b::c::C<f32, a::D>", "a::cube::b::c::C<u32>", "e"];
        for kernel in kernels.iter().chain(&kernels[..1]) {
            observer.launched(kernel);
        }
        let table = observer.table();
        let named = |rows: Vec<Row>| -> Vec<(String, usize)> {
            rows.into_iter().map(|r| (r.name, r.launches)).collect()
        };
        let by_kernel = named(rows(&table, |(kernel, _)| short(kernel)));
        assert_eq!(by_kernel, [("a b::c".to_owned(), 3), ("e".to_owned(), 1)]);
        let by_stage = named(rows(&table, |(_, stage)| stage.to_owned()));
        assert_eq!(by_stage, [("no span".to_owned(), 4)]);
    }
}
