//! Parts of an iteration by themselves, on a GPU: rendering, the rasteriser, an exposure.

use std::error::Error;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use burn::tensor::{DType, Device, Gradients, Tensor, TensorData};
use glam::DAffine3;
use serde::Serialize;
use splat_core::{Exposure, Extra, Splats, Transfer, Viewpoint, expose, pose_rows, render};
use trainer::with_causes;

use crate::workload::{SAMPLES, Workload};

type Failure = Box<dyn Error>;

/// Length of the path of an exposure, px; its samples stand in the middles of equal parts of it.
const PATH_PX: f64 = 3.0;

/// Times of something; the device has done all of it each time the clock is read.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Times {
    /// Median, ms.
    pub median_ms: f64,
    /// Fastest, ms.
    pub fastest_ms: f64,
    /// How often it was done.
    pub repeats: usize,
}

impl Times {
    /// Of at least one time, ms.
    #[must_use]
    pub fn of(mut times: Vec<f64>) -> Option<Self> {
        times.sort_by(f64::total_cmp);
        Some(Self {
            median_ms: *times.get(times.len() / 2)?,
            fastest_ms: *times.first()?,
            repeats: times.len(),
        })
    }
}

/// What came of timing something: its result, or why the device refused it.
#[derive(Clone, Debug, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome<T> {
    /// It was timed.
    Timed(T),
    /// The device, or what drives it, refused.
    Refused(String),
}

impl<T> Outcome<T> {
    /// The result, where there is one.
    pub fn timed(&self) -> Option<&T> {
        match self {
            Self::Timed(result) => Some(result),
            Self::Refused(_) => None,
        }
    }

    /// Does something that may fail, or panic as wgpu does where memory is short.
    pub fn of(piece: impl FnOnce() -> Result<T, Failure>) -> Self {
        match catch_unwind(AssertUnwindSafe(piece)) {
            Ok(Ok(result)) => Self::Timed(result),
            Ok(Err(error)) => Self::Refused(with_causes(error.as_ref())),
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
                Self::Refused(text.unwrap_or("a panic without a text").to_owned())
            }
        }
    }
}

