//! Dynamic Gaussians: where they start (from tracks), the first fit of their motion, and the one
//! densification that the paper calls dynamic.

use crate::TrainError;
use crate::adam::{AdamState, AdamStep, LearningRate, adam_step, finite_gradient};
use crate::lifting::lift_tracks;
use crate::neighbors::{Neighbors, mean_neighbor_distances};
use crate::placement::{Seeds, lift, pixel_color};
use crate::random::{Purpose, derived_seed, generator, sample};
use crate::settings::Settings;
use crate::tensors::{host, leaf};
use crate::track_smoothing::best_window;
use crate::world::{GaussianTensors, MotionModel, World};
use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use glam::{DMat3, DVec3};
use io::Scene;
use motion_bases::{Fit, FitCamera, FitData, InitOptions, MotionBases, fit_loss, initialize};
use splat_core::CameraModel;
use unseen_views::depth_edges;

/// Tracks lie on a grid, so that few are needed: from this many visible ones on, Gaussians are placed
/// on those alone that are visible in the canonical frame, as in the paper.
const MIN_VISIBLE: usize = 50;

/// Dynamic Gaussians at the start, and their motion.
pub(crate) struct DynamicStart {
    pub(crate) seeds: Seeds,
    pub(crate) motion: MotionModel,
    /// What was found, for people.
    pub(crate) note: String,
}

/// Lifts the tracks, initialises the motion bases, and fits both to the tracks. `None` when no track can be lifted.
pub(crate) fn start_dynamics(
    scene: &Scene,
    settings: &Settings,
    device: &Device,
    dtype: DType,
) -> Result<Option<DynamicStart>, TrainError> {
    // Each becomes a Gaussian: with many frames they would be more than a picture can show, and leave no room for others.
    let pixels = scene
        .frames
        .first()
        .map_or(0, |f| f.view.camera.num_pixels());
    let most = settings.motion.max_tracks.min(pixels);
    let queries = scene.tracks.as_ref().map_or(&[][..], |t| &t.queries);
    let window = (settings.motion.smooth_tracks)
        .then(|| best_window(queries, scene.frames.len()))
        .flatten();
    let tracks = lift_tracks(scene, most, window, settings.seed);
    if tracks.colors.is_empty() {
        return Ok(None);
    }
    let seed = derived_seed(settings.seed, Purpose::Motion);
    let init = initialize(
        &tracks,
        &InitOptions {
            num_bases: settings.motion.num_bases,
            fewest: settings.motion.fewest_bases,
            seed,
        },
    )?;
    let (kept, frames, bases) = (
        init.tracks.colors.len(),
        init.tracks.num_frames,
        init.num_bases,
    );
    let cameras: Vec<FitCamera> = scene
        .frames
        .iter()
        .map(|f| {
            let c = &f.view.camera;
            // What the first fit projects with.
            let CameraModel::Pinhole = c.model;
            FitCamera {
                cam_from_world: f.view.cam_from_world,
                fx: c.fx,
                fy: c.fy,
                cx: c.cx,
                cy: c.cy,
            }
        })
        .collect();

    let start = |values: Vec<f64>, shape: [usize; 2]| {
        Tensor::<2>::from_data(TensorData::new(values, shape), (device, dtype)).require_grad()
    };
    let canonical = init.canonical_frame;
    let MotionBases { rots, transls, .. } = MotionBases::from_init(&init, device, dtype);
    let (mut rots, mut transls) = (rots.require_grad(), transls.require_grad());
    let mut coefficients = start(
        init.coefficients.iter().map(|&c| f64::from(c)).collect(),
        [kept, bases],
    );
    let mut means = start(init.canonical_means(), [kept, 3]);
    let data = FitData::new(&init, &cameras)?;
    let mut states = [&rots, &transls, &coefficients, &means].map(AdamState::new);
    let steps = settings.motion.first_fit_steps;
    for step in 0..steps {
        let motion = MotionBases {
            rots: rots.clone(),
            transls: transls.clone(),
            num_frames: frames,
        };
        let fit = Fit {
            bases: &motion,
            coefficients: &coefficients,
            means: &means,
        };
        let loss = fit_loss(&fit, &data, step, steps);
        let mut grads = loss.backward();
        let decay = 0.1_f64.powf(step as f64 / steps as f64);
        let groups = [
            ("rots", &mut rots, 1e-2),
            ("transls", &mut transls, 3e-2 * init.extent),
            ("coefficients", &mut coefficients, 1e-2),
            ("means", &mut means, 1e-3 * init.extent),
        ];
        for ((name, parameter, rate), state) in groups.into_iter().zip(&mut states) {
            let rate = LearningRate::Uniform(rate * decay);
            let Some(grad) = parameter.grad_remove(&mut grads) else {
                continue;
            };
            let grad = finite_gradient(grad).map_err(|problem| TrainError::FirstFit {
                step,
                name,
                problem,
            })?;
            let step = AdamStep {
                rate: &rate,
                drawn: &[],
            };
            adam_step(parameter, grad, state, &step);
        }
    }

    let visible: Vec<usize> = (0..kept)
        .filter(|p| init.tracks.visible[p * frames + canonical])
        .collect();
    let chosen = if visible.len() >= MIN_VISIBLE {
        visible
    } else {
        (0..kept).collect()
    };
    let fitted = host(means);
    let means: Vec<DVec3> = chosen
        .iter()
        .map(|&p| {
            DVec3::new(
                fitted[3 * p].into(),
                fitted[3 * p + 1].into(),
                fitted[3 * p + 2].into(),
            )
        })
        .collect();
    let scales = clamped_scales(&means);
    let colors = chosen.iter().map(|&p| init.tracks.colors[p]).collect();
    let note = format!(
        "{kept} tracks{}, {bases} motion bases{} (`motion.num_bases` sets the most), canonical frame {canonical}, {} dynamic Gaussians",
        window.map_or_else(String::new, |half_width| {
            let frames = 2 * half_width + 1;
            format!(", smoothed over {frames} frames (not with `motion.smooth_tracks = false`)")
        }),
        if bases < init.num_motions {
            format!(
                " (of {} motions that were told apart; tracks that were left out need no more)",
                init.num_motions
            )
        } else {
            String::new()
        },
        chosen.len()
    );
    let rows: Vec<i64> = chosen.iter().map(|&p| p as i64).collect();
    let rows = Tensor::<1, Int>::from_data(
        TensorData::new(rows, [chosen.len()]),
        &device.clone().inner(),
    );
    let motion = MotionModel {
        bases: MotionBases {
            rots,
            transls,
            num_frames: frames,
        },
        coefficients: leaf(coefficients.inner().select(0, rows), true),
    };
    Ok(Some(DynamicStart {
        seeds: Seeds {
            means,
            colors,
            scales,
        },
        motion,
        note,
    }))
}

