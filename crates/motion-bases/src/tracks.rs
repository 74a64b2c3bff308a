//! 3D tracks: what the start of the motion is made from.

use crate::MotionError;
use crate::statistics::median_point;
use glam::DVec3;

/// Points of the moving scene, followed over all frames; P tracks over N frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tracks3d {
    /// Number of frames N.
    pub num_frames: usize,
    /// Positions in the world (scene units), [P * N], one track after the other. Finite everywhere.
    /// Where a track is not visible, only the direction from the camera is meaningful, and that
    /// only if the confidence is positive.
    pub positions: Vec<DVec3>,
    /// Whether the point is seen, [P * N].
    pub visible: Vec<bool>,
    /// Confidence in [0, 1], [P * N]. Positive where `visible` is false means: known to be hidden
    /// behind something at this pixel.
    pub confidence: Vec<f32>,
    /// Colours in [0, 1], `[P]`.
    pub colors: Vec<[f32; 3]>,
}

impl Tracks3d {
    /// Number of tracks P.
    #[must_use]
    pub fn len(&self) -> usize {
        self.colors.len()
    }

    /// Whether there is no track.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.colors.is_empty()
    }

    /// Row of track `track` in frame `frame` in the arrays of [P * N].
    #[must_use]
    pub fn index(&self, track: usize, frame: usize) -> usize {
        track * self.num_frames + frame
    }

    /// Checks lengths and numbers.
    pub(crate) fn check(&self) -> Result<(), MotionError> {
        let (num_tracks, num_frames) = (self.len(), self.num_frames);
        if num_tracks == 0 || num_frames == 0 {
            return Err(MotionError::NoTracks {
                num_tracks,
                num_frames,
            });
        }
        let expected = num_tracks.saturating_mul(num_frames);
        for (what, found) in [
            ("positions", self.positions.len()),
            ("visible", self.visible.len()),
            ("confidence", self.confidence.len()),
        ] {
            if found != expected {
                return Err(MotionError::Length {
                    what,
                    found,
                    expected,
                });
            }
        }
        for i in 0..expected {
            let (track, frame) = (i / num_frames, i % num_frames);
            let not_finite = |what| MotionError::NotFinite { what, track, frame };
            if !self.positions[i].is_finite() {
                return Err(not_finite("position"));
            }
            if !self.confidence[i].is_finite() {
                return Err(not_finite("confidence"));
            }
            if self.confidence[i] < 0.0 {
                return Err(MotionError::NegativeConfidence { track, frame });
            }
        }
        Ok(())
    }

    /// The frame in which most tracks are visible, the first of them.
    pub(crate) fn canonical_frame(&self) -> usize {
        let mut counts = vec![0_usize; self.num_frames];
        for track in self.visible.chunks_exact(self.num_frames) {
            for (count, &seen) in counts.iter_mut().zip(track) {
                *count += usize::from(seen);
            }
        }
        (0..counts.len()).fold(0, |best, t| if counts[t] > counts[best] { t } else { best })
    }

    /// The given tracks alone.
    pub(crate) fn subset(&self, rows: &[usize]) -> Self {
        fn pick<T: Copy>(values: &[T], rows: &[usize], n: usize) -> Vec<T> {
            rows.iter()
                .flat_map(|&row| values[row * n..(row + 1) * n].iter().copied())
                .collect()
        }
        let n = self.num_frames;
        Self {
            num_frames: n,
            positions: pick(&self.positions, rows, n),
            visible: pick(&self.visible, rows, n),
            confidence: pick(&self.confidence, rows, n),
            colors: pick(&self.colors, rows, 1),
        }
    }

    /// Replaces the positions of invisible entries: linear in time between visible ones, constant
    /// before the first and after the last. Tracks that are never visible stay as they are.
    pub(crate) fn fill_gaps(&mut self) {
        let n = self.num_frames;
        for (positions, visible) in self
            .positions
            .chunks_exact_mut(n)
            .zip(self.visible.chunks_exact(n))
        {
            let mut previous: Option<usize> = None;
            for t in (0..n).filter(|&t| visible[t]) {
                let (start, end) = (positions[previous.unwrap_or(t)], positions[t]);
                let from = previous.map_or(0, |p| p + 1);
                for gap in from..t {
                    let part = previous.map_or(1.0, |p| (gap - p) as f64 / (t - p) as f64);
                    positions[gap] = start.lerp(end, part);
                }
                previous = Some(t);
            }
            if let Some(last) = previous {
                let end = positions[last];
                positions[last + 1..].fill(end);
            }
        }
    }

    /// Rows without the tracks that lie farthest from the middle in `frame` (5 % of them, rounded
    /// down; equal distances stay), and without those that are never visible.
    pub(crate) fn rows_without_outliers(&self, frame: usize) -> Vec<usize> {
        let n = self.num_frames;
        let seen: Vec<usize> = (0..self.len())
            .filter(|&row| self.visible[row * n..(row + 1) * n].contains(&true))
            .collect();
        let at = |row: usize| self.positions[self.index(row, frame)];
        let center = median_point(seen.iter().map(|&row| at(row)));
        let distances: Vec<f64> = seen.iter().map(|&row| at(row).distance(center)).collect();
        let mut sorted = distances.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let limit = sorted
            .len()
            .checked_sub(1 + sorted.len() / 20)
            .map_or(f64::INFINITY, |rank| sorted[rank]);
        seen.into_iter()
            .zip(distances)
            .filter(|&(_, distance)| distance <= limit)
            .map(|(row, _)| row)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(visible: &[bool], x: &[f64]) -> Tracks3d {
        Tracks3d {
            num_frames: x.len(),
            positions: x.iter().map(|&x| DVec3::new(x, 2.0 * x, 1.0)).collect(),
            visible: visible.to_vec(),
            confidence: vec![1.0; x.len()],
            colors: vec![[0.5; 3]],
        }
    }

    #[test]
    fn gaps_are_linear_inside_and_constant_outside() {
        let mut tracks = line(
            &[false, true, false, false, true, false],
            &[77.0, 1.0, 88.0, 99.0, 4.0, 66.0],
        );
        tracks.fill_gaps();
        let x: Vec<f64> = tracks.positions.iter().map(|p| p.x).collect();
        assert_eq!(x, [1.0, 1.0, 2.0, 3.0, 4.0, 4.0]);
    }

    #[test]
    fn the_canonical_frame_is_the_first_with_most_visible_tracks() {
        let mut tracks = line(&[false, true, true, false], &[0.0; 4]);
        assert_eq!(tracks.canonical_frame(), 1);
        tracks.visible = vec![false; 4];
        assert_eq!(tracks.canonical_frame(), 0);
    }

    #[test]
    fn outliers_go_and_coincident_points_stay() {
        let tracks = |points: &[f64], hidden: usize| Tracks3d {
            num_frames: 1,
            positions: points.iter().map(|&x| DVec3::splat(x)).collect(),
            visible: (0..points.len()).map(|row| row != hidden).collect(),
            confidence: vec![1.0; points.len()],
            colors: vec![[0.0; 3]; points.len()],
        };
        let mut points: Vec<f64> = (0..40).map(f64::from).collect();
        points[7] = 1e3;
        points[9] = -1e3;
        let kept = tracks(&points, 11).rows_without_outliers(0);
        assert_eq!(
            kept.len(),
            38,
            "of 39 seen tracks 5 % are one, and -1e3 is the farther by far: {kept:?}"
        );
        assert!(!kept.contains(&11), "a track that is never seen stays out");
        assert_eq!(tracks(&[3.0; 50], 50).rows_without_outliers(0).len(), 50);
        assert_eq!(tracks(&[1.0], 5).rows_without_outliers(0), [0]);
        assert_eq!(
            tracks(&[1.0, 9.0, 5.0], 5).rows_without_outliers(0).len(),
            3
        );
        assert!(tracks(&[1.0], 0).rows_without_outliers(0).is_empty());
    }

    #[test]
    fn bad_numbers_are_named() {
        let mut tracks = line(&[true; 4], &[0.0; 4]);
        tracks.positions[2].y = f64::NAN;
        let error = tracks.check().expect_err("a NaN");
        assert_eq!(
            error.to_string(),
            "position of track 0 in frame 2 is not a finite number"
        );
        let mut tracks = line(&[true; 4], &[0.0; 4]);
        tracks.confidence[3] = f32::INFINITY;
        assert!(
            tracks
                .check()
                .expect_err("infinite")
                .to_string()
                .contains("confidence of track 0 in frame 3")
        );
        let mut tracks = line(&[true; 4], &[0.0; 4]);
        tracks.visible.pop();
        assert_eq!(
            tracks.check(),
            Err(MotionError::Length {
                what: "visible",
                found: 3,
                expected: 4
            })
        );
        assert!(matches!(
            Tracks3d::default().check(),
            Err(MotionError::NoTracks { .. })
        ));
    }
}
