//! The camera as a blur model: what it did is found back from one picture that was taken so.

use burn::tensor::{DType, Tensor};
use capture::{Capture, samples};
use limpid_tests::wall::splats;
use limpid_tests::{largest, quick_devices, tensor, values};
use splat_core::{Camera, Exposure, Splats, Transfer, Viewpoint, expose};
use trainer::adam::{AdamState, AdamStep, LearningRate, adam_step};

const SIZE: f64 = 4.0;
const FOCAL: f64 = 60.0;

/// The picture that a camera takes at the origin.
fn picture(capture: &Capture, splats: &Splats, count: usize, turn: f64) -> Tensor<3> {
    let given = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ];
    let options = (&splats.means.device(), DType::F32);
    let given = Tensor::<2>::from_data(given, options);
    let view = Viewpoint {
        camera: Camera::pinhole([56, 40], [FOCAL; 2], [28.0, 20.0]),
        cam_from_world: given.clone(),
        sh_degree: 0,
    };
    let exposure = Exposure {
        poses: capture.poses(0, &given, &samples(count, turn), SIZE),
        movers: None,
        transfer: Transfer::Srgb,
    };
    expose(splats.clone(), &view, exposure, None)
        .expect("a picture")
        .color
}

#[test]
fn path_focus_and_aperture_are_found_back() {
    for (name, device) in quick_devices() {
        let device = device.autodiff();
        let f32s = |values: &[f64], shape| tensor(values, shape, &device, DType::F32);
        let splats = splats(&device);
        let mut path = [0.0; 12];
        path[..2].copy_from_slice(&[0.02, 0.04]);
        path[6..8].copy_from_slice(&[-0.03, 0.05]);
        let (aperture, focus) = (0.04, 1.5);
        let mut truth = Capture::still(1, 2, (&device, DType::F32));
        truth.paths = f32s(&path, [1, 12]);
        truth.aperture = f32s(&[aperture], [1, 1]);
        truth.focus = f32s(&[focus], [1, 1]);
        let target = picture(&truth, &splats, 96, 0.2).detach();

        // Half the aperture, in focus elsewhere, a short path in another direction.
        let mut found = Capture::still(1, 2, (&device, DType::F32));
        let mut start = [0.0; 12];
        start[1] = 0.015;
        found.paths = f32s(&start, [1, 12]).require_grad();
        found.aperture = f32s(&[0.5 * aperture], [1, 1]).require_grad();
        found.focus = f32s(&[1.2], [1, 1]).require_grad();
        // What turns around the axis or moves along it is no question here: rotations alone are learned.
        let rates: Vec<f64> = (0..12)
            .map(|k| if k % 6 < 2 { 2e-3 } else { 0.0 })
            .collect();
        let mut states = [&found.paths, &found.aperture, &found.focus].map(AdamState::new);
        let steps = 300;
        for it in 0..steps {
            let turn = (0.755 * f64::from(it)).fract();
            let seen = picture(&found, &splats, 32, turn);
            let mut grads = (seen - target.clone()).square().mean().backward();
            let share = 0.02_f64.powf(f64::from(it) / f64::from(steps));
            let scaled = |rates: &[f64]| {
                LearningRate::PerColumn(rates.iter().map(|rate| rate * share).collect())
            };
            let rates = [scaled(&rates), scaled(&[2e-3]), scaled(&[3e-2])];
            let all = [&mut found.paths, &mut found.aperture, &mut found.focus];
            for ((tensor, state), rate) in all.into_iter().zip(&mut states).zip(&rates) {
                let grad = tensor.grad_remove(&mut grads).expect("a gradient");
                adam_step(tensor, grad, state, &AdamStep { rate, drawn: &[] });
            }
        }
        let learned = values(found.paths.clone());
        let place =
            |path: &[f64], s: f64| [0, 1].map(|k| FOCAL * (path[k] * s + path[6 + k] * s * s));
        // Both ways round are the same picture: a path has no direction where nothing moves.
        let error = |sign: f64| {
            let moments = [-0.5, -0.25, 0.25, 0.5];
            largest(moments.into_iter().map(|s| {
                let (a, b) = (place(&path, s), place(&learned, sign * s));
                (a[0] - b[0]).hypot(a[1] - b[1])
            }))
        };
        let worst = error(1.0).min(error(-1.0));
        assert!(
            worst < 0.1,
            "{name}: the path is off by {worst} px: {learned:?}"
        );
        let [a, f] = [&found.aperture, &found.focus].map(|t| values(t.clone())[0]);
        assert!(
            (a.abs() / aperture - 1.0).abs() < 0.03,
            "{name}: aperture {a}"
        );
        assert!((f / focus - 1.0).abs() < 0.03, "{name}: focus {f}");
    }
}
