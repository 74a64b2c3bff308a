//! What a run takes of main memory at its peak, about: fitted to what runs took on the CPU, and held against it by `tests/tests/main_memory.rs`.

use crate::blur::BlurModel;
use crate::gpu::{Gpu, Table};
use crate::settings::BlurKind;
use crate::trainer::Trainer;

/// The program, its threads, and what does not grow with a scene.
const PROGRAM: u64 = 40 << 20;
/// Of a Gaussian: its 59 numbers, their gradients and moments, and what an iteration makes of each.
const GAUSSIAN: u64 = 2400;
/// The same for each render that a frame is averaged from.
const EXPOSED_GAUSSIAN: u64 = 100;
/// Of a pixel that is rendered and compared, and goes back.
const PIXEL: u64 = 300;
/// Of a pixel that BP-Net sees: its layers, and their gradients.
const NET_PIXEL: u64 = 1300;
/// The same for each of a kernel's K² weights.
const KERNEL_PIXEL: u64 = 12;

/// Bytes of main memory that a run takes at its peak, about, by what takes them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryNeed {
    /// The program itself.
    pub program: u64,
    /// Frames, test views, depth, masks and points.
    pub pictures: u64,
    /// The Gaussians, with their gradients and moments.
    pub gaussians: u64,
    /// A view on its way through renderer, blur model and losses.
    pub view: u64,
}

impl MemoryNeed {
    /// All of it.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.program + self.pictures + self.gaussians + self.view
    }
}

impl Trainer {
    /// The most Gaussians that there may be; where they have no limit, or are more than it from the start on, as many as there are now.
    #[must_use]
    pub fn most_gaussians(&self) -> usize {
        self.most_gaussians_at(1.0)
    }

    /// The same with pictures that have this share of the pixels.
    fn most_gaussians_at(&self, share: f64) -> usize {
        let part = |count: usize| (share * count as f64) as usize;
        let now = part(self.run.model().num_gaussians());
        match self.run.plan.settings.gaussians.most(part(self.pixels())) {
            usize::MAX => now,
            most => most.max(now),
        }
    }

    fn pixels(&self) -> usize {
        self.run.plan.views.train[0].camera.num_pixels()
    }

    /// Whether there is a most of Gaussians (`gaussians.max_per_pixel`).
    #[must_use]
    pub fn limits_gaussians(&self) -> bool {
        self.run.plan.max_gaussians() < usize::MAX
    }

    /// The largest table that training makes on a GPU with pictures that have this share of the pixels, about; see
    /// [`Gpu::largest_table`].
    #[must_use]
    pub fn largest_table_at(&self, share: f64) -> Table {
        let plan = &self.run.plan;
        let mut settings = plan.settings.clone();
        if matches!(self.run.model().blur, BlurModel::Off) {
            settings.blur.model = BlurKind::Off;
        }
        let pixels = (share * self.pixels() as f64) as usize;
        Gpu::largest_table(&settings, self.most_gaussians_at(share), pixels)
    }

    /// What training takes of main memory at its peak, with as many Gaussians as there may be, if pictures have this share of the
    /// pixels; see [`Trainer::memory_need`].
    #[must_use]
    pub fn memory_need_at(&self, share: f64) -> MemoryNeed {
        let need = self.memory_need(self.most_gaussians_at(share));
        let part = |bytes: u64| (share * bytes as f64) as u64;
        MemoryNeed {
            pictures: part(need.pictures),
            view: part(need.view),
            ..need
        }
    }

    /// What training takes of main memory at its peak with so many Gaussians, within a factor of two; where tensors live on a GPU, it takes less here.
    #[must_use]
    pub fn memory_need(&self, gaussians: usize) -> MemoryNeed {
        let plan = &self.run.plan;
        let pixels = self.pixels() as u64;
        let floats = |values: usize| 4 * values as u64;
        let scene = &self.data.scene;
        let frames = scene.frames.iter().map(|frame| {
            let maps =
                [&frame.depth, &frame.mask].map(|map| map.as_ref().map_or(0, |m| m.values.len()));
            floats(frame.view.image.pixels.len() + maps[0] + maps[1])
        });
        let test = scene
            .test
            .iter()
            .map(|view| floats(view.image.pixels.len()));
        let points = self
            .data
            .points
            .iter()
            .flatten()
            .map(|map| floats(map.len()));
        let tracks = scene.tracks.iter().flat_map(|tracks| &tracks.queries);
        let tracks = tracks.map(|query| floats(4 * query.samples.len()));
        let blur = &plan.settings.blur;
        let renders = match self.run.model().blur {
            BlurModel::Off | BlurModel::Kernels(_) => 0,
            BlurModel::Camera(_) | BlurModel::Both(_) => plan.settings.camera.most_samples() as u64,
        };
        let kernels = match self.run.model().blur {
            BlurModel::Off | BlurModel::Camera(_) => 0,
            BlurModel::Kernels(_) | BlurModel::Both(_) => {
                let weights = (blur.kernel_size * blur.kernel_size) as u64;
                (NET_PIXEL + KERNEL_PIXEL * weights) / (blur.downscale * blur.downscale) as u64
            }
        };
        MemoryNeed {
            program: PROGRAM,
            pictures: frames.chain(test).chain(points).chain(tracks).sum(),
            gaussians: (GAUSSIAN + EXPOSED_GAUSSIAN * renders) * gaussians as u64,
            view: pixels * (PIXEL + kernels),
        }
    }
}
