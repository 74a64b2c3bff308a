//! The blur model at its extremes.

use super::case::{Case, Results, scaled, weigh};
use crate::{tensor, unit_noise, values};
use bpnet::{BlurField, BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
use burn::tensor::{DType, activation::softmax};

/// The per-pixel blur: image, kernel logits and intensity to what the camera saw.
fn blur_case(
    name: &str,
    [height, width, k]: [usize; 3],
    image: Vec<f64>,
    logits: Vec<f64>,
    intensity: Vec<f64>,
) -> Case {
    let inputs = vec![image, logits, intensity];
    Case::new("blur", name, inputs, move |inputs, place| {
        let (device, dtype) = place.options();
        let image = tensor(&inputs[0], [height, width, 3], &device, dtype).require_grad();
        let logits = tensor(&inputs[1], [height, width, k * k], &device, dtype).require_grad();
        let intensity = tensor(&inputs[2], [height, width], &device, dtype).require_grad();
        let field =
            BlurField::new(softmax(logits.clone(), 2), intensity.clone()).expect("the shapes fit");
        let blurred = composite(image.clone(), &field)
            .expect("shapes that fit")
            .picture();
        let grads = weigh(blurred.clone(), 21).backward();
        Results {
            forward: vec![("picture", values(blurred))],
            backward: vec![
                ("image", values(image.grad(&grads).expect("used"))),
                ("kernel logits", values(logits.grad(&grads).expect("used"))),
                ("intensity", values(intensity.grad(&grads).expect("used"))),
            ],
        }
    })
}

/// BP-Net as a whole: its inputs to kernels and intensities, and gradients of some of its parameters.
fn net_case(name: &str, scale: f64, color: Vec<f64>, disparity: Vec<f64>, mask: Vec<f64>) -> Case {
    let (height, width) = (9, 12);
    let config = BpNetConfig {
        kernel_size: 5,
        num_frames: 2,
        shortcut: true,
        downscale: 1,
        head: HeadInit::Mild,
        seed: 3,
    };
    let inputs = vec![color, disparity, mask];
    Case::new("BP-Net", name, inputs, move |inputs, place| {
        let (device, dtype) = place.options();
        let mut net = BpNet::new(&config, &device, DType::F32).expect("a valid configuration");
        for (name, parameter) in net.parameters_mut() {
            let factor = if name.starts_with("head.") {
                scale
            } else {
                1.0
            };
            let entries: Vec<f64> = values(parameter.clone())
                .iter()
                .map(|v| f64::from((v * factor) as f32))
                .collect();
            *parameter = tensor(&entries, parameter.dims(), &device, dtype).require_grad();
        }
        let inputs = BlurInputs {
            color: tensor(&inputs[0], [height, width, 3], &device, dtype),
            disparity: tensor(&inputs[1], [height, width], &device, dtype),
            mask: tensor(&inputs[2], [height, width], &device, dtype),
        };
        let field = net
            .forward(1, &inputs, Extractor::Trained)
            .expect("shapes that fit");
        let loss = weigh(field.kernel(), 21) + weigh(field.intensity(), 21);
        let grads = loss.backward();
        Results {
            forward: vec![
                ("kernel", values(field.kernel())),
                ("intensity", values(field.intensity())),
            ],
            backward: net
                .parameters()
                .into_iter()
                .filter_map(|(name, p)| Some((name, values(p.grad(&grads)?))))
                .collect(),
        }
    })
}

pub(super) fn cases() -> Vec<Case> {
    let [h, w] = [6, 7];
    let image = |h: usize, w: usize| unit_noise(h * w * 3, 1);
    let logits = |h: usize, w: usize, k: usize, scale: f64| scaled(h * w * k * k, 2, scale, 0.0);
    let half = |h: usize, w: usize| vec![0.5; h * w];
    let delta = |k: usize, height: f64| -> Vec<f64> {
        let one = (0..k * k).map(|j| if j == k * k / 2 { height } else { 0.0 });
        one.collect::<Vec<_>>().repeat(h * w)
    };
    let mut cases = vec![
        blur_case(
            "ordinary",
            [h, w, 5],
            image(h, w),
            logits(h, w, 5, 1.0),
            half(h, w),
        ),
        blur_case(
            "uniform kernels",
            [h, w, 9],
            image(h, w),
            vec![0.0; h * w * 81],
            half(h, w),
        ),
        blur_case(
            "delta kernels",
            [h, w, 5],
            image(h, w),
            delta(5, 200.0),
            half(h, w),
        ),
        blur_case(
            "logits of 1e3 and -1e3",
            [h, w, 5],
            image(h, w),
            logits(h, w, 5, 1e3),
            half(h, w),
        ),
        blur_case(
            "m of 0",
            [h, w, 5],
            image(h, w),
            logits(h, w, 5, 1.0),
            vec![0.0; h * w],
        ),
        blur_case(
            "m of 1",
            [h, w, 5],
            image(h, w),
            logits(h, w, 5, 1.0),
            vec![1.0; h * w],
        ),
        blur_case(
            "kernels larger than the image",
            [2, 3, 15],
            image(2, 3),
            logits(2, 3, 15, 1.0),
            half(2, 3),
        ),
        blur_case(
            "an image of 1 x 1",
            [1, 1, 5],
            image(1, 1),
            logits(1, 1, 5, 1.0),
            half(1, 1),
        ),
        blur_case(
            "kernels of 1 x 1",
            [h, w, 1],
            image(h, w),
            logits(h, w, 1, 1.0),
            half(h, w),
        ),
        blur_case(
            "weights that leave the image",
            [1, 4, 15],
            image(1, 4),
            logits(1, 4, 15, 60.0),
            half(1, 4),
        ),
        blur_case(
            "colours of 1e6",
            [h, w, 5],
            scaled(h * w * 3, 1, 1e6, 0.0),
            logits(h, w, 5, 1.0),
            half(h, w),
        ),
    ];
    let pixels = 9 * 12;
    let net = |name: &str, scale: f64, color: f64, disparity: Vec<f64>, mask: f64| {
        let color = if color < 0.0 {
            unit_noise(pixels * 3, 3)
        } else {
            vec![color; pixels * 3]
        };
        net_case(name, scale, color, disparity, vec![mask; pixels])
    };
    let relief = || scaled(pixels, 4, 0.5, 1.0);
    cases.extend([
        net("ordinary", 1.0, -1.0, relief(), 0.0),
        net("a constant picture", 1.0, 0.5, vec![1.0; pixels], 0.0),
        net(
            "a black picture without depth",
            1.0,
            0.0,
            vec![0.0; pixels],
            1.0,
        ),
        net(
            "disparities of 1e4",
            1.0,
            -1.0,
            scaled(pixels, 4, 1e4, 0.0),
            0.0,
        ),
        net("a head that saturates", 1e3, -1.0, relief(), 1.0),
    ]);
    cases
}
