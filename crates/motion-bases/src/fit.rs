//! The first fit: bases, coefficients and means against the 3D tracks.
//!
//! Shape of Motion runs 1,000 steps of Adam on this loss before it renders anything. The optimiser
//! is the caller's. All lengths are divided by the foreground's extent, so that the weights (and
//! learning rates relative to the extent) hold at any scale of the scene.
//!
//! Tensors are laid out [N, P], a component at a time: each operation then runs over contiguous
//! memory, and a shift in time is a contiguous slice.

use crate::MotionError;
use crate::init::MotionInit;
use crate::motion::MotionBases;
use crate::rotation::{Components, MAX_ENTRY, orthonormal_columns, square_norm};
use crate::smoothness::{REST, bases_acceleration, mean_length};
use crate::statistics::quantile;
use burn::tensor::activation::softmax;
use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use glam::{DAffine3, DVec3};

/// Entries (tracks times frames) that a step looks at. With more than that the tracks are dealt into
/// groups of equal size, track by track in turn, and the steps go through the groups.
const STEP_ENTRIES: usize = 36_000;
/// Smallest z-depth, relative to the extent, by which a projection divides.
const MIN_DEPTH: f64 = 1e-5;
/// Share of the reprojection errors that counts; the largest ones do not.
const TRIM: f64 = 0.95;

const HIDDEN_WEIGHT: f64 = 0.5;
const SPARSITY_WEIGHT: f64 = 0.01;
const SMOOTHNESS_WEIGHT: (f64, f64) = (0.01, 0.1);
/// Part of the steps after which the smoothness weight starts to grow.
const SMOOTHNESS_START: f64 = 0.4;
const ACCELERATION_WEIGHT: f64 = 0.5;
const ALONG_RAY_WEIGHT: f64 = 0.1;

/// The camera of a frame, as plain values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitCamera {
    /// Pose; the camera looks along z, with x to the right and y down.
    pub cam_from_world: DAffine3,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point's x, in pixels.
    pub cx: f64,
    /// Principal point's y, in pixels.
    pub cy: f64,
}

/// What the first fit compares with: tracks and cameras as tensors.
#[derive(Clone, Debug)]
pub struct FitData {
    num_tracks: usize,
    num_frames: usize,
    /// Lengths are divided by this (scene units).
    extent: f64,
    groups: Vec<Group>,
    /// Rows u, v, z of the projection, four numbers each, [N, 1]; u and v in units of fx.
    projection: [[Tensor<2>; 4]; 3],
    /// Camera centres over the extent, [N, 1].
    centers: Components,
}

/// The tracks of one step; p of them.
#[derive(Clone, Debug)]
struct Group {
    /// Rows of the tracks, unless they are all.
    rows: Option<Tensor<1, Int>>,
    /// Positions over the extent, [N, p].
    positions: Components,
    /// Confidence where visible, [N, p], divided by three times its sum.
    seen: Tensor<2>,
    hidden: Option<Hidden>,
}

/// Where tracks are known to be hidden: only the pixel counts.
#[derive(Clone, Debug)]
struct Hidden {
    /// Pixel over fx, [N, p].
    pixels: [Tensor<2>; 2],
    /// Confidence, [N, p]; zero where not hidden.
    weights: Tensor<2>,
    /// Flat indices of the hidden entries.
    entries: Tensor<1, Int>,
}

