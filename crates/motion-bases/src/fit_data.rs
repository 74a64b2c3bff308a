//! What the first fit compares with: tracks and cameras, laid out as its kernel walks through them.

use crate::MotionError;
use crate::cpu::lanes::LANES;
use crate::cpu::moved::PIECE;
use crate::init::MotionInit;
use glam::{DAffine3, DVec3};
use std::ops::Range;
use std::sync::Arc;

/// Entries (tracks times frames) that a step looks at. With more than that the tracks are dealt into
/// groups of equal size, track by track in turn, and the steps go through the groups.
const STEP_ENTRIES: usize = 36_000;
/// Smallest z-depth, relative to the extent, by which a projection divides.
pub(crate) const MIN_DEPTH: f64 = 1e-5;

/// The camera of a frame, as plain values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitCamera {
    /// Pose; the camera looks along z, with x to the right and y down.
    pub cam_from_world: DAffine3,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point's x, in pixels.
    pub cx: f64,
    /// Principal point's y, in pixels.
    pub cy: f64,
}

/// What the first fit compares with: tracks and cameras, in main memory.
#[derive(Clone, Debug)]
pub struct FitData {
    pub(crate) problem: Arc<Problem>,
}

/// See [`FitData`].
#[derive(Debug)]
pub(crate) struct Problem {
    pub(crate) num_tracks: usize,
    pub(crate) num_frames: usize,
    /// Lengths are divided by this (scene units).
    pub(crate) extent: f64,
    pub(crate) groups: Vec<Group>,
    /// Rows u, v, z of each frame's projection of points over the extent; u and v in units of fx.
    pub(crate) projections: Vec<[[f64; 4]; 3]>,
    /// Camera centres over the extent.
    pub(crate) centers: Vec<DVec3>,
}

/// The tracks of one step.
#[derive(Debug)]
pub(crate) struct Group {
    /// The first track, and every how many of them it takes.
    first: usize,
    stride: usize,
    /// How many there are.
    pub(crate) len: usize,
    /// Positions over the extent, and behind them the confidence where visible, divided by three times its sum; for
    /// [`LANES`] tracks after the other all frames. 0 behind the last track.
    pub(crate) tracks: Vec<[[f64; LANES]; 4]>,
    /// Entries that are known to be hidden, track by track: only the pixel counts.
    pub(crate) hidden: Vec<Hidden>,
}

/// A track of a group in a frame in which it is hidden.
#[derive(Debug)]
pub(crate) struct Hidden {
    /// Which of the group's tracks.
    pub(crate) row: usize,
    pub(crate) frame: usize,
    /// Pixel over fx.
    pub(crate) pixel: [f64; 2],
    /// Confidence.
    pub(crate) weight: f64,
}

impl Hidden {
    /// Where it stands among the vectors of its piece, which has [`LANES`] tracks after the other all frames: which vector, and
    /// which lane.
    pub(crate) fn place(&self, num_frames: usize) -> (usize, usize) {
        let in_piece = self.row % PIECE;
        (in_piece / LANES * num_frames + self.frame, self.row % LANES)
    }
}

/// A step of the first fit.
#[derive(Clone, Debug)]
pub(crate) struct FitStep {
    pub(crate) problem: Arc<Problem>,
    /// Which group of tracks it looks at.
    pub(crate) group: usize,
    /// Weight of smoothness.
    pub(crate) smooth: f64,
}

impl FitStep {
    pub(crate) fn group(&self) -> &Group {
        &self.problem.groups[self.group]
    }
}

impl FitData {
    /// Prepares tracks and cameras (one per frame).
    ///
    /// # Errors
    /// [`MotionError::Length`] when the number of cameras is not that of the frames,
    /// [`MotionError::BadCamera`] for numbers that are not finite or focal lengths that are not positive.
    pub fn new(init: &MotionInit, cameras: &[FitCamera]) -> Result<Self, MotionError> {
        let (num_tracks, num_frames) = (init.tracks.len(), init.tracks.num_frames);
        if cameras.len() != num_frames {
            return Err(MotionError::Length {
                what: "cameras",
                found: cameras.len(),
                expected: num_frames,
            });
        }
        let projections: Vec<[[f64; 4]; 3]> = cameras
            .iter()
            .enumerate()
            .map(|(frame, camera)| {
                projection_rows(camera, init.extent).ok_or(MotionError::BadCamera { frame })
            })
            .collect::<Result<_, _>>()?;
        let centers = cameras
            .iter()
            .map(|c| c.cam_from_world.inverse().translation / init.extent)
            .collect();
        let stride = (num_tracks * num_frames)
            .div_ceil(STEP_ENTRIES)
            .clamp(1, num_tracks.max(1));
        let groups = (0..stride).map(|first| Group::new(init, (first, stride), &projections));
        Ok(Self {
            problem: Arc::new(Problem {
                num_tracks,
                num_frames,
                extent: init.extent,
                groups: groups.collect(),
                projections,
                centers,
            }),
        })
    }
}

