//! What a tracker says of a point in a frame.

use glam::DVec2;
use io::TrackSample;

/// Where it is, px.
pub(crate) fn position(sample: &TrackSample) -> DVec2 {
    DVec2::new(f64::from(sample.x), f64::from(sample.y))
}

/// How likely it is seen.
pub(crate) fn visibility(sample: &TrackSample) -> f32 {
    1.0 - sigmoid(sample.occlusion)
}

/// How sure the tracker is of the place.
pub(crate) fn confidence(sample: &TrackSample) -> f32 {
    1.0 - sigmoid(sample.expected_distance)
}

/// Whether the tracker says that it is visible there, and is sure of the place.
pub(crate) fn is_sure(sample: &TrackSample) -> bool {
    visibility(sample) * confidence(sample) > 0.5
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}
