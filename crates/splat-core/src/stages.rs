//! What lies between the inputs of a render and its pixels, in main memory.

/// A Gaussian as it is seen in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InImage {
    /// Mean, px.
    pub mean: [f64; 2],
    /// l11, l21, l22: alpha is opacity exp(-sigma), sigma = (l11 dx + l21 dy)² + (l22 dy)² at an offset from the mean in px.
    pub falloff: [f64; 3],
    /// In (0, 1).
    pub opacity: f64,
    /// Along the camera's z, scene units.
    pub depth: f64,
    /// Not below 0.
    pub color: [f64; 3],
}

/// What a view's projection and its tiles' lists came to: to hold one backend against another, or to look at.
#[derive(Clone, Debug, PartialEq)]
pub struct Stages {
    /// Every Gaussian, by row; `None` for those that cannot be seen.
    pub projected: Vec<Option<InImage>>,
    /// Number of tiles along x and y, each of [`TILE`](crate::cpu::TILE) px; they are counted row by row.
    pub tiles: [usize; 2],
    /// Where the list of each tile begins in `listed`, and at last its length.
    pub tile_starts: Vec<usize>,
    /// Rows of Gaussians, tile by tile, in each the nearest first.
    pub listed: Vec<u32>,
}

impl Stages {
    /// Those of a view without a Gaussian.
    #[cfg(feature = "cube")]
    pub(crate) fn blank(camera: &crate::Camera) -> Self {
        let tiles = camera.tiles();
        Self {
            projected: Vec::new(),
            tiles,
            tile_starts: vec![0; tiles[0] * tiles[1] + 1],
            listed: Vec::new(),
        }
    }

    /// The rows that a tile's pixels look at, nearest first.
    ///
    /// # Panics
    /// If there is no such tile.
    #[must_use]
    pub fn tile(&self, tile: usize) -> &[u32] {
        &self.listed[self.tile_starts[tile]..self.tile_starts[tile + 1]]
    }
}