impl Group {
    fn new(
        init: &MotionInit,
        (first, stride): (usize, usize),
        projections: &[[[f64; 4]; 3]],
    ) -> Self {
        let (tracks, num_frames) = (&init.tracks, init.tracks.num_frames);
        let rows: Vec<usize> = (first..tracks.len()).step_by(stride).collect();
        let entry = |row: usize, t: usize| tracks.index(row, t);
        let seen = |i: usize| match tracks.visible[i] {
            true => f64::from(tracks.confidence[i]),
            false => 0.0,
        };
        let entries = rows
            .iter()
            .flat_map(|&row| (0..num_frames).map(move |t| entry(row, t)));
        let total: f64 = entries.map(seen).sum();

        let mut lanes = Vec::with_capacity(rows.len().div_ceil(LANES) * num_frames);
        for rows in rows.chunks(LANES) {
            for t in 0..num_frames {
                let mut each = [[0.0; LANES]; 4];
                for (lane, &row) in rows.iter().enumerate() {
                    let i = entry(row, t);
                    let [x, y, z] = (tracks.positions[i] / init.extent).to_array();
                    let values = [x, y, z, seen(i) / (3.0 * total + 1e-8)];
                    for (lanes, value) in each.iter_mut().zip(values) {
                        lanes[lane] = value;
                    }
                }
                lanes.push(each);
            }
        }
        let hidden_at = |(row, frame): (usize, usize)| {
            let i = entry(rows[row], frame);
            let confidence = f64::from(tracks.confidence[i]);
            let is_hidden = !tracks.visible[i] && confidence > 0.0;
            let pixel = is_hidden
                .then(|| project(&projections[frame], init.observed[i] / init.extent))
                .flatten()?;
            Some(Hidden {
                row,
                frame,
                pixel,
                weight: confidence,
            })
        };
        let all = (0..rows.len()).flat_map(|row| (0..num_frames).map(move |frame| (row, frame)));
        Self {
            first,
            stride,
            len: rows.len(),
            tracks: lanes,
            hidden: all.filter_map(hidden_at).collect(),
        }
    }

    /// Its tracks.
    pub(crate) fn rows(&self) -> impl Iterator<Item = usize> + use<> {
        (self.first..).step_by(self.stride).take(self.len)
    }

    /// Those of [`Self::hidden`] that are of some of its tracks.
    pub(crate) fn hidden_in(&self, rows: Range<usize>) -> &[Hidden] {
        let before = |row: usize| self.hidden.partition_point(|hidden| hidden.row < row);
        &self.hidden[before(rows.start)..before(rows.end)]
    }
}

/// Rows u, v, z of the projection of points over `extent`: the pixel in units of fx is (u / z, v / z).
fn projection_rows(camera: &FitCamera, extent: f64) -> Option<[[f64; 4]; 3]> {
    let FitCamera {
        cam_from_world,
        fx,
        fy,
        cx,
        cy,
    } = *camera;
    let finite = cam_from_world.is_finite() && [fx, fy, cx, cy].iter().all(|v| v.is_finite());
    if !finite || fx <= 0.0 || fy <= 0.0 || cam_from_world.matrix3.determinant() == 0.0 {
        return None;
    }
    let (m, t) = (cam_from_world.matrix3, cam_from_world.translation / extent);
    let row = |k: usize| [m.x_axis[k], m.y_axis[k], m.z_axis[k], t[k]];
    let (x, y, z) = (row(0), row(1), row(2));
    let mut rows = [[0.0; 4], [0.0; 4], z];
    for j in 0..4 {
        rows[0][j] = x[j] + cx / fx * z[j];
        rows[1][j] = (fy * y[j] + cy * z[j]) / fx;
    }
    Some(rows)
}

/// Pixel in units of fx, if the point lies before the camera.
fn project(rows: &[[f64; 4]; 3], point: DVec3) -> Option<[f64; 2]> {
    let [u, v, z] = rows.map(|r| r[0] * point.x + r[1] * point.y + r[2] * point.z + r[3]);
    (z > MIN_DEPTH).then(|| [u / z, v / z])
}
