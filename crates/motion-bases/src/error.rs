//! What can be wrong with the input.

/// Why motion bases could not be made.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MotionError {
    /// There is no track, or no frame.
    #[error("no tracks to start motion bases from: {num_tracks} tracks over {num_frames} frames")]
    NoTracks {
        /// Number of tracks.
        num_tracks: usize,
        /// Number of frames.
        num_frames: usize,
    },
    /// No track is visible in any frame.
    #[error(
        "none of the {num_tracks} tracks is visible in any frame: check masks and depth where the tracks lie"
    )]
    NoVisibleTrack {
        /// Number of tracks.
        num_tracks: usize,
    },
    /// An array has the wrong length.
    #[error("{what} holds {found} entries, {expected} were expected")]
    Length {
        /// Name of the array.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that the other arrays ask for.
        expected: usize,
    },
    /// A number of a track is NaN or infinite.
    #[error("{what} of track {track} in frame {frame} is not a finite number")]
    NotFinite {
        /// Name of the array.
        what: &'static str,
        /// Row of the track.
        track: usize,
        /// Frame.
        frame: usize,
    },
    /// A confidence is negative.
    #[error("confidence of track {track} in frame {frame} is negative: it must lie in [0, 1]")]
    NegativeConfidence {
        /// Row of the track.
        track: usize,
        /// Frame.
        frame: usize,
    },
    /// A camera's pose or intrinsics are not finite, or a focal length is not positive.
    #[error(
        "camera of frame {frame} has a number that is not finite, or a focal length that is not positive"
    )]
    BadCamera {
        /// Frame.
        frame: usize,
    },
    /// No basis was asked for.
    #[error("the number of motion bases is zero: ask for at least one, or leave motion out")]
    NoBases,
}
