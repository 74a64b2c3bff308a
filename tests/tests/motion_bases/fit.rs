//! Motion bases from tracks: what the start recovers, and what the first fit adds.

use burn::tensor::{DType, Device, Tensor};
use glam::{DAffine3, DQuat, DVec3};
use limpid_tests::{
    GradLimits, Noise, check_gradients, devices_in, in_pool, quick_devices, tensor, values,
};
use motion_bases::{
    Fit, FitCamera, FitData, InitOptions, MotionBases, MotionError, MotionInit, Tracks3d, fit_loss,
    initialize, positions_all_frames,
};

fn vector(noise: &mut Noise) -> DVec3 {
    DVec3::new(noise.number(), noise.number(), noise.number())
}

/// Two rigid bodies 5 units before the camera, one driving past, one turning; with the true paths.
pub(crate) struct Scene {
    pub(crate) tracks: Tracks3d,
    /// True positions, [P * N].
    truth: Vec<DVec3>,
    pub(crate) cameras: Vec<FitCamera>,
}

pub(crate) fn two_movers(tracks_each: usize, frames: usize, noise: f64) -> Scene {
    let mut random = Noise(77);
    let middle = (frames as f64 - 1.0) / 2.0;
    let mut scene = Scene {
        tracks: Tracks3d {
            num_frames: frames,
            ..Tracks3d::default()
        },
        truth: Vec::new(),
        cameras: (0..frames)
            .map(|t| FitCamera {
                cam_from_world: DAffine3::from_rotation_translation(
                    DQuat::from_rotation_y(0.01 * t as f64),
                    DVec3::new(0.02 * t as f64, 0.0, 0.0),
                ),
                fx: 300.0,
                fy: 310.0,
                cx: 128.0,
                cy: 70.0,
            })
            .collect(),
    };
    for row in 0..2 * tracks_each {
        let local = 0.4 * vector(&mut random);
        for t in 0..frames {
            let time = (t as f64 - middle) / frames as f64;
            let at = if row % 2 == 0 {
                DVec3::new(-1.2 + 0.8 * time, 0.3, 5.0 + 0.5 * time)
                    + DQuat::from_rotation_y(0.4 * time) * local
            } else {
                let turn = DQuat::from_axis_angle(DVec3::new(0.0, 0.6, 0.8), 1.5 * time);
                DVec3::new(1.2, -0.2 + 0.5 * time, 5.5) + turn * local
            };
            scene.truth.push(at);
            // Each track is hidden for a while, behind something that is half as far.
            let hidden = (t + row * 5) % (2 * frames) < frames / 4;
            let center = scene.cameras[t].cam_from_world.inverse().translation;
            let seen = if hidden {
                center.midpoint(at)
            } else {
                at + noise * vector(&mut random)
            };
            scene.tracks.positions.push(seen);
            scene.tracks.visible.push(!hidden);
            scene.tracks.confidence.push(if hidden { 0.8 } else { 0.9 });
        }
        scene.tracks.colors.push([0.5; 3]);
    }
    scene
}

/// Bases, coefficients and means, with Adam's moments: a first fit in ten lines.
struct Fitting {
    leaves: [Tensor<2>; 4],
    moments: [[Tensor<2>; 2]; 4],
    rates: [f64; 4],
    num_frames: usize,
    data: FitData,
}

impl Fitting {
    fn new(init: &MotionInit, cameras: &[FitCamera], device: &Device, dtype: DType) -> Self {
        let n = init.tracks.num_frames;
        let leaves = start(init).map(|(_, shape, values)| tensor(&values, shape, device, dtype));
        let moments = [0, 1, 2, 3].map(|k: usize| [leaves[k].zeros_like(), leaves[k].zeros_like()]);
        Self {
            leaves,
            moments,
            rates: [1e-2, 3e-2 * init.extent, 1e-2, 1e-3 * init.extent],
            num_frames: n,
            data: FitData::new(init, cameras).expect("a camera per frame"),
        }
    }

