//! What is timed: scenes and trainers of a given size, the same in every run.

use glam::{DAffine3, DVec3};
use io::{Frame, Image, Scene, SparsePoint, View};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use splat_core::{Camera, Gaussians};
use trainer::settings::BlurKind;
use trainer::{Device, Settings, TrainError, Trainer};

/// Training frames of a workload.
pub const FRAMES: usize = 24;

/// From [`Workload::first_full_iteration`] on so many iterations do the same work; behind them the camera has its trial.
pub const ALIKE: usize = 50;

/// Renders that a frame of [`Blur::Camera`] is averaged from.
pub const SAMPLES: usize = 8;

/// What of the blur model an iteration carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blur {
    /// Nothing.
    Off,
    /// All of it.
    Trained,
    /// All of it, but the scene feature extractor does not learn.
    Frozen,
    /// All of it, features and kernels at half resolution.
    Half,
    /// The camera in the place of kernels, [`SAMPLES`] samples a frame.
    Camera,
}

impl Blur {
    /// In the order of the tables.
    pub const ALL: [Self; 5] = [
        Self::Off,
        Self::Trained,
        Self::Frozen,
        Self::Half,
        Self::Camera,
    ];

    /// As it is called in tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Off => "blur off",
            Self::Trained => "blur on, extractor trained",
            Self::Frozen => "blur on, extractor frozen",
            Self::Half => "blur on, half resolution",
            Self::Camera => "blur by the camera, 8 samples",
        }
    }
}

/// Size of an iteration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Workload {
    /// Width of the pictures, px.
    pub width: usize,
    /// Height of the pictures, px.
    pub height: usize,
    /// Number of Gaussians, SH of degree 3.
    pub gaussians: usize,
    /// The blur model.
    pub blur: Blur,
    /// Side K of the blur kernels, px.
    pub kernel_size: usize,
}

impl Workload {
    /// A pinhole camera with a focal length of 30/36 of the width.
    #[must_use]
    pub fn camera(&self) -> Camera {
        let (w, h) = (self.width as f64, self.height as f64);
        let focal = w * 30.0 / 36.0;
        Camera::pinhole(
            [self.width, self.height],
            [focal, focal],
            [w / 2.0, h / 2.0],
        )
    }

    /// Random Gaussians in front of the camera: z uniform in [2, 8]; x and y uniform over 1.1 times the view at that
    /// depth; a size of 1.3 px times exp(0.4 n), per axis times exp(0.3 n); random rotations; opacity sigmoid(2 n);
    /// n standard normal.
    #[must_use]
    pub fn gaussians(&self) -> Gaussians {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let focal = self.camera().fx;
        let mut g = Gaussians {
            sh_degree: 3,
            ..Gaussians::default()
        };
        for _ in 0..self.gaussians {
            let z = 2.0 + 6.0 * uniform(&mut rng);
            let x = (uniform(&mut rng) - 0.5) * 1.1 * self.width as f64 * z / focal;
            let y = (uniform(&mut rng) - 0.5) * 1.1 * self.height as f64 * z / focal;
            let size = 1.3 * z / focal * (0.4 * normal(&mut rng)).exp();
            g.means.push([x, y, z].map(|v| v as f32));
            g.log_scales.push(std::array::from_fn(|_| {
                (size.ln() + 0.3 * normal(&mut rng)) as f32
            }));
            g.quats
                .push(std::array::from_fn(|_| normal(&mut rng) as f32));
            g.opacity_logits.push(2.0 * normal(&mut rng) as f32);
            g.sh.extend(
                (0..48).map(|k| (normal(&mut rng) * if k < 3 { 0.5 } else { 0.05 }) as f32),
            );
        }
        g
    }

    /// Pictures of noise from one place.
    fn scene(&self) -> Scene {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let pixels: Vec<f32> = (0..self.width * self.height * 3)
            .map(|_| uniform(&mut rng) as f32)
            .collect();
        let frame = |index: usize| Frame {
            view: View {
                name: format!("noise {index}"),
                camera: self.camera(),
                cam_from_world: DAffine3::IDENTITY,
                time: index as f32,
                image: Image {
                    width: self.width,
                    height: self.height,
                    pixels: pixels.clone(),
                },
            },
            depth: None,
            mask: None,
        };
        Scene {
            root: std::env::temp_dir(),
            name: "noise".to_owned(),
            layout: "made here",
            downscale: 1,
            frames: (0..FRAMES).map(frame).collect(),
            test: Vec::new(),
            points: vec![SparsePoint {
                position: DVec3::Z * 5.0,
                color: [0.5; 3],
            }],
            tracks: None,
            undistorted: Vec::new(),
            truth_folders: io::TruthFolders::default(),
            notes: Vec::new(),
        }
    }

