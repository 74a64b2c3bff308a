//! The splatting op against results and gradients that gsplat computed (`shared/reference/gsplat_tiny`,
//! read from beside the checkout; without it these tests say so and pass).

use std::path::PathBuf;

use burn::tensor::{DType, Device, Tensor, TensorData};
use glam::{DAffine3, DVec3};
use limpid_tests::{devices, skipped};
use safetensors::SafeTensors;
use splat_core::cpu::{BackwardOptions, Forward, SplatSlices, View, backward, project, rasterize};
use splat_core::{Camera, Extra, Splats, Viewpoint, render};

const WIDTH: usize = 123;
const HEIGHT: usize = 82;

struct Reference(Vec<u8>);

impl Reference {
    fn folder() -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/reference/gsplat_tiny")
    }

    /// `None`, with a message, when the reference is not beside the checkout.
    fn open(test: &str) -> Option<Self> {
        let path = Self::folder().join("tiny_case.safetensors");
        match std::fs::read(&path) {
            Ok(bytes) => Some(Self(bytes)),
            Err(error) => {
                skipped(test, &format!("{error}: {}", path.display()));
                None
            }
        }
    }

    fn get(&self, name: &str) -> Vec<f32> {
        let file = SafeTensors::deserialize(&self.0).expect("a safetensors file");
        file.tensor(name)
            .expect("a tensor of that name")
            .data()
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect()
    }
}

fn camera() -> Camera {
    Camera::pinhole([WIDTH, HEIGHT], [61.5, 61.5], [61.5, 41.0])
}

fn cam_from_world() -> DAffine3 {
    DAffine3::from_translation(-DVec3::new(0.123, 0.456, -8.0))
}

/// Relative L2 error, and the largest error relative to the largest entry.
fn errors(found: &[f32], expected: &[f32]) -> (f64, f64) {
    assert_eq!(found.len(), expected.len(), "lengths");
    let (mut square, mut norm, mut worst, mut largest) = (0.0, 0.0, 0.0_f64, 0.0_f64);
    for (a, b) in found.iter().zip(expected) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        square += (a - b) * (a - b);
        norm += b * b;
        worst = worst.max((a - b).abs());
        largest = largest.max(b.abs());
    }
    ((square / norm).sqrt(), worst / largest)
}

fn assert_gradient(name: &str, found: &[f32], expected: &[f32]) {
    let (l2, worst) = errors(found, expected);
    eprintln!("{name}: relative L2 {l2:.2e}, largest error {worst:.2e} of the largest entry");
    assert!(
        l2 < 1e-4 && worst < 1e-4,
        "{name}: relative L2 {l2:e}, largest {worst:e}"
    );
}

#[test]
fn slice_kernels_agree_with_gsplat() {
    let Some(reference) = Reference::open("slice_kernels_agree_with_gsplat") else {
        return;
    };
    let get = |name| reference.get(name);
    let (means, quats, log_scales) = (get("means"), get("quats"), get("scales"));
    let (opacity_logits, sh) = (get("opacities"), get("coeffs"));
    let splats = SplatSlices {
        means: &means,
        quats: &quats,
        left_rotations: &[],
        log_scales: &log_scales,
        opacity_logits: &opacity_logits,
        sh: &sh,
    };
    let view = View::new(&camera(), &cam_from_world(), 3);
    let projection = project(&splats, &view).unwrap();
    let raster = rasterize(&projection, &[], 0).unwrap();
    let expected = get("out_img");
    for (k, (found, expected)) in raster
        .output
        .chunks_exact(5)
        .zip(expected.chunks_exact(4))
        .enumerate()
    {
        for c in 0..4 {
            let error = (found[c] - expected[c]).abs();
            assert!(error < 1e-5, "pixel {k}, channel {c}: error {error:e}");
        }
    }

    let v_output: Vec<f32> = get("v_out_img")
        .chunks_exact(4)
        .flat_map(|v| [v[0], v[1], v[2], v[3], 0.0])
        .collect();
    // The reference's generator takes the direction in which SH are seen as a constant.
    let options = BackwardOptions {
        view_direction: false,
        ..BackwardOptions::default()
    };
    let forward = Forward {
        splats: &splats,
        projection: &projection,
        features: &[],
        state: &raster.state,
    };
    let g = backward(&forward, &v_output, options).unwrap();
    assert_gradient("means, direction constant", &g.means, &get("v_means"));
    assert_gradient("quats", &g.quats, &get("v_quats"));
    assert_gradient("log_scales", &g.log_scales, &get("v_scales"));
    assert_gradient("opacity_logits", &g.opacity_logits, &get("v_opacities"));
    assert_gradient("sh", &g.sh, &get("v_coeffs"));
    let screen: Vec<f32> = get("v_xy")
        .chunks_exact(2)
        .map(|v| (v[0] * 0.5 * WIDTH as f32).hypot(v[1] * 0.5 * HEIGHT as f32))
        .collect();
    assert_gradient("screen", &g.screen, &screen);
}

