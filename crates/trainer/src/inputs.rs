//! What a run learns from, known again by its checksums.

use crate::checksum::of_numbers;
use crate::error::OtherScene;
use io::{Map, Scene};
use serde::{Deserialize, Serialize};

/// Checksums of a scene as it was read, before anything is done to it: of each training frame, and of the sparse points. Cameras are
/// compared as they are, and test views teach nothing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Inputs {
    pictures: Vec<u32>,
    depth: Vec<Option<u32>>,
    masks: Vec<Option<u32>>,
    /// Of the points asked for in each frame; empty without tracks.
    tracks: Vec<u32>,
    points: u32,
}

impl Inputs {
    pub(crate) fn of(scene: &Scene) -> Self {
        let frames = || scene.frames.iter();
        let map = |map: &Map| of_numbers(&map.values);
        let queries = scene.tracks.iter().flat_map(|tracks| &tracks.queries);
        let tracks = queries.map(|query| {
            let samples = query.samples.iter();
            let values: Vec<f32> = samples
                .flat_map(|s| [s.x, s.y, s.occlusion, s.expected_distance])
                .collect();
            of_numbers(&values)
        });
        let points = scene.points.iter().flat_map(|point| {
            let position = point.position.to_array().into_iter();
            position.chain(point.color.map(f64::from))
        });
        Self {
            pictures: frames().map(|f| of_numbers(&f.view.image.pixels)).collect(),
            depth: frames().map(|f| f.depth.as_ref().map(map)).collect(),
            masks: frames().map(|f| f.mask.as_ref().map(map)).collect(),
            tracks: tracks.collect(),
            points: of_numbers(&points.collect::<Vec<f64>>()),
        }
    }

    /// Names the first thing of a scene that is another than here; its frames have the same names.
    pub(crate) fn check(&self, scene: &Scene) -> Result<(), OtherScene> {
        let found = Self::of(scene);
        let kinds = [
            ("the picture", first_other(&self.pictures, &found.pictures)),
            ("the depth", first_other(&self.depth, &found.depth)),
            ("the mask", first_other(&self.masks, &found.masks)),
            ("the tracks", first_other(&self.tracks, &found.tracks)),
        ];
        let other = kinds
            .into_iter()
            .find_map(|(kind, at)| Some((kind, &scene.frames.get(at?)?.view.name)));
        let what = match other {
            Some((kind, name)) => format!("{kind} of frame {name}"),
            None if self.points != found.points => "the cloud of sparse points".to_owned(),
            None => return Ok(()),
        };
        Err(OtherScene::OtherInput { what })
    }
}

/// The first place at which two lists differ; that one ends counts.
fn first_other<T: PartialEq>(a: &[T], b: &[T]) -> Option<usize> {
    let differ = a.iter().zip(b).position(|(a, b)| a != b);
    differ.or_else(|| (a.len() != b.len()).then_some(a.len().min(b.len())))
}
