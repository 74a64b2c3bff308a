//! How depth, poses and masks may have been meant.

use glam::{DAffine3, DMat3, DVec3};
use io::{Frame, Map};
use std::borrow::Cow;

/// A custom of writing poses.
#[derive(Clone, Copy, Debug)]
struct Convention {
    /// What the files hold; `None` where it is what their layout says.
    name: Option<&'static str>,
    /// The pose that was meant, from what reading them by their layout gave.
    meant: fn(&DAffine3) -> DAffine3,
}

/// As given first.
const NERFSTUDIO: [Convention; 4] = [
    AS_GIVEN,
    Convention {
        name: Some("camera-to-world matrices with OpenCV axes (y down, z ahead)"),
        meant: |pose| flip() * *pose,
    },
    Convention {
        name: Some("world-to-camera matrices with OpenGL axes"),
        meant: |pose| flip() * pose.inverse() * flip(),
    },
    Convention {
        name: Some("world-to-camera matrices with OpenCV axes"),
        meant: |pose| (flip() * *pose).inverse(),
    },
];

/// As given first.
const COLMAP: [Convention; 4] = [
    AS_GIVEN,
    Convention {
        name: Some("world-to-camera poses with OpenGL axes (y up, z back)"),
        meant: |pose| flip() * *pose,
    },
    Convention {
        name: Some("camera-to-world poses"),
        meant: DAffine3::inverse,
    },
    Convention {
        name: Some("camera-to-world poses with OpenGL axes"),
        meant: |pose| flip() * pose.inverse(),
    },
];

const AS_GIVEN: Convention = Convention {
    name: None,
    meant: |pose| *pose,
};

/// OpenCV's camera axes from OpenGL's, and back: y and z point the other way.
fn flip() -> DAffine3 {
    DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)))
}

/// A way to read depth, poses and masks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reading {
    convention: Convention,
    /// Depth is where disparity is meant, or the other way round.
    pub(super) inverse_depth: bool,
    /// Masks show what does not move.
    pub(super) inverse_masks: bool,
    /// Depth is in a unit of its own.
    pub(super) free_scale: bool,
}

impl Reading {
    /// What the files' poses are, where it is not what their layout says.
    pub(super) fn poses(&self) -> Option<&'static str> {
        self.convention.name
    }

    /// What moves by a frame's mask.
    pub(super) fn mask<'a>(&self, mask: &'a Map) -> Cow<'a, Map> {
        if !self.inverse_masks {
            return Cow::Borrowed(mask);
        }
        let values = mask.values.iter().map(|value| 1.0 - value).collect();
        Cow::Owned(Map { values, ..*mask })
    }

    /// The frame's pose.
    pub(super) fn pose(&self, frame: &Frame) -> DAffine3 {
        (self.convention.meant)(&frame.view.cam_from_world)
    }

    /// Whether a frame's pixel shows something that moves.
    pub(super) fn moves(&self, frame: &Frame, pixel: usize) -> bool {
        let mask = frame.mask.as_ref();
        mask.is_some_and(|m| (m.values[pixel] > 0.5) != self.inverse_masks)
    }

    /// z-depth of a pixel before it is aligned; 0 where it is missing.
    pub(super) fn depth(&self, frame: &Frame, pixel: usize) -> f64 {
        let z = frame.depth.as_ref().map_or(0.0, |d| d.values[pixel]);
        match f64::from(z) {
            z if z <= 0.0 || z.is_infinite() => 0.0,
            z if self.inverse_depth => 1.0 / z,
            z => z,
        }
    }
}

/// As given first. Without points that tell depth's unit, other readings have one of their own.
pub(super) fn readings(layout: &str, inverse_masks: bool, free_scale: bool) -> Vec<Reading> {
    let conventions = if layout == "nerfstudio" {
        NERFSTUDIO
    } else {
        COLMAP
    };
    let reading = |inverse_depth, free_scale, convention| Reading {
        convention,
        inverse_depth,
        inverse_masks,
        free_scale,
    };
    let given = reading(false, false, AS_GIVEN);
    let others = [false, true].into_iter().flat_map(|inverse_depth| {
        conventions.map(|convention| reading(inverse_depth, free_scale, convention))
    });
    // The first of these is another one only with a scale of its own.
    let others = others.skip(usize::from(!free_scale));
    std::iter::once(given).chain(others).collect()
}
