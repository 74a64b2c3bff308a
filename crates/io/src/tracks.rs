//! 2D tracks in Shape-of-Motion's form: one array [P, 4] for each ordered pair of frames.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::error::list_names;
use crate::folder::list;
use crate::npy::{Array, read_npy, read_npz};
use crate::{IoError, Undistortion};

/// Where one tracked point is in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackSample {
    /// Position in pixels of the (downscaled) training frame; pixel i has its centre at i + 0.5.
    pub x: f32,
    /// As `x`, downwards.
    pub y: f32,
    /// Logit of the probability that the point is occluded.
    pub occlusion: f32,
    /// Logit of the probability that the position is off by more than the tracker's threshold.
    pub expected_distance: f32,
}

/// The tracks of the points that were asked for in one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct QueryTracks {
    /// The training frame whose points these are.
    pub frame: usize,
    /// `[P, num_frames]` row-major: each point in every training frame.
    pub samples: Vec<TrackSample>,
}

/// All tracks of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Tracks {
    /// Number of training frames.
    pub num_frames: usize,
    /// One entry per training frame, in order; some may be empty.
    pub queries: Vec<QueryTracks>,
}

impl Tracks {
    /// Number of tracked points over all query frames.
    #[must_use]
    pub fn num_tracks(&self) -> usize {
        let samples: usize = self.queries.iter().map(|q| q.samples.len()).sum();
        samples / self.num_frames.max(1)
    }

    /// Brings positions to the training frames' size, which is `scale` times that of the pictures they were made of (across and
    /// down), undoes the frames' lenses, and makes the frames smaller. A point that no undistorted picture can show stays where it
    /// is and is hidden.
    pub(crate) fn follow_pictures(
        &mut self,
        scale: [f64; 2],
        undistorted: &[Option<Undistortion>],
        downscale: usize,
    ) {
        /// Logit of a probability that is 1 in f32.
        const HIDDEN: f32 = 100.0;
        let samples = self.queries.iter_mut().flat_map(|q| &mut q.samples);
        for (at, sample) in samples.enumerate() {
            let [x, y] = [
                f64::from(sample.x) * scale[0],
                f64::from(sample.y) * scale[1],
            ];
            (sample.x, sample.y) = (x as f32, y as f32);
            if let Some(Some(lens)) = undistorted.get(at % self.num_frames) {
                match lens.point(x, y) {
                    Some((x, y)) => (sample.x, sample.y) = (x as f32, y as f32),
                    None => sample.occlusion = HIDDEN,
                }
            }
            sample.x /= downscale as f32;
            sample.y /= downscale as f32;
        }
    }
}

/// The two places that tracks may be in: a folder of N² files, or the same arrays in one archive.
pub(crate) struct TrackFiles {
    pub(crate) folder: PathBuf,
    archive: PathBuf,
}

impl TrackFiles {
    pub(crate) fn new(preprocessed: &Path) -> Self {
        Self::in_folder(preprocessed.join("2d_tracks"))
    }

    /// In this folder, or in an archive of its name beside it.
    pub(crate) fn in_folder(folder: PathBuf) -> Self {
        let mut archive = folder.clone().into_os_string();
        archive.push(".npz");
        Self {
            folder,
            archive: archive.into(),
        }
    }

    /// Reads `{query}_{target}.npy` for every ordered pair of `stems`, from the folder or, where that
    /// has none, from the archive, in pixels of the files' own pictures. None when there are no files,
    /// or no tracks in them.
    pub(crate) fn read(&self, stems: &[String]) -> Result<Option<Tracks>, IoError> {
        let in_folder = list(&self.folder, &["npy"])?.files;
        if !in_folder.is_empty() {
            let load = |name: &str| match in_folder.get(name) {
                Some(path) => Ok(Some((read_npy(path)?, path.clone(), name.to_string()))),
                None => Ok(None),
            };
            return collect(stems, &self.folder, load);
        }
        if !self.archive.is_file() {
            return Ok(None);
        }
        let mut arrays: BTreeMap<String, Array> = read_npz(&self.archive)?;
        if arrays.is_empty() {
            return Ok(None);
        }
        let load = |name: &str| {
            let found = arrays.remove(name);
            Ok(found.map(|array| (array, self.archive.clone(), format!("entry {name}"))))
        };
        collect(stems, &self.archive, load)
    }
}

/// An array, the file it is from, and its name for messages.
type Loaded = (Array, PathBuf, String);

fn collect(
    stems: &[String],
    place: &Path,
    mut load: impl FnMut(&str) -> Result<Option<Loaded>, IoError>,
) -> Result<Option<Tracks>, IoError> {
    let num_frames = stems.len();
    let (mut queries, mut missing) = (Vec::new(), Vec::new());
    for (frame, query) in stems.iter().enumerate() {
        let mut targets: Vec<Array> = Vec::new();
        for target in stems {
            let name = format!("{query}_{target}");
            let Some((array, path, what)) = load(&name)? else {
                missing.push(format!("{name}.npy"));
                continue;
            };
            check(&array, targets.first(), &path, &what)?;
            targets.push(array);
        }
        if !missing.is_empty() {
            continue;
        }
        let num_points = targets.first().map_or(0, |a| a.values.len() / 4);
        let mut samples = Vec::with_capacity(num_points * num_frames);
        for point in 0..num_points {
            samples.extend(targets.iter().map(|array| {
                let row = &array.values[4 * point..4 * point + 4];
                // The format has pixel i at coordinate i.
                TrackSample {
                    x: row[0] + 0.5,
                    y: row[1] + 0.5,
                    occlusion: row[2],
                    expected_distance: row[3],
                }
            }));
        }
        queries.push(QueryTracks { frame, samples });
    }
    if !missing.is_empty() {
        return Err(IoError::missing(
            place,
            format!("tracks {}", list_names(&missing)),
            "one file {query}_{target}.npy is needed for each pair of training frames",
        ));
    }
    let tracks = Tracks {
        num_frames,
        queries,
    };
    Ok((tracks.num_tracks() > 0).then_some(tracks))
}

fn check(array: &Array, first: Option<&Array>, path: &Path, what: &str) -> Result<(), IoError> {
    let shape = &array.shape;
    if !array.values.is_empty() && (shape.len() != 2 || shape[1] != 4) {
        return Err(IoError::malformed(
            path,
            format!("{what} has shape {shape:?}; [P, 4] is expected (x, y, occlusion, distance)"),
        ));
    }
    if let Some(first) = first.filter(|f| f.values.len() != array.values.len()) {
        return Err(IoError::malformed(
            path,
            format!(
                "{what} has {} tracks, the same query's first target has {}",
                array.values.len() / 4,
                first.values.len() / 4
            ),
        ));
    }
    let bad = array.values.chunks_exact(4).position(|row| {
        !row[0].is_finite() || !row[1].is_finite() || row[2].is_nan() || row[3].is_nan()
    });
    match bad {
        Some(row) => Err(IoError::not_a_number(
            path,
            format!("{what}, row {row},"),
            "make the tracks again; a point that is not seen needs a place too, and a high third value (occlusion)",
        )),
        None => Ok(()),
    }
}