#[test]
fn tensors_agree_with_gsplat() {
    let Some(reference) = Reference::open("tensors_agree_with_gsplat") else {
        return;
    };
    for (name, device) in devices() {
        eprintln!("{name}");
        let device = device.autodiff();
        let leaf =
            |values: Vec<f32>, columns: usize| matrix(values, columns, &device).require_grad();
        let get = |name| reference.get(name);
        let splats = Splats {
            means: leaf(get("means"), 3),
            quats: leaf(get("quats"), 4),
            left_rotations: None,
            log_scales: leaf(get("scales"), 3),
            opacity_logits: leaf(get("opacities"), 1),
            sh: leaf(get("coeffs"), 48),
        };
        let screen = Tensor::<1>::zeros([4], (&device, DType::F32)).require_grad();
        let rendered = render(
            splats.clone(),
            &Viewpoint::new(&camera(), &cam_from_world(), 3, &splats),
            Extra {
                screen_grad: Some(screen.clone()),
                ..Extra::default()
            },
        )
        .unwrap();

        // mean((image - [crab, 0])²) over colour and alpha.
        let crab = image::open(Reference::folder().join("crab.png"))
            .unwrap()
            .to_rgb8();
        let target: Vec<f32> = crab
            .pixels()
            .flat_map(|p| [p.0[0], p.0[1], p.0[2], 0])
            .map(|v| f32::from(v) / 255.0)
            .collect();
        let target = Tensor::<3>::from_data(
            TensorData::new(target, [HEIGHT, WIDTH, 4]),
            (&device, DType::F32),
        );
        let image = rendered.output().clone().slice([0..HEIGHT, 0..WIDTH, 0..4]);
        let found: Vec<f32> = image.clone().into_data().iter().collect();
        for (k, (a, b)) in found.iter().zip(&get("out_img")).enumerate() {
            assert!((a - b).abs() < 1e-5, "entry {k} of the image: {a} and {b}");
        }
        let grads = (image - target).square().mean().backward();
        let gradient = |tensor: &Tensor<2>| -> Vec<f32> {
            tensor.grad(&grads).unwrap().into_data().iter().collect()
        };
        assert_gradient("quats", &gradient(&splats.quats), &get("v_quats"));
        assert_gradient(
            "log_scales",
            &gradient(&splats.log_scales),
            &get("v_scales"),
        );
        assert_gradient(
            "opacity_logits",
            &gradient(&splats.opacity_logits),
            &get("v_opacities"),
        );
        assert_gradient("sh", &gradient(&splats.sh), &get("v_coeffs"));
        // Here the path through the direction is in: a true derivative, which the reference's is not.
        let (l2, _) = errors(&gradient(&splats.means), &get("v_means"));
        assert!(
            l2 > 1e-4,
            "the means' path through the view direction is missing"
        );
        let screen: Vec<f32> = screen.grad(&grads).unwrap().into_data().iter().collect();
        let expected: Vec<f32> = get("v_xy")
            .chunks_exact(2)
            .map(|v| (v[0] * 0.5 * WIDTH as f32).hypot(v[1] * 0.5 * HEIGHT as f32))
            .collect();
        assert_gradient("screen", &screen, &expected);
    }
}

fn matrix(values: Vec<f32>, columns: usize, device: &Device) -> Tensor<2> {
    let rows = values.len() / columns;
    Tensor::from_data(
        TensorData::new(values, [rows, columns]),
        (device, DType::F32),
    )
}
