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

/// As given first. Files of LLFF hold these as well, with their axes in another order.
const CAMERA_TO_WORLD: [Convention; 4] = [
    AS_GIVEN,
    Convention {
        name: Some("camera-to-world poses with OpenGL axes (y up, z back)"),
        meant: |pose| flip() * *pose,
    },
    Convention {
        name: Some("world-to-camera poses"),
        meant: DAffine3::inverse,
    },
    Convention {
        name: Some("world-to-camera poses with OpenGL axes"),
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

/// The customs that files of a layout may be in.
fn conventions(layout: &str) -> [Convention; 4] {
    match layout {
        "nerfstudio" => NERFSTUDIO,
        "MegaSaM" | "ViPE" | "DyBluRF" | "D2RF" => CAMERA_TO_WORLD,
        _ => COLMAP,
    }
}

/// What masks are taken to show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Masks {
    /// Nothing: there are none, or they are left out.
    Nothing,
    /// What moves.
    Moving,
    /// What stands still.
    Still,
}

/// A way to read depth, poses and masks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reading {
    convention: Convention,
    /// Depth is where disparity is meant, or the other way round.
    pub(super) inverse_depth: bool,
    pub(super) masks: Masks,
    /// Depth is in a unit of its own.
    pub(super) free_scale: bool,
}

impl Reading {
    /// What the files' poses are, where it is not what their layout says.
    pub(super) fn poses(&self) -> Option<&'static str> {
        self.convention.name
    }

    /// What moves by a frame's mask, where that shows anything.
    pub(super) fn mask<'a>(&self, frame: &'a Frame) -> Option<Cow<'a, Map>> {
        let mask = frame.mask.as_ref()?;
        match self.masks {
            Masks::Nothing => None,
            Masks::Moving => Some(Cow::Borrowed(mask)),
            Masks::Still => {
                let values = mask.values.iter().map(|value| 1.0 - value).collect();
                Some(Cow::Owned(Map { values, ..*mask }))
            }
        }
    }

    /// The frame's pose.
    pub(super) fn pose(&self, frame: &Frame) -> DAffine3 {
        (self.convention.meant)(&frame.view.cam_from_world)
    }

    /// Whether a frame's pixel shows something that moves.
    pub(super) fn moves(&self, frame: &Frame, pixel: usize) -> bool {
        let mask = frame.mask.as_ref();
        let is_white = mask.map(|m| m.values[pixel] > 0.5);
        match self.masks {
            Masks::Nothing => false,
            Masks::Moving => is_white == Some(true),
            Masks::Still => is_white == Some(false),
        }
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
pub(super) fn readings(layout: &str, masks: Masks, free_scale: bool) -> Vec<Reading> {
    let conventions = conventions(layout);
    let reading = |inverse_depth, free_scale, convention| Reading {
        convention,
        inverse_depth,
        masks,
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