    fn bases(&self) -> MotionBases {
        MotionBases {
            rots: self.leaves[0].clone(),
            transls: self.leaves[1].clone(),
            num_frames: self.num_frames,
        }
    }

    fn step(&mut self, step: usize, num_steps: usize) -> f64 {
        self.leaves = self.leaves.clone().map(|leaf| leaf.detach().require_grad());
        let loss = fit_loss(
            &Fit {
                bases: &self.bases(),
                coefficients: &self.leaves[2],
                means: &self.leaves[3],
            },
            &self.data,
            step,
            num_steps,
        );
        let grads = loss.backward();
        let decay = 0.1_f64.powf(step as f64 / num_steps as f64);
        for k in 0..4 {
            let leaf = &self.leaves[k];
            let g = Tensor::from_inner(leaf.grad(&grads).expect("each input has a gradient"));
            let [m, v] = self.moments[k].clone();
            let (m, v) = (m * 0.9 + g.clone() * 0.1, v * 0.999 + g.square() * 0.001);
            let power = step as i32 + 1;
            let rate = self.rates[k] * decay / (1.0 - 0.9_f64.powi(power));
            let size = (v.clone() / (1.0 - 0.999_f64.powi(power))).sqrt() + 1e-8;
            self.leaves[k] = leaf.clone().detach() - m.clone() / size * rate;
            self.moments[k] = [m, v];
        }
        loss.into_scalar::<f64>()
    }

    fn positions(&self) -> Vec<f64> {
        values(positions_all_frames(
            &self.bases(),
            &self.leaves[2],
            &self.leaves[3],
        ))
    }

    /// Mean distance to the true paths, over all kept tracks and frames.
    fn error(&self, init: &MotionInit, truth: &[DVec3]) -> f64 {
        let (n, positions) = (self.num_frames, self.positions());
        let entries = init
            .rows
            .iter()
            .flat_map(|&row| truth[row * n..(row + 1) * n].iter());
        let sum: f64 = entries
            .enumerate()
            .map(|(i, at)| at.distance(DVec3::from_slice(&positions[3 * i..])))
            .sum();
        sum / (init.rows.len() * n) as f64
    }
}

