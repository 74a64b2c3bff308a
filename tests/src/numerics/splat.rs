//! The splatting ops at their extremes: renders, and exposures of the same Gaussians.

use super::case::{Case, Place, Results, scaled};
use super::splat_tensors::{self, SAMPLES, WEIGHTS};
use crate::noise;
use splat_core::Camera;
use splat_core::cpu::{
    BackwardOptions, Exposure, Float, Forward, SplatSlices, Transfer, View, backward, expose,
    expose_backward, project, rasterize,
};

/// Inputs of a render.
#[derive(Clone)]
struct Input {
    means: Vec<f64>,
    quats: Vec<f64>,
    /// For the first two Gaussians, where there are two.
    left_rotations: Vec<f64>,
    log_scales: Vec<f64>,
    opacity_logits: Vec<f64>,
    sh: Vec<f64>,
    features: Vec<f64>,
    pose: Vec<f64>,
    camera: Camera,
}

/// The near plane, a number that f32 holds.
const NEAR: f64 = 1.0 / 128.0;

/// `n` ordinary Gaussians in front of a slightly turned camera.
fn ordinary(n: usize) -> Input {
    let mut means = scaled(3 * n, 1, 0.8, 0.0);
    means.iter_mut().skip(2).step_by(3).for_each(|z| *z += 3.0);
    let mut left_rotations = scaled(9 * n.min(2), 2, 0.2, 0.0);
    for rotation in left_rotations.chunks_exact_mut(9) {
        (0..3).for_each(|k| rotation[4 * k] += 1.0);
    }
    let (s, c) = 0.1_f64.sin_cos();
    let mut sh = scaled(n * 48, 3, 0.1, 0.0);
    sh.chunks_exact_mut(48)
        .for_each(|row| row[..3].iter_mut().for_each(|v| *v += 1.0));
    Input {
        means,
        quats: scaled(4 * n, 4, 1.3, 0.1),
        left_rotations,
        log_scales: scaled(3 * n, 5, 0.3, -1.2),
        opacity_logits: scaled(n, 6, 1.0, 0.5),
        sh,
        features: noise(n, 7),
        pose: vec![c, 0.0, s, 0.1, 0.0, 1.0, 0.0, -0.2, -s, 0.0, c, 0.3],
        camera: Camera::pinhole([33, 21], [30.0, 28.0], [15.5, 11.0]).with_near(NEAR),
    }
}

