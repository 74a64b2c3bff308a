use thiserror::Error;

/// Why a view could not be warped. Nothing is ever warped half-way.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum WarpError {
    /// A buffer's length does not fit the source camera's size.
    #[error(
        "{what} has {got} values, but the source camera of {width}x{height} pixels needs {expected}"
    )]
    Length {
        /// Which buffer.
        what: &'static str,
        /// Values that the camera's size asks for.
        expected: usize,
        /// Values that were given.
        got: usize,
        /// Width of the source camera, in pixels.
        width: usize,
        /// Height of the source camera, in pixels.
        height: usize,
    },
    /// A pixel holds a value that cannot be warped.
    #[error("{what} at pixel ({x}, {y}) is {value}; it must be {must}")]
    Value {
        /// Which buffer.
        what: &'static str,
        /// Column of the pixel.
        x: usize,
        /// Row of the pixel.
        y: usize,
        /// The value found.
        value: f32,
        /// What is asked of it.
        must: &'static str,
    },
    /// A camera's pose holds a number that is not finite, or has no inverse.
    #[error(
        "the {which} camera's pose is no rigid transform: a number is not finite, or it has no inverse"
    )]
    Pose {
        /// `source` or `target`.
        which: &'static str,
    },
    /// A camera cannot project.
    #[error("the {which} camera's {what}")]
    Camera {
        /// `source` or `target`.
        which: &'static str,
        /// What is wrong with it.
        what: &'static str,
    },
    /// A setting is out of its range.
    #[error("the option {name} is {value}; it must be {must}")]
    Option {
        /// Name of the field of [`WarpOptions`](crate::WarpOptions).
        name: &'static str,
        /// The value found.
        value: f64,
        /// What is asked of it.
        must: &'static str,
    },
}