/// What is fitted, by name, with its shape.
pub(crate) type Start = [(&'static str, [usize; 2], Vec<f64>); 4];

/// The start that was found.
fn start(init: &MotionInit) -> Start {
    let (p, n, b) = (init.tracks.len(), init.tracks.num_frames, init.num_bases);
    let coefficients = init.coefficients.iter().map(|&v| f64::from(v));
    [
        ("rots", [b, n * 6], init.rots.clone()),
        ("transls", [b, n * 3], init.transls.clone()),
        ("coefficients", [p, b], coefficients.collect()),
        ("means", [p, 3], init.canonical_means()),
    ]
}

/// The same, each of its numbers off by up to 0.05.
pub(crate) fn shaken_start(init: &MotionInit) -> Start {
    let (mut start, mut random) = (start(init), Noise(5));
    for (_, _, values) in &mut start {
        values.iter_mut().for_each(|v| *v += 0.05 * random.number());
    }
    start
}

/// What is fitted, as tensors.
pub(crate) struct Moving {
    bases: MotionBases,
    coefficients: Tensor<2>,
    means: Tensor<2>,
}

impl Moving {
    pub(crate) fn new(start: &Start, num_frames: usize, device: &Device, dtype: DType) -> Self {
        let of = |(_, shape, values): &(_, _, Vec<f64>)| tensor(values, *shape, device, dtype);
        Self::of(start.each_ref().map(of), num_frames)
    }

    fn of([rots, transls, coefficients, means]: [Tensor<2>; 4], num_frames: usize) -> Self {
        Self {
            bases: MotionBases {
                rots,
                transls,
                num_frames,
            },
            coefficients,
            means,
        }
    }

    /// The same, of which gradients are asked.
    pub(crate) fn leaves(self) -> Self {
        let leaves = self.tensors().map(|tensor| tensor.clone().require_grad());
        Self::of(leaves, self.bases.num_frames)
    }

    pub(crate) fn fit(&self) -> Fit<'_> {
        Fit {
            bases: &self.bases,
            coefficients: &self.coefficients,
            means: &self.means,
        }
    }

    pub(crate) fn tensors(&self) -> [&Tensor<2>; 4] {
        let MotionBases { rots, transls, .. } = &self.bases;
        [rots, transls, &self.coefficients, &self.means]
    }
}

#[test]
fn two_movers_are_recovered_and_the_fit_improves_them() {
    for (name, device) in quick_devices() {
        let device = device.autodiff();
        // The noise has a mean length of about 0.96 times its size.
        for noise in [0.0, 0.01, 0.03] {
            let scene = two_movers(100, 12, noise);
            let init = initialize(
                &scene.tracks,
                &InitOptions {
                    num_bases: 20,
                    fewest: false,
                    seed: 1,
                },
            )
            .unwrap();
            let what = format!("{name}, noise {noise}, {} bases", init.num_bases);
            assert!(
                (2..=3).contains(&init.num_bases),
                "{what}: two rigid bodies"
            );
            let mut fit = Fitting::new(&init, &scene.cameras, &device, DType::F32);
            let before = fit.error(&init, &scene.truth);
            assert!(
                before < 0.005 + 1.2 * noise,
                "{what}: error {before} after the start"
            );
            let steps = 300;
            for step in 0..steps {
                fit.step(step, steps);
            }
            let after = fit.error(&init, &scene.truth);
            assert!(
                after < 0.8 * before,
                "{what}: error {after} after the fit, {before} before"
            );
            assert!(
                after < 0.003 + 0.6 * noise,
                "{what}: error {after} after the fit"
            );
        }
    }
}

#[test]
fn hidden_tracks_pull_towards_their_pixels() {
    for (name, device) in devices_in(DType::F64) {
        let device = device.autodiff();
        let scene = two_movers(40, 8, 0.0);
        let init = initialize(
            &scene.tracks,
            &InitOptions {
                num_bases: 2,
                fewest: false,
                seed: 1,
            },
        )
        .unwrap();
        // At the truth the term is zero, although the observed points lie half as deep.
        let mut fit = Fitting::new(&init, &scene.cameras, &device, DType::F64);
        let without = |tracks: &mut Tracks3d| {
            for (confidence, visible) in tracks.confidence.iter_mut().zip(&tracks.visible) {
                if !visible {
                    *confidence = 0.0;
                }
            }
        };
        let mut blind = init.clone();
        without(&mut blind.tracks);
        let mut other = Fitting::new(&blind, &scene.cameras, &device, DType::F64);
        for leaf in [&mut fit.leaves, &mut other.leaves] {
            // All canonical positions aside by 0.1.
            leaf[3] = leaf[3].clone() + 0.1;
        }
        let (with, without) = (fit.step(0, 1), other.step(0, 1));
        assert!(
            with > without + 1e-4,
            "{name}: {with} with hidden entries, {without} without"
        );
    }
}

#[test]
fn the_loss_has_the_right_gradient() {
    for (_, device) in devices_in(DType::F64) {
        let scene = two_movers(6, 5, 0.05);
        let init = initialize(
            &scene.tracks,
            &InitOptions {
                num_bases: 3,
                fewest: false,
                seed: 2,
            },
        )
        .unwrap();
        let data = FitData::new(&init, &scene.cameras).unwrap();
        let inputs = shaken_start(&init);
        for step in [0, 9] {
            check_gradients(&device, &inputs, &[], GradLimits::default(), |x| {
                let inputs = x.to_vec().try_into().expect("as many as there are");
                let moving = Moving::of(inputs, 5);
                fit_loss(&moving.fit(), &data, step, 10)
            });
        }
    }
}

#[test]
fn thin_data_can_be_fitted() {
    for (name, device) in quick_devices() {
        let device = device.autodiff();
        for (tracks_each, frames) in [(1, 1), (1, 2), (2, 3), (1, 6), (30, 2)] {
            let mut scene = two_movers(tracks_each, frames, 0.0);
            for coincident in [false, true] {
                if coincident {
                    scene.tracks.positions.fill(DVec3::new(0.1, 0.2, 5.0));
                }
                let init = initialize(
                    &scene.tracks,
                    &InitOptions {
                        num_bases: 20,
                        fewest: false,
                        seed: 1,
                    },
                )
                .unwrap();
                let mut fit = Fitting::new(&init, &scene.cameras, &device, DType::F32);
                for step in 0..3 {
                    let loss = fit.step(step, 3);
                    assert!(
                        loss.is_finite(),
                        "{name}: {tracks_each} tracks, {frames} frames: loss {loss}"
                    );
                }
                let finite = fit.positions().iter().all(|v| v.is_finite());
                assert!(
                    finite,
                    "{name}: {tracks_each} tracks, {frames} frames: not finite"
                );
            }
        }
    }
}

#[test]
fn tracks_dealt_into_groups_are_all_fitted() {
    for (name, device) in quick_devices() {
        let device = device.autodiff();
        // 40,000 entries: two groups, taken in turn.
        let scene = two_movers(2500, 8, 0.01);
        let init = initialize(
            &scene.tracks,
            &InitOptions {
                num_bases: 2,
                fewest: false,
                seed: 1,
            },
        )
        .unwrap();
        let mut fit = Fitting::new(&init, &scene.cameras, &device, DType::F32);
        let start = fit.leaves[3].clone();
        for step in 0..2 {
            fit.step(step, 2);
        }
        let moved = (fit.leaves[3].clone().inner() - start.inner())
            .abs()
            .sum_dim(1);
        assert!(
            values(moved).iter().all(|&m| m > 0.0),
            "{name}: a track was left out"
        );
    }
}

#[test]
fn wrong_cameras_are_refused() {
    let mut scene = two_movers(4, 3, 0.0);
    let init = initialize(
        &scene.tracks,
        &InitOptions {
            num_bases: 2,
            fewest: false,
            seed: 1,
        },
    )
    .unwrap();
    let error = |cameras: &[FitCamera]| FitData::new(&init, cameras).err();
    let expected = MotionError::Length {
        what: "cameras",
        found: 2,
        expected: 3,
    };
    assert_eq!(error(&scene.cameras[..2]), Some(expected));
    scene.cameras[1].cx = f64::NAN;
    assert_eq!(
        error(&scene.cameras),
        Some(MotionError::BadCamera { frame: 1 })
    );
    scene.cameras[1].cx = 0.0;
    scene.cameras[1].fx = 0.0;
    assert_eq!(
        error(&scene.cameras),
        Some(MotionError::BadCamera { frame: 1 })
    );
}

#[test]
fn the_fit_has_the_same_bits_with_one_thread_and_with_two() {
    for (name, device) in quick_devices() {
        let device = device.autodiff();
        let run = |threads| {
            in_pool(threads, || {
                let scene = two_movers(900, 12, 0.02);
                let init = initialize(
                    &scene.tracks,
                    &InitOptions {
                        num_bases: 8,
                        fewest: false,
                        seed: 4,
                    },
                )
                .unwrap();
                let mut fit = Fitting::new(&init, &scene.cameras, &device, DType::F32);
                for step in 0..8 {
                    fit.step(step, 8);
                }
                fit.positions()
            })
        };
        let (one, two, again) = (run(1), run(2), run(2));
        assert!(one == two && two == again, "{name}: the bits differ");
    }
}
