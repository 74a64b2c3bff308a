//! What no Gaussian covers at the start: a pixel without one shows no gradient where one is missing, and stays black.

use crate::TrainError;
use crate::look::{Look, render_sharp};
use crate::placement::{Seeds, lift, pixel_color};
use crate::tensors::host;
use crate::views::Views;
use crate::world::World;
use io::{Frame, Scene};
use splat_core::CameraModel;
use std::collections::VecDeque;

/// Pixels through which more of the light passes than this are covered by no Gaussian.
const LIGHT_THROUGH: f32 = 0.9;

/// The scene at the start with what covers all of it.
#[derive(Debug)]
pub(crate) struct Filled {
    pub(crate) world: World,
    /// New static Gaussians in it.
    more: usize,
    /// Pixels of all frames that no Gaussian covered; those that a Gaussian placed for an earlier frame covers are none.
    holes: usize,
    /// Pixels of all frames.
    pixels: usize,
}

impl Filled {
    /// How much that was, for people.
    pub(crate) fn note(&self) -> String {
        match self.holes {
            0 => "every pixel of the frames is covered by Gaussians".to_owned(),
            holes => format!(
                "{holes} pixels of the frames ({:.2} %) were covered by no Gaussian: {} more",
                100.0 * holes as f64 / self.pixels as f64,
                self.more
            ),
        }
    }
}

/// Looks at every training frame, and places a Gaussian wherever none covers a pixel that shows nothing that moves: at the pixel's
/// depth, or, where that is missing, at that of the nearest pixel that is covered (`far`, where none is). A Gaussian has a pixel's
/// size and covers its neighbours too. At most `room` are placed.
///
/// `world` is the scene at the start with some static Gaussians more.
///
/// # Errors
/// The renderer refuses its input.
pub(crate) fn fill(
    scene: &Scene,
    views: &Views,
    far: f64,
    room: usize,
    world: impl Fn(Seeds) -> World,
) -> Result<Filled, TrainError> {
    let mut seeds = Seeds::default();
    let (mut all_holes, mut pixels) = (0, 0);
    let mut current = world(Seeds::default());
    let has_movers = current.motion.is_some();
    for (frame, viewpoint) in scene.frames.iter().zip(&views.train) {
        let look = Look {
            viewpoint,
            frame: None,
            iteration: 0,
            sh_degree: 0,
            view: None,
            pose: None,
            gain: None,
            screen_grad: None,
        };
        let rendered = render_sharp(&current.detached(), &look)?;
        let alpha = host(rendered.alpha());
        pixels += alpha.len();
        let moves = |i: usize| {
            let mask = frame.mask.as_ref().filter(|_| has_movers);
            mask.is_some_and(|m| m.values[i] > 0.5)
        };
        let is_hole = |i: &usize| alpha[*i] < 1.0 - LIGHT_THROUGH && !moves(*i);
        let holes: Vec<usize> = (0..alpha.len()).filter(is_hole).collect();
        all_holes += holes.len();
        if holes.is_empty() || seeds.means.len() >= room {
            continue;
        }
        let depth = depth_of_holes(frame, &alpha, &host(rendered.depth()), far);
        let width = viewpoint.camera.width;
        let mut covered = vec![false; alpha.len()];
        for i in holes {
            if covered[i] || seeds.means.len() >= room {
                continue;
            }
            let (x, y) = (i % width, i / width);
            for row in y.saturating_sub(1)..=(y + 1).min(viewpoint.camera.height - 1) {
                covered[row * width + x.saturating_sub(1)..=row * width + (x + 1).min(width - 1)]
                    .fill(true);
            }
            seeds.means.push(lift(frame, i, depth[i]));
            seeds.colors.push(pixel_color(frame, i));
            seeds.scales.push(match viewpoint.camera.model {
                CameraModel::Pinhole => depth[i] / viewpoint.camera.fx,
            });
        }
        current = world(seeds.clone());
    }
    Ok(Filled {
        world: current,
        more: seeds.means.len(),
        holes: all_holes,
        pixels,
    })
}

/// z-depth of every pixel: its own, where it is missing what is rendered at the nearest pixel that is covered, and `far` where
/// none is.
fn depth_of_holes(frame: &Frame, alpha: &[f32], depth: &[f32], far: f64) -> Vec<f64> {
    let camera = &frame.view.camera;
    let (width, height) = (camera.width, camera.height);
    let mut known = vec![0.0; alpha.len()];
    let mut queue = VecDeque::new();
    for i in 0..alpha.len() {
        if alpha[i] >= 1.0 - LIGHT_THROUGH {
            known[i] = f64::from(depth[i] / alpha[i]);
            queue.push_back(i);
        }
    }
    while let Some(i) = queue.pop_front() {
        let (x, y) = (i % width, i / width);
        let left = (x > 0).then(|| i - 1);
        let right = (x + 1 < width).then(|| i + 1);
        let up = (y > 0).then(|| i - width);
        let down = (y + 1 < height).then(|| i + width);
        for next in [left, right, up, down].into_iter().flatten() {
            if known[next] == 0.0 {
                known[next] = known[i];
                queue.push_back(next);
            }
        }
    }
    let own = |i: usize| frame.depth.as_ref().map_or(0.0, |d| f64::from(d.values[i]));
    let known = known.into_iter().enumerate();
    known
        .map(|(i, nearest)| match (own(i), nearest) {
            (own, _) if own > 0.0 => own,
            (_, nearest) if nearest > 0.0 => nearest,
            _ => far,
        })
        .collect()
}