/// Mean distance to the three nearest neighbours, clamped to its own 5 % and 95 % quantiles.
fn clamped_scales(means: &[DVec3]) -> Vec<f64> {
    let distances = mean_neighbor_distances(means);
    let mut sorted = distances.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let Some(last) = sorted.len().checked_sub(1) else {
        return distances;
    };
    let quantile = |q: f64| sorted[(q * last as f64) as usize];
    distances
        .iter()
        .map(|d| d.clamp(quantile(0.05), quantile(0.95)))
        .collect()
}

/// New dynamic Gaussians, to be inserted behind the existing ones.
pub(crate) struct NewDynamic {
    pub(crate) gaussians: GaussianTensors,
    /// The dynamic Gaussian whose motion each follows, `[M]`.
    pub(crate) parents: Vec<u32>,
}

/// Dynamic densification: lifts dynamic pixels of every frame, and maps each into the canonical frame
/// with the motion of the dynamic Gaussian that is nearest to it at that time, whose coefficients it takes.
///
/// A frame adds at most [`densify_share`], and at most `room` Gaussians come in all.
pub(crate) fn densify(
    world: &World,
    scene: &Scene,
    settings: &Settings,
    room: usize,
    device: &Device,
) -> Option<NewDynamic> {
    let motion = world.motion.as_ref()?;
    let share = densify_share(scene, settings).min(room / scene.frames.len());
    let (mut means, mut colors, mut parents) = (Vec::new(), Vec::new(), Vec::new());
    for (index, frame) in scene.frames.iter().enumerate() {
        let Some(depth) = &frame.depth else { continue };
        let at = motion
            .bases
            .motion_at(&motion.coefficients, frame.view.time);
        let posed: Vec<DVec3> = to_points(&host(at.transform_means(&world.dynamic_means())));
        let (rotations, translations) = (host(at.rotations), to_points(&host(at.translations)));
        let tree = Neighbors::new(&posed)?;
        let mut rng = generator(settings.seed, Purpose::DynamicDensification, index as u64);
        let candidates = dynamic_pixels(frame, settings);
        for j in sample(&mut rng, candidates.len(), share) {
            let i = candidates[j];
            let world = lift(frame, i, f64::from(depth.values[i]));
            let parent = tree.nearest(world);
            let r: Vec<f64> = rotations[9 * parent..9 * parent + 9]
                .iter()
                .map(|&v| f64::from(v))
                .collect();
            // Rows of the row-major rotation are the columns of its inverse.
            let inverse = DMat3::from_cols_slice(&r);
            means.push(inverse * (world - translations[parent]));
            colors.push(pixel_color(frame, i));
            parents.push(u32::try_from(parent).expect("fewer than 2^32 Gaussians"));
        }
    }
    if means.is_empty() {
        return None;
    }
    let mut all = to_points(&host(world.dynamic_means()));
    let existing = all.len();
    all.extend(&means);
    let scales = clamped_scales(&all).split_off(existing);
    let seeds = Seeds {
        means,
        colors,
        scales,
    };
    Some(NewDynamic {
        gaussians: GaussianTensors::new(
            &seeds,
            settings.gaussians.initial_opacity,
            world.sh_degree(),
            (device, world.means.dtype()),
        ),
        parents,
    })
}

/// The most dynamic Gaussians that a frame adds in [`densify`]: at most `densify_per_frame`, and all frames together two for each
/// pixel of the largest mask (as many as static Gaussians start with), so that a small mover is not buried in copies of itself.
pub(crate) fn densify_share(scene: &Scene, settings: &Settings) -> usize {
    let sizes = scene
        .frames
        .iter()
        .map(|f| dynamic_pixels(f, settings).len());
    let largest = sizes.max().unwrap_or(0);
    (2 * largest)
        .div_ceil(scene.frames.len())
        .min(settings.motion.densify_per_frame)
}

/// Pixels that certainly show a mover: inside the mask, with depth, off depth edges.
fn dynamic_pixels(frame: &io::Frame, settings: &Settings) -> Vec<usize> {
    let (Some(depth), Some(mask)) = (&frame.depth, &frame.mask) else {
        return Vec::new();
    };
    let edge = depth_edges(&depth.values, depth.width, settings.gaussians.depth_edge);
    (0..mask.values.len())
        .filter(|&i| mask.values[i] > 0.5 && depth.values[i] > 0.0 && !edge[i])
        .collect()
}

fn to_points(values: &[f32]) -> Vec<DVec3> {
    values
        .chunks_exact(3)
        .map(|c| DVec3::new(c[0].into(), c[1].into(), c[2].into()))
        .collect()
}