impl FitData {
    /// Prepares tracks and cameras (one per frame) on a device.
    ///
    /// # Errors
    /// [`MotionError::Length`] when the number of cameras is not that of the frames,
    /// [`MotionError::BadCamera`] for numbers that are not finite or focal lengths that are not positive.
    pub fn new(
        init: &MotionInit,
        cameras: &[FitCamera],
        device: &Device,
        dtype: DType,
    ) -> Result<Self, MotionError> {
        let (num_tracks, num_frames) = (init.tracks.len(), init.tracks.num_frames);
        if cameras.len() != num_frames {
            return Err(MotionError::Length {
                what: "cameras",
                found: cameras.len(),
                expected: num_frames,
            });
        }
        let projections: Vec<[[f64; 4]; 3]> = cameras
            .iter()
            .enumerate()
            .map(|(frame, camera)| {
                projection_rows(camera, init.extent).ok_or(MotionError::BadCamera { frame })
            })
            .collect::<Result<_, _>>()?;
        let centers: Vec<DVec3> = cameras
            .iter()
            .map(|c| c.cam_from_world.inverse().translation / init.extent)
            .collect();
        let column = |value: &dyn Fn(usize) -> f64| {
            let values: Vec<f64> = (0..num_frames).map(value).collect();
            Tensor::<2>::from_data(TensorData::new(values, [num_frames, 1]), (device, dtype))
        };
        let num_groups = (num_tracks * num_frames)
            .div_ceil(STEP_ENTRIES)
            .clamp(1, num_tracks.max(1));
        let groups = (0..num_groups)
            .map(|g| {
                let rows: Vec<usize> = (g..num_tracks).step_by(num_groups).collect();
                Group::new(init, rows, num_groups > 1, &projections, device, dtype)
            })
            .collect();
        Ok(Self {
            num_tracks,
            num_frames,
            extent: init.extent,
            groups,
            projection: [0, 1, 2].map(|i| [0, 1, 2, 3].map(|j| column(&|t| projections[t][i][j]))),
            centers: [0, 1, 2].map(|k| column(&|t| centers[t][k])),
        })
    }
}

impl Group {
    fn new(
        init: &MotionInit,
        rows: Vec<usize>,
        is_part: bool,
        projections: &[[[f64; 4]; 3]],
        device: &Device,
        dtype: DType,
    ) -> Self {
        let (tracks, n, p) = (&init.tracks, init.tracks.num_frames, rows.len());
        let tensor = |value: &dyn Fn(usize, usize) -> f64| {
            let mut values = Vec::with_capacity(n * p);
            for t in 0..n {
                values.extend(rows.iter().map(|&row| value(tracks.index(row, t), t)));
            }
            Tensor::<2>::from_data(TensorData::new(values, [n, p]), (device, dtype))
        };
        let seen = |i: usize| {
            if tracks.visible[i] {
                f64::from(tracks.confidence[i])
            } else {
                0.0
            }
        };
        let total: f64 = rows
            .iter()
            .flat_map(|&row| (0..n).map(move |t| seen(tracks.index(row, t))))
            .sum();

        let pixel = |i: usize, t: usize| project(&projections[t], init.observed[i] / init.extent);
        let hides = |i: usize, t: usize| {
            !tracks.visible[i] && tracks.confidence[i] > 0.0 && pixel(i, t).is_some()
        };
        let mut entries = Vec::new();
        for t in 0..n {
            for (k, &row) in rows.iter().enumerate() {
                if hides(tracks.index(row, t), t) {
                    entries.push((t * p + k) as i64);
                }
            }
        }
        let count = entries.len();
        let hidden = (count > 0).then(|| Hidden {
            pixels: [0, 1].map(|k| tensor(&|i, t| pixel(i, t).map_or(0.0, |p| p[k]))),
            weights: tensor(&|i, t| {
                if hides(i, t) {
                    f64::from(tracks.confidence[i])
                } else {
                    0.0
                }
            }),
            entries: Tensor::from_data(TensorData::new(entries, [count]), device),
        });
        Self {
            positions: [0, 1, 2].map(|k| tensor(&|i, _| tracks.positions[i][k] / init.extent)),
            seen: tensor(&|i, _| seen(i) / (3.0 * total + 1e-8)),
            hidden,
            rows: is_part.then(|| {
                let rows: Vec<i64> = rows.iter().map(|&row| row as i64).collect();
                Tensor::<1, Int>::from_data(TensorData::new(rows, [p]), device)
            }),
        }
    }
}

/// Rows u, v, z of the projection of points over `extent`: the pixel in units of fx is (u / z, v / z).
fn projection_rows(camera: &FitCamera, extent: f64) -> Option<[[f64; 4]; 3]> {
    let FitCamera {
        cam_from_world,
        fx,
        fy,
        cx,
        cy,
    } = *camera;
    let finite = cam_from_world.is_finite() && [fx, fy, cx, cy].iter().all(|v| v.is_finite());
    if !finite || fx <= 0.0 || fy <= 0.0 || cam_from_world.matrix3.determinant() == 0.0 {
        return None;
    }
    let (m, t) = (cam_from_world.matrix3, cam_from_world.translation / extent);
    let row = |k: usize| [m.x_axis[k], m.y_axis[k], m.z_axis[k], t[k]];
    let (x, y, z) = (row(0), row(1), row(2));
    let mut rows = [[0.0; 4], [0.0; 4], z];
    for j in 0..4 {
        rows[0][j] = x[j] + cx / fx * z[j];
        rows[1][j] = (fy * y[j] + cy * z[j]) / fx;
    }
    Some(rows)
}