/// A camera at the origin that looks along z.
fn level(input: &mut Input) {
    input.pose = vec![1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
}

fn render<T: Float>(inputs: &[Vec<f64>], camera: &Camera) -> Results {
    let cast = |k: usize| -> Vec<T> { inputs[k].iter().map(|v| T::from_f64(*v)).collect() };
    let arrays: Vec<Vec<T>> = (0..7).map(cast).collect();
    let splats = SplatSlices {
        means: &arrays[0],
        quats: &arrays[1],
        left_rotations: &arrays[2],
        log_scales: &arrays[3],
        opacity_logits: &arrays[4],
        sh: &arrays[5],
    };
    let view = View {
        camera: camera.clone(),
        cam_from_world: std::array::from_fn(|k| inputs[7][k]),
        sh_degree: 3,
    };
    let projection = project(&splats, &view).expect("finite input");
    let raster = rasterize(&projection, &arrays[6], 1).expect("finite features");
    let weights: Vec<T> = noise(raster.output.len(), WEIGHTS)
        .into_iter()
        .map(|v| T::from_f64(f64::from(v as f32)))
        .collect();
    let forward = Forward {
        splats: &splats,
        projection: &projection,
        features: &arrays[6],
        state: &raster.state,
    };
    let g = backward(&forward, &weights, BackwardOptions::default()).expect("a gradient");
    let wide = |v: &[T]| -> Vec<f64> { v.iter().map(|v| (*v).into()).collect() };
    Results {
        forward: vec![
            ("colour", raster.color().flatten().map(T::into).collect()),
            ("alpha", raster.alpha().map(T::into).collect()),
            ("depth", raster.depth().map(T::into).collect()),
            ("feature", raster.features().flat_map(wide).collect()),
        ],
        backward: vec![
            ("means", wide(&g.means)),
            ("quats", wide(&g.quats)),
            ("left_rotations", wide(&g.left_rotations)),
            ("log_scales", wide(&g.log_scales)),
            ("opacity_logits", wide(&g.opacity_logits)),
            ("sh", wide(&g.sh)),
            ("features", wide(&g.features)),
            ("pose", wide(&g.cam_from_world)),
        ],
    }
}

fn case(name: &str, input: Input) -> Case {
    let camera = input.camera;
    let inputs = vec![
        input.means,
        input.quats,
        input.left_rotations,
        input.log_scales,
        input.opacity_logits,
        input.sh,
        input.features,
        input.pose,
    ];
    Case::new(
        "splatting",
        name,
        inputs,
        move |inputs, place| match place {
            Place::F32 => render::<f32>(inputs, &camera),
            Place::F64 => render::<f64>(inputs, &camera),
            Place::Device(_) => splat_tensors::render(inputs, &camera, place),
        },
    )
}

fn exposed<T: Float>(inputs: &[Vec<f64>], camera: &Camera) -> Results {
    let cast = |k: usize| -> Vec<T> { inputs[k].iter().map(|v| T::from_f64(*v)).collect() };
    let arrays: Vec<Vec<T>> = (0..9).map(cast).collect();
    let middle = View {
        camera: camera.clone(),
        cam_from_world: std::array::from_fn(|k| inputs[5][k]),
        sh_degree: 3,
    };
    let exposure = Exposure {
        splats: SplatSlices {
            means: &arrays[0],
            quats: &arrays[1],
            left_rotations: &[],
            log_scales: &arrays[2],
            opacity_logits: &arrays[3],
            sh: &arrays[4],
        },
        middle: &middle,
        poses: &arrays[6],
        moving_means: &arrays[7],
        left_rotations: &arrays[8],
        transfer: Transfer::Srgb,
    };
    let picture = expose(&exposure).expect("finite input");
    let weights: Vec<T> = noise(picture.color.len(), WEIGHTS)
        .into_iter()
        .map(|v| T::from_f64(f64::from(v as f32)))
        .collect();
    let g = expose_backward(&exposure, &picture.state, &weights, true).expect("a gradient");
    let wide = |v: &[T]| -> Vec<f64> { v.iter().map(|v| (*v).into()).collect() };
    Results {
        forward: vec![("colour", wide(&picture.color))],
        backward: vec![
            ("means", wide(&g.middle.means)),
            ("quats", wide(&g.middle.quats)),
            ("log_scales", wide(&g.middle.log_scales)),
            ("opacity_logits", wide(&g.middle.opacity_logits)),
            ("sh", wide(&g.middle.sh)),
            ("pose", wide(&g.middle.cam_from_world)),
            ("poses", wide(&g.poses)),
            ("moving_means", wide(&g.moving_means)),
            ("left_rotations", wide(&g.left_rotations)),
        ],
    }
}

/// The same Gaussians while the camera moves by half a pixel or so from sample to sample and the first two Gaussians by a
/// hundredth of a unit.
fn exposed_case(name: &str, input: Input) -> Case {
    let camera = input.camera;
    let steps = (0..SAMPLES).map(|i| i as f64 - 1.0);
    let poses = steps.clone().flat_map(|step| {
        let mut pose = input.pose.clone();
        pose[3] += step / camera.fx;
        pose[7] -= 0.5 * step / camera.fy;
        pose
    });
    let moving = &input.means[..input.left_rotations.len() / 3];
    let moving_means = steps.flat_map(|step| moving.iter().map(move |v| v + 0.01 * step));
    let inputs = vec![
        input.means.clone(),
        input.quats,
        input.log_scales,
        input.opacity_logits,
        input.sh,
        input.pose.clone(),
        poses.collect(),
        moving_means.collect(),
        input.left_rotations.repeat(SAMPLES),
    ];
    Case::new("exposing", name, inputs, move |inputs, place| match place {
        Place::F32 => exposed::<f32>(inputs, &camera),
        Place::F64 => exposed::<f64>(inputs, &camera),
        Place::Device(_) => splat_tensors::expose(inputs, &camera, place),
    })
}

pub(super) fn cases() -> Vec<Case> {
    let inputs = inputs();
    let renders = inputs.iter().map(|(name, input)| case(name, input.clone()));
    let exposures = inputs
        .iter()
        .map(|(name, input)| exposed_case(name, input.clone()));
    renders.chain(exposures).collect()
}

/// Inputs by name.
fn inputs() -> Vec<(String, Input)> {
    let edited = |name: &str, n: usize, edit: &dyn Fn(&mut Input)| {
        let mut input = ordinary(n);
        edit(&mut input);
        (name.to_owned(), input)
    };
    let plain = |name: &str, edit: &dyn Fn(&mut Input)| edited(name, 6, edit);
    let quats_of_norm = |norm: f64| {
        move |i: &mut Input| {
            for q in i.quats.chunks_exact_mut(4) {
                let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
                q.iter_mut().for_each(|v| *v *= norm / length);
            }
        }
    };
    let mean_at = |x: f64, y: f64, z: f64| {
        move |i: &mut Input| {
            level(i);
            // Of the Gaussians without a left rotation, so that it is the mean in the world.
            i.means[6..9].copy_from_slice(&[x, y, z]);
        }
    };
    let sized = |width: usize, height: usize| {
        move |i: &mut Input| {
            let (cx, cy) = (width as f64 / 2.0, height as f64 / 2.0);
            i.camera = Camera::pinhole([width, height], [30.0, 28.0], [cx, cy]).with_near(NEAR);
        }
    };
    vec![
        plain("ordinary", &|_| {}),
        plain("scales of 1e-8", &|i| i.log_scales.fill(1e-8_f64.ln())),
        plain("scales of 1e4", &|i| i.log_scales.fill(1e4_f64.ln())),
        plain("anisotropy of 1e6, needles", &|i| {
            for s in i.log_scales.chunks_exact_mut(3) {
                s.copy_from_slice(&[0.0, 1e-6_f64.ln(), 1e-6_f64.ln()]);
            }
        }),
        plain("anisotropy of 1e6, wide sheets", &|i| {
            for s in i.log_scales.chunks_exact_mut(3) {
                s.copy_from_slice(&[100.0_f64.ln(), 100.0_f64.ln(), 1e-4_f64.ln()]);
            }
        }),
        plain("opacity logits of -40", &|i| i.opacity_logits.fill(-40.0)),
        plain("opacity logits of 40", &|i| i.opacity_logits.fill(40.0)),
        plain("quaternions of norm 0", &quats_of_norm(0.0)),
        plain("quaternions of norm 1e-20", &quats_of_norm(1e-20)),
        plain("quaternions of norm 1e20", &quats_of_norm(1e20)),
        plain("a mean on the camera's centre", &mean_at(0.0, 0.0, 0.0)),
        plain("a mean on the near plane", &mean_at(0.001, 0.0, NEAR)),
        plain(
            "a mean just behind the near plane's other side",
            &mean_at(0.01, 0.02, 2.0 * NEAR),
        ),
        plain("a mean behind the camera", &mean_at(0.1, 0.1, -2.0)),
        plain("a mean at 1e6 ahead, as large as it is far", &|i| {
            mean_at(1e5, -5e4, 1e6)(i);
            i.log_scales[6..9].fill(1e5_f64.ln());
        }),
        plain("a mean at 1e6 to the side", &mean_at(1e6, 0.0, 3.0)),
        plain("scene and camera at 1e6", &|i| {
            level(i);
            i.means
                .iter_mut()
                .skip(2)
                .step_by(3)
                .for_each(|z| *z += 1e6);
            i.pose[11] = -1e6;
        }),
        plain("focal length of 1 px", &|i| {
            i.camera = Camera::pinhole([33, 21], [1.0, 1.0], [16.5, 10.5]).with_near(NEAR);
        }),
        plain("focal length of 1e5 px", &|i| {
            level(i);
            i.camera = Camera::pinhole([33, 21], [1e5, 1e5], [16.5, 10.5]).with_near(NEAR);
            for m in i.means.chunks_exact_mut(3) {
                (m[0], m[1]) = (m[0] * 3e-4, m[1] * 3e-4);
            }
            i.log_scales.iter_mut().for_each(|s| *s += 1e-4_f64.ln());
        }),
        plain("an image of 1 x 1", &sized(1, 1)),
        plain("an image of 1 x 40", &sized(1, 40)),
        plain("an image of 40 x 1", &sized(40, 1)),
        plain("an image of 17 x 33", &sized(17, 33)),
        edited("no Gaussian", 0, &|_| {}),
        edited("one Gaussian", 1, &|_| {}),
        plain("identical depths", &|i| {
            level(i);
            i.means.iter_mut().skip(2).step_by(3).for_each(|z| *z = 3.0);
        }),
        edited("transmittance that underflows", 400, &|i| {
            level(i);
            for (k, m) in i.means.chunks_exact_mut(3).enumerate() {
                m.copy_from_slice(&[0.0, 0.0, 2.0 + 0.01 * k as f64]);
            }
            i.log_scales.fill(0.0);
            i.opacity_logits.fill(3.0);
        }),
        edited("100,000 in one tile", 100_000, &|i| {
            level(i);
            for (k, m) in i.means.chunks_exact_mut(3).enumerate() {
                m[2] = 2.0 + 1e-4 * k as f64;
            }
            i.camera = Camera::pinhole([16, 16], [16.0, 16.0], [8.0, 8.0]).with_near(NEAR);
            // So wide that alpha is the same at every pixel, far above the threshold, and all stop early at one Gaussian.
            i.log_scales.fill(12.0);
            i.opacity_logits.fill(-4.0);
        }),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{property, uniform};
    use arbtest::arbitrary::{Result, Unstructured};

    /// One of the extremes, or an ordinary number from -1 to 1.
    fn pick(u: &mut Unstructured<'_>, extremes: &[f64]) -> Result<f64> {
        let place = uniform(u, 0.0, 2.0 * extremes.len() as f64)? as usize;
        match extremes.get(place) {
            Some(extreme) => Ok(*extreme),
            None => uniform(u, -1.0, 1.0),
        }
    }

    fn fill(u: &mut Unstructured<'_>, values: &mut [f64], extremes: &[f64]) -> Result<()> {
        for v in values {
            *v = pick(u, extremes)?;
        }
        Ok(())
    }

    #[test]
    fn any_mixture_of_extremes_stays_finite() {
        property("mixtures of extremes", 4000, |u| {
            let count = uniform(u, 0.0, 13.0)? as usize;
            let mut i = ordinary(count);
            let ln = f64::ln;
            fill(
                u,
                &mut i.means,
                &[0.0, NEAR, -1.0, 3.0, 1e6, -1e6, 1e-30, 1e18],
            )?;
            fill(u, &mut i.quats, &[0.0, 1e-20, 1e20, -1e20, 1e-38, 1e38])?;
            fill(u, &mut i.left_rotations, &[0.0, 1.0, -1.0])?;
            fill(
                u,
                &mut i.log_scales,
                &[ln(1e-8), ln(1e4), ln(1e-3), -80.0, 80.0, -1e4, 1e4],
            )?;
            fill(u, &mut i.opacity_logits, &[40.0, -40.0, 1e4, -1e4, 5.0])?;
            fill(u, &mut i.sh, &[0.0, 1e6, -1e6, 1e30])?;
            fill(u, &mut i.features, &[0.0, 1e6, -1e6])?;
            let sides = [1, 2, 15, 16, 17, 33];
            let side = |u: &mut Unstructured<'_>| Ok(sides[uniform(u, 0.0, 5.9)? as usize]);
            let (width, height) = (side(u)?, side(u)?);
            let focal = [1.0, 30.0, 1e5][uniform(u, 0.0, 2.9)? as usize];
            let (cx, cy) = (uniform(u, -50.0, 50.0)?, 0.5 * height as f64);
            i.camera = Camera::pinhole([width, height], [focal, 30.0], [cx, cy]).with_near(NEAR);
            for case in [case("mixture", i.clone()), exposed_case("mixture", i)] {
                for place in [Place::F32, Place::F64] {
                    let results = (case.run)(&case.inputs, &place);
                    for (name, values) in results.forward.iter().chain(&results.backward) {
                        let at = values.iter().position(|v| !v.is_finite());
                        assert!(at.is_none(), "{case:?}, {place:?}: {name} at {at:?}");
                    }
                }
            }
            Ok(())
        });
    }
}
