//! The tables of a view, read back.

use burn_cubecl::tensor::CubeTensor;

use super::tables::{Tables, read};
use crate::cube::splat::{COLOR, DEPTH, OPACITY, SPLAT};
use crate::error::SplatError;
use crate::stages::{InImage, Stages};

impl Tables {
    /// Every Gaussian in the image, and the tiles' lists, of a scene of one sample.
    pub(crate) fn stages(&self) -> Result<Stages, SplatError> {
        let floats = |table: &CubeTensor| -> Result<Vec<f64>, SplatError> {
            let words = read(table)?;
            let float = |word: u32| f64::from(f32::from_bits(word));
            Ok(words.into_iter().map(float).collect())
        };
        let projected = floats(&self.splats)?
            .chunks_exact(SPLAT)
            .map(|splat| {
                (splat[OPACITY] > 0.0).then(|| InImage {
                    mean: [splat[0], splat[1]],
                    falloff: [splat[2], splat[3], splat[4]],
                    opacity: splat[OPACITY],
                    depth: splat[DEPTH],
                    color: [splat[COLOR], splat[COLOR + 1], splat[COLOR + 2]],
                })
            })
            .collect();
        let list = read(&self.list)?;
        let mut tile_starts = vec![0];
        let mut listed = Vec::with_capacity(self.num_slots);
        for range in read(&self.ranges)?.as_chunks::<2>().0 {
            let [from, to] = range.map(|end| end as usize);
            listed.extend_from_slice(&list[from..to]);
            tile_starts.push(listed.len());
        }
        Ok(Stages {
            projected,
            tiles: self.scene.camera.tiles(),
            tile_starts,
            listed,
        })
    }
}