/// Pixel in units of fx, if the point lies before the camera.
fn project(rows: &[[f64; 4]; 3], point: DVec3) -> Option<[f64; 2]> {
    let [u, v, z] = rows.map(|r| r[0] * point.x + r[1] * point.y + r[2] * point.z + r[3]);
    (z > MIN_DEPTH).then(|| [u / z, v / z])
}

/// Positions of all Gaussians in all training frames, [P, N, 3], in scene units.
///
/// `coefficients` are logits [P, B], `means` are canonical positions [P, 3]. Differentiable.
#[must_use]
pub fn positions_all_frames(
    bases: &MotionBases,
    coefficients: &Tensor<2>,
    means: &Tensor<2>,
) -> Tensor<3> {
    let [count, _] = means.dims();
    let n = bases.num_frames;
    let weights = softmax(coefficients.clone(), 1).transpose();
    let positions = posed(bases, weights, means.clone(), 1.0);
    let columns = positions.map(|p| p.transpose().reshape([count, n, 1]));
    Tensor::cat(columns.into(), 2)
}

/// Positions over `extent` in all frames, [N, P] each. `weights` is [B, P], `means` [P, 3].
fn posed(bases: &MotionBases, weights: Tensor<2>, means: Tensor<2>, extent: f64) -> Components {
    let (b, n) = (bases.num_bases(), bases.num_frames);
    // [B, N * width] -> [width * N, B], so that a component of all frames is one block of rows.
    let blocks = |frames: Tensor<2>, width: usize| {
        frames
            .reshape([b, n, width])
            .permute([2, 1, 0])
            .reshape([width * n, b])
    };
    let rots = blocks(bases.rots.clone().clamp(-MAX_ENTRY, MAX_ENTRY), 6);
    let transls = blocks(bases.transls.clone() / extent, 3);
    let blend = |blocks: &Tensor<2>, c: usize| {
        blocks
            .clone()
            .slice_dim(0, c * n..(c + 1) * n)
            .matmul(weights.clone())
    };
    let six = |c: usize| blend(&rots, c);
    let columns = orthonormal_columns([six(0), six(1), six(2)], [six(3), six(4), six(5)]);
    let means = (means / extent).transpose(); // [3, P]
    let mean = [0, 1, 2].map(|k| means.clone().slice_dim(0, k..k + 1)); // [1, P]
    [0, 1, 2].map(|i| {
        columns[0][i].clone() * mean[0].clone()
            + columns[1][i].clone() * mean[1].clone()
            + columns[2][i].clone() * mean[2].clone()
            + blend(&transls, i)
    })
}

/// What the first fit moves. Its rows belong to the tracks of [`MotionInit`], in their order.
#[derive(Clone, Copy, Debug)]
pub struct Fit<'a> {
    /// The bases.
    pub bases: &'a MotionBases,
    /// Weights of the bases before their softmax, [P, B].
    pub coefficients: &'a Tensor<2>,
    /// Positions in the canonical frame, [P, 3].
    pub means: &'a Tensor<2>,
}

