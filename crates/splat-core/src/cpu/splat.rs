//! Gaussians as projection leaves them.

/// A visible Gaussian as the rasteriser sees it, kept small: tiles load it from all over memory.
#[derive(Clone, Copy, Debug)]
pub(super) struct Splat<T> {
    /// Mean in pixels.
    pub(super) mean: [T; 2],
    /// sigma = (l11 dx + l21 dy)² + (l22 dy)².
    pub(super) l11: T,
    pub(super) l21: T,
    pub(super) l22: T,
    pub(super) opacity: T,
    /// max(SH + 0.5, 0), and z-depth.
    pub(super) channels: [T; 4],
    /// Columns and rows of pixels [from, to) that its bounding box meets.
    pub(super) columns: [u16; 2],
    pub(super) rows: [u16; 2],
    /// Row in the inputs.
    pub(super) row: u32,
}

/// How far a visible Gaussian reaches in the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent<T> {
    /// Where sigma is larger, alpha is under the threshold.
    pub(super) sigma_max: T,
    /// Half the size of the bounding box of that ellipse, px, a little enlarged.
    pub(super) half: [T; 2],
    /// Three standard deviations along the longer axis, px.
    pub(super) radius: f32,
}