/// Times something `repeats` times after two: the first compiles kernels, the second finds buffers. What comes out of the first
/// and the last is read: where memory was short, kernels were skipped, and only who reads is told.
fn time(
    device: &Device,
    repeats: usize,
    mut piece: impl FnMut() -> Result<Vec<Tensor<1>>, Failure>,
) -> Result<Times, Failure> {
    read(piece()?)?;
    piece()?;
    device.sync()?;
    let (mut times, mut last) = (Vec::with_capacity(repeats), Vec::new());
    for _ in 0..repeats {
        drop(last);
        device.sync()?;
        let start = Instant::now();
        last = piece()?;
        device.sync()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    read(last)?;
    Times::of(times).ok_or_else(|| "nothing was timed".into())
}

fn read(results: Vec<Tensor<1>>) -> Result<(), Failure> {
    for result in results {
        result.sum().try_into_data()?;
    }
    Ok(())
}

/// A render without a graph: colour, alpha and depth.
///
/// # Errors
/// The device refuses the size.
pub fn time_render(workload: &Workload, device: &Device, repeats: usize) -> Result<Times, Failure> {
    let splats = Splats::new(&workload.gaussians(), device)?;
    let view = viewpoint(workload, &splats);
    time(device, repeats, || {
        let rendered = render(splats.clone(), &view, Extra::default())?;
        Ok(vec![rendered.output().clone().flatten(0, 2)])
    })
}

/// A render that keeps what its way back needs, and, with `back`, that way to means, quaternions, scales, opacities and colours.
///
/// # Errors
/// The device refuses the size.
pub fn time_rasteriser(
    workload: &Workload,
    device: &Device,
    repeats: usize,
    back: bool,
) -> Result<Times, Failure> {
    let splats = leaves(workload, device)?;
    let view = viewpoint(workload, &splats);
    time(device, repeats, || {
        let rendered = render(splats.clone(), &view, Extra::default())?;
        let output = rendered.output().clone();
        if !back {
            return Ok(vec![output.inner().flatten(0, 2)]);
        }
        Ok(gradients(&splats, &output.sum().backward()))
    })
}

/// An exposure of [`SAMPLES`] samples along a path of 3 px, and its way back to the Gaussians and the path.
///
/// # Errors
/// The device refuses the size.
pub fn time_exposure(
    workload: &Workload,
    device: &Device,
    repeats: usize,
) -> Result<Times, Failure> {
    let splats = leaves(workload, device)?;
    let middle = viewpoint(workload, &splats);
    let focal = workload.camera().fx;
    let poses: Vec<f64> = poses(focal).iter().flat_map(pose_rows).collect();
    let poses = TensorData::new(poses, [SAMPLES, 3, 4]);
    let options = (&device.clone().autodiff(), DType::F32);
    let poses = Tensor::<3>::from_data(poses, options).require_grad();
    time(device, repeats, || {
        let exposure = Exposure {
            poses: poses.clone(),
            movers: None,
            transfer: Transfer::Srgb,
        };
        let exposed = expose(splats.clone(), &middle, exposure, None)?;
        let grads = exposed.color.sum().backward();
        let mut found = gradients(&splats, &grads);
        found.extend(poses.grad(&grads).map(|g| g.flatten(0, 2)));
        Ok(found)
    })
}

/// Poses of the samples of a path along x, as long at every depth: shears, which small turns of a camera nearly are.
fn poses(focal: f64) -> [DAffine3; SAMPLES] {
    std::array::from_fn(|i| {
        let mut pose = DAffine3::IDENTITY;
        let place = (i as f64 + 0.5) / SAMPLES as f64 - 0.5;
        pose.matrix3.z_axis.x = PATH_PX * place / focal;
        pose
    })
}

/// The Gaussians of a workload, all of their numbers tracked.
fn leaves(workload: &Workload, device: &Device) -> Result<Splats, Failure> {
    let splats = Splats::new(&workload.gaussians(), &device.clone().autodiff())?;
    Ok(Splats {
        means: splats.means.require_grad(),
        quats: splats.quats.require_grad(),
        left_rotations: None,
        log_scales: splats.log_scales.require_grad(),
        opacity_logits: splats.opacity_logits.require_grad(),
        sh: splats.sh.require_grad(),
    })
}

fn gradients(splats: &Splats, grads: &Gradients) -> Vec<Tensor<1>> {
    let leaves = [
        &splats.means,
        &splats.quats,
        &splats.log_scales,
        &splats.opacity_logits,
        &splats.sh,
    ];
    let found = leaves.into_iter().filter_map(|leaf| leaf.grad(grads));
    found.map(|gradient| gradient.flatten(0, 1)).collect()
}

fn viewpoint(workload: &Workload, splats: &Splats) -> Viewpoint {
    Viewpoint::new(&workload.camera(), &DAffine3::IDENTITY, 3, splats)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use splat_core::Camera;

    #[test]
    fn a_path_is_as_long_at_every_depth() {
        let camera = Camera::pinhole([64, 36], [50.0; 2], [32.0, 18.0]);
        for depth in [0.5, 2.0, 8.0] {
            let point = DVec3::new(-0.1, 0.2, 1.0) * depth;
            let seen = poses(camera.fx).map(|pose| camera.project(pose.transform_point3(point)));
            let steps = seen.windows(2).map(|pair| pair[1] - pair[0]);
            for step in steps {
                let off = step.x - PATH_PX / SAMPLES as f64;
                assert!(off.abs() < 1e-12 && step.y == 0.0, "{depth}: {step}");
            }
            let middle = 0.5 * (seen[0] + seen[SAMPLES - 1]);
            assert!(middle.abs_diff_eq(camera.project(point), 1e-12), "{depth}");
        }
    }

    #[test]
    fn a_refusal_keeps_its_text() {
        let refused = |piece: fn() -> Result<(), Failure>| match Outcome::of(piece) {
            Outcome::Refused(text) => text,
            Outcome::Timed(()) => "none".to_owned(),
        };
        assert_eq!(refused(|| Err("no room".into())), "no room");
        assert_eq!(refused(|| panic!("{} bytes", 5)), "5 bytes");
        let cause = || Err(trainer::TrainError::from(trainer::SceneProblem::NoFrames).into());
        let text = refused(cause);
        assert!(text.contains(": "), "{text}: a cause is behind its effect");
        assert_eq!(refused(|| Ok(())), "none");
    }
}