/// The loss of step `step` of `num_steps` of the first fit, `[1]`.
///
/// With P tracks over N frames, P N > 36,000, each step takes the next of ⌈P N / 36,000⌉ groups.
/// Terms: L1 to the visible positions (weight 1), L1 to the pixels of hidden ones, trimmed (0.5),
/// sparse coefficients (0.01), smooth bases (0.01, growing to 0.1 from 40 % of the steps on), small
/// accelerations of positions (half of that) and little motion along the viewing rays (0.1).
///
/// # Panics
/// Panics when the shapes do not fit those of the data.
#[must_use]
pub fn fit_loss(fit: &Fit<'_>, data: &FitData, step: usize, num_steps: usize) -> Tensor<1> {
    let &Fit {
        bases,
        coefficients,
        means,
    } = fit;
    let [rows, num_bases] = coefficients.dims();
    assert!(
        rows == data.num_tracks
            && means.dims() == [rows, 3]
            && num_bases == bases.num_bases()
            && bases.num_frames == data.num_frames,
        "first fit of {} tracks over {} frames, {} bases: got coefficients {:?}, means {:?}, bases over {} frames",
        data.num_tracks,
        data.num_frames,
        bases.num_bases(),
        coefficients.dims(),
        means.dims(),
        bases.num_frames,
    );
    let group = &data.groups[step % data.groups.len()];
    let pick = |tensor: &Tensor<2>| match &group.rows {
        Some(rows) => tensor.clone().select(0, rows.clone()),
        None => tensor.clone(),
    };
    let weights = softmax(pick(coefficients), 1); // [p, B]
    let sparsity = weights.clone().square().sum_dim(1).mean().neg() + 1.0;
    let positions = posed(bases, weights.transpose(), pick(means), data.extent);

    let difference = |k: usize| (positions[k].clone() - group.positions[k].clone()).abs();
    let to_tracks = ((difference(0) + difference(1) + difference(2)) * group.seen.clone()).sum();

    let progress = step as f64 / num_steps.max(1) as f64;
    let growth = ((progress - SMOOTHNESS_START) / (1.0 - SMOOTHNESS_START)).clamp(0.0, 1.0);
    let smooth = SMOOTHNESS_WEIGHT.0 + (SMOOTHNESS_WEIGHT.1 - SMOOTHNESS_WEIGHT.0) * growth;
    let mut loss =
        to_tracks + sparsity * SPARSITY_WEIGHT + bases_acceleration(bases, data.extent) * smooth;
    if let Some(hidden) = &group.hidden {
        loss = loss + hidden.loss(&positions, &data.projection) * HIDDEN_WEIGHT;
    }
    if data.num_frames >= 3 {
        let (acceleration, along_ray) = path_losses(&positions, &data.centers);
        loss = loss + acceleration * (ACCELERATION_WEIGHT * smooth) + along_ray * ALONG_RAY_WEIGHT;
    }
    loss
}

impl Hidden {
    /// Trimmed weighted L1 between projections and pixels, in units of fx.
    fn loss(&self, positions: &Components, projection: &[[Tensor<2>; 4]; 3]) -> Tensor<1> {
        let row = |r: &[Tensor<2>; 4]| {
            positions[0].clone() * r[0].clone()
                + positions[1].clone() * r[1].clone()
                + positions[2].clone() * r[2].clone()
                + r[3].clone()
        };
        let inverse_depth = row(&projection[2]).clamp_min(MIN_DEPTH).recip();
        let off =
            |k: usize| (row(&projection[k]) * inverse_depth.clone() - self.pixels[k].clone()).abs();
        let error = (off(0) + off(1)) * 0.5;
        let fixed = error.clone().detach();
        let hidden = fixed.clone().reshape([-1]).select(0, self.entries.clone());
        let mut values: Vec<f64> = hidden.into_data().iter::<f64>().collect();
        let limit = quantile(&mut values, TRIM);
        let weights = self
            .weights
            .clone()
            .mask_fill(fixed.greater_elem(limit), 0.0);
        let total = weights.clone().sum() + 1e-8;
        (error * weights).sum() / total
    }
}

/// Mean acceleration of the positions, and mean square of their steps along the viewing rays.
fn path_losses(positions: &Components, centers: &Components) -> (Tensor<1>, Tensor<1>) {
    let n = positions[0].dims()[0];
    let inner = |tensor: &Tensor<2>, t: usize| tensor.clone().slice_dim(0, t..t + n - 2);
    // Steps between frames, [N - 1, P]: the two around each inner frame are slices of them.
    let steps = [0, 1, 2].map(|k| {
        positions[k].clone().slice_dim(0, 1..n) - positions[k].clone().slice_dim(0, 0..n - 1)
    });
    let acceleration = [0, 1, 2].map(|k| inner(&steps[k], 1) - inner(&steps[k], 0));
    let ray = [0, 1, 2].map(|k| inner(&positions[k], 1) - inner(&centers[k], 1));
    let square_length = square_norm(&ray).clamp_min(REST * REST);
    let along = |t: usize| {
        let dot = inner(&steps[0], t) * ray[0].clone()
            + inner(&steps[1], t) * ray[1].clone()
            + inner(&steps[2], t) * ray[2].clone();
        (dot.square() / square_length.clone()).mean()
    };
    (mean_length(square_norm(&acceleration)), along(0) + along(1))
}
