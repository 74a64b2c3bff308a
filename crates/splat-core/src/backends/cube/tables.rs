//! What a GPU keeps of a scene and a view of it.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::Client;
use host::cube::empty;
use host::{said, waiting};

use crate::camera::{Camera, CameraModel};
use crate::cpu::{GEOMETRIC, tangents};
use crate::cube::geometry::LensLaunch;
use crate::cube::project_backward::V_SHAPE;
use crate::cube::raster_backward::pixel_width;
use crate::error::SplatError;

/// Gaussians as the kernels read them.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    pub(super) camera: Camera,
    pub(super) sh_degree: usize,
    /// Coefficients a channel.
    pub(super) stored: usize,
    /// Numbers of Gaussians, of those that move, and of samples.
    pub(super) rows: usize,
    pub(super) moving: usize,
    pub(super) samples: usize,
    /// [N, 11] and [N, B, 3].
    pub(super) shapes: CubeTensor,
    pub(super) sh: CubeTensor,
    /// [n, moving, 12].
    pub(super) moved: CubeTensor,
    /// [3, 4] for the colours, and [n, 3, 4].
    pub(super) pose: CubeTensor,
    pub(super) poses: CubeTensor,
}

impl Scene {
    pub(super) fn client(&self) -> &Client {
        &self.shapes.client
    }

    /// Gaussians in all samples.
    pub(super) fn items(&self) -> usize {
        self.rows * self.samples
    }

    /// Tiles of all samples.
    pub(super) fn tiles(&self) -> usize {
        let [across, down] = self.camera.tiles();
        self.samples * across * down
    }

    pub(super) fn lens(&self) -> LensLaunch {
        let c = &self.camera;
        let CameraModel::Pinhole = c.model;
        let [min, max] = tangents(c);
        LensLaunch::new(
            c.fx as f32,
            c.fy as f32,
            c.cx as f32,
            c.cy as f32,
            c.near as f32,
            min[0] as f32,
            min[1] as f32,
            max[0] as f32,
            max[1] as f32,
            c.width as u32,
            c.height as u32,
        )
    }

    /// A table beside the scene's, if the device has room for it.
    pub(super) fn table(
        &self,
        name: &'static str,
        length: usize,
        dtype: DType,
    ) -> Result<CubeTensor, SplatError> {
        fits(self.client(), name, length)?;
        Ok(empty(&self.shapes, [length.max(1)], dtype))
    }
}

impl Tables {
    /// An error if what the way back makes, with so many channels beside alpha, does not go into the device's buffers: it is known
    /// by now, and there no error can be returned.
    pub(super) fn have_room_for_gradients(&self, channels: usize) -> Result<(), SplatError> {
        let (client, width) = (self.scene.client(), GEOMETRIC + channels);
        let pixels = self.scene.samples * self.scene.camera.num_pixels();
        fits(
            client,
            "gradients of the tiles' lists",
            self.num_slots * width,
        )?;
        fits(
            client,
            "gradients of the pixels",
            pixels * pixel_width(channels),
        )?;
        fits(
            client,
            "gradients of the projected Gaussians",
            self.scene.items() * (width + 1) + 1,
        )?;
        fits(
            client,
            "gradients of the Gaussians",
            self.scene.rows * V_SHAPE,
        )
    }
}

/// As many bytes as kernels tell apart, whose places are numbers of 32 bits: larger buffers there are, on large cards.
pub const LARGEST_TABLE: u64 = 4 * (u32::MAX as u64);

/// An error if so many numbers do not go into a buffer.
pub(super) fn fits(client: &Client, table: &'static str, length: usize) -> Result<(), SplatError> {
    let bytes = 4 * length as u64;
    let limit = client.properties().memory.max_page_size.min(LARGEST_TABLE);
    if bytes > limit {
        return Err(SplatError::TooLarge {
            table,
            bytes,
            limit,
        });
    }
    Ok(())
}

/// The numbers of a table of u32. The device is waited for.
pub(super) fn read(table: &CubeTensor) -> Result<Vec<u32>, SplatError> {
    let _span = waiting();
    let bytes = table.client.read_one(table.handle.clone());
    let bytes = bytes.map_err(|error| SplatError::Device {
        reason: said(error),
    })?;
    let words = bytes.as_chunks::<4>().0.iter();
    Ok(words.map(|word| u32::from_le_bytes(*word)).collect())
}

/// A view that is projected, sorted and listed by tile.
#[derive(Clone, Debug)]
pub(crate) struct Tables {
    pub(super) scene: Scene,
    /// [items, 14].
    pub(super) splats: CubeTensor,
    /// Slots of every item, [items, 2].
    pub(super) lists: CubeTensor,
    /// Slots of every tile, [tiles, 2], in the order of `list` and `slots`.
    pub(super) ranges: CubeTensor,
    /// Items in the tiles' order, and where their partial gradients lie.
    pub(super) list: CubeTensor,
    pub(super) slots: CubeTensor,
    pub(super) num_slots: usize,
    /// Whether the features were looked at.
    pub(super) features_checked: bool,
    /// `[N]`.
    pub(super) radii: CubeTensor,
}