    /// A trainer on pictures of noise, before its first iteration: all SH degrees from that on, no density control, the
    /// blur model as early as the schedule allows and without a hold, so that from iteration
    /// [`Self::first_full_iteration`] on [`ALIKE`] do the same work.
    ///
    /// # Errors
    /// The trainer refuses the sizes.
    pub fn trainer(&self, device: &Device) -> Result<Trainer, TrainError> {
        let mut settings = Settings {
            iterations: 200,
            ..Settings::default()
        };
        settings.gaussians.sh_degree_every = 1;
        settings.gaussians.control_from = 40_000;
        settings.blur.model = match self.blur {
            Blur::Off => BlurKind::Off,
            Blur::Camera => BlurKind::Camera,
            Blur::Trained | Blur::Frozen | Blur::Half => BlurKind::Kernels,
        };
        settings.blur.kernel_size = self.kernel_size;
        settings.blur.hold = 0;
        settings.blur.downscale = if self.blur == Blur::Half { 2 } else { 1 };
        settings.blur.train_extractor = self.blur != Blur::Frozen;
        if self.blur == Blur::Camera {
            settings.camera.samples = SAMPLES;
            // Far more than are allowed, for a path of two pixels.
            settings.camera.spacing_px = 0.05;
            settings.learning_rates.camera_path = 0.0;
        }
        let mut trainer = Trainer::new(self.scene(), settings, device)?;
        trainer.start_from(&self.gaussians())?;
        Ok(trainer)
    }

    /// The trainer on a device right before [`Self::first_full_iteration`]. What comes before that is done on the CPU: a device
    /// that a CPU plays would take an hour.
    ///
    /// # Errors
    /// The trainer refuses the sizes, or the checkpoint between the two cannot be written.
    pub fn trainer_at_work(&self, device: &Device) -> Result<Trainer, TrainError> {
        let mut trainer = self.trainer(&Device::flex())?;
        while trainer.iteration() + 1 < self.first_full_iteration() {
            trainer.step()?;
        }
        on_device(&trainer, self.scene(), device)
    }

    /// From here on (1-based) [`ALIKE`] iterations do the same work: blur begins after 50, L_spa 50 later, and the camera's trial
    /// comes after 150.
    #[must_use]
    pub fn first_full_iteration(&self) -> usize {
        if self.blur == Blur::Off { 4 } else { 101 }
    }
}

/// A trainer as it is, on another device.
///
/// # Errors
/// The checkpoint between the two cannot be written or read.
pub fn on_device(trainer: &Trainer, scene: Scene, device: &Device) -> Result<Trainer, TrainError> {
    let name = format!("limpid-bench-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    trainer.save(&folder)?;
    let moved = Trainer::load(&folder, scene, device);
    // A folder that stays behind does no harm.
    drop(std::fs::remove_dir_all(&folder));
    moved
}

fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (f64::from(rng.next_u32()) + 0.5) / (f64::from(u32::MAX) + 1.0)
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (-2.0 * uniform(rng).ln()).sqrt() * (std::f64::consts::TAU * uniform(rng)).cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_begins_or_is_tried_among_iterations_that_do_the_same_work() {
        for blur in Blur::ALL {
            let workload = Workload {
                width: 32,
                height: 24,
                gaussians: 10,
                blur,
                kernel_size: 3,
            };
            let trainer = workload.trainer(&Device::flex()).expect("a small trainer");
            let schedule = trainer.schedule();
            let alike = workload.first_full_iteration()..workload.first_full_iteration() + ALIKE;
            let (first, last) = (alike.start, alike.end - 1);
            assert!(last <= schedule.iterations, "{}: {last}", blur.name());
            // What comes after an iteration shows in the next one.
            let moments = schedule.blur_moments.iter().copied();
            let begun: Vec<_> = moments.filter(|m| (first..last).contains(m)).collect();
            assert!(begun.is_empty(), "{}: after {begun:?}", blur.name());
            let of = |it: usize| {
                let sums = schedule.gathers_density(it);
                let edits = schedule.controls_density(it) || schedule.resets_opacity(it);
                (
                    schedule.sh_degree_at(it),
                    sums,
                    edits,
                    schedule.is_unseen(it),
                )
            };
            let expected = (3, schedule.gathers_density(first), false, false);
            for it in alike {
                assert_eq!(of(it), expected, "{}, {it}", blur.name());
            }
        }
    }
}
