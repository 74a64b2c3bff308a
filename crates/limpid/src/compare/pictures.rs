//! The pictures of several runs, each kept once: frames and truth are the same for all.

use super::likeness::Likeness;
use super::read::{Compared, ViewPictures};
use std::collections::HashMap;

/// Bytes of all pictures, over which some views go without.
const MOST_BYTES: usize = 25_000_000;

/// Where in the pool a view's pictures are.
pub(super) type Places = ViewPictures<usize>;

/// The pictures of all runs.
pub(super) struct Pictures<'a> {
    /// JPEG in base64.
    pub(super) pool: Vec<&'a str>,
    /// Of every run's views; `None` for one of another scene.
    pub(super) places: Vec<Option<Vec<Places>>>,
    /// Every so-manieth view has pictures.
    pub(super) every: usize,
}

impl<'a> Pictures<'a> {
    pub(super) fn of(runs: &'a [Compared], likeness: &[Likeness]) -> Self {
        let all = Self::with(runs, likeness, 1);
        let bytes: usize = all.pool.iter().map(|picture| picture.len()).sum();
        match bytes.div_ceil(MOST_BYTES) {
            0 | 1 => all,
            every => Self::with(runs, likeness, every),
        }
    }

    fn with(runs: &'a [Compared], likeness: &[Likeness], every: usize) -> Self {
        let mut pool = Vec::new();
        let mut known = HashMap::new();
        let mut place = |picture: &'a Option<String>| {
            let picture = picture.as_deref()?;
            Some(*known.entry(picture).or_insert_with(|| {
                pool.push(picture);
                pool.len() - 1
            }))
        };
        let mut places_of = |(index, view): (usize, &'a ViewPictures<String>)| {
            if index % every != 0 {
                return Places::default();
            }
            Places {
                input: place(&view.input),
                seen: place(&view.seen),
                sharp: place(&view.sharp),
                truth: place(&view.truth),
            }
        };
        let places = runs
            .iter()
            .zip(likeness)
            .map(|(run, likeness)| {
                let shown = !matches!(likeness, Likeness::OtherScene(_));
                let views = run.gallery.views.iter().enumerate();
                shown.then(|| views.map(&mut places_of).collect())
            })
            .collect();
        Self {
            pool,
            places,
            every,
        }
    }
}
