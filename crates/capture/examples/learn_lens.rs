//! Finds focus and aperture of a lens back from where the light of three points fell.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]
use burn::tensor::{DType, Device, Tensor};
use capture::{Capture, samples};

/// Where 16 samples of a frame see points at three depths: x / z and y / z, [3, 16, 2].
fn seen(capture: &Capture, device: &Device) -> Tensor<3> {
    let given = Tensor::eye(4, device).narrow(0, 0, 3);
    let poses = capture.poses(0, &given, &samples(16, 0.0), 3.0);
    let points = [0.1, 0.2, 2.0, 1.0, -0.3, 0.1, 3.0, 1.0, 0.4, -0.5, 5.0, 1.0];
    let points = Tensor::<1>::from_data(points, device).reshape([3, 1, 1, 4]);
    let at = (poses.unsqueeze_dim::<4>(0) * points).sum_dim(3);
    let at = at.reshape([3, 16, 3]);
    at.clone().narrow(2, 0, 2) / at.narrow(2, 2, 1)
}

fn main() {
    let device = &Device::flex().autodiff();
    let number = |value: f64| Tensor::<2>::from_data([[value]], device);
    let mut lens = Capture::still(1, 1, (device, DType::F32));
    (lens.focus, lens.aperture) = (number(1.4), number(0.05));
    let places = seen(&lens, device);
    (lens.focus, lens.aperture) = (number(1.0), number(0.02));
    for step in 0..=300 {
        lens.focus = lens.focus.require_grad();
        lens.aperture = lens.aperture.require_grad();
        let loss = (seen(&lens, device) - places.clone()).square().mean();
        println!("step {step}: loss {}", loss.clone().into_scalar::<f32>());
        let grads = loss.backward();
        for (tensor, rate) in [(&mut lens.focus, 2e-2), (&mut lens.aperture, 1e-3)] {
            let slope = tensor.grad(&grads).expect("a leaf").sign();
            let fitted = tensor.clone().inner() - slope * (rate * 0.985_f64.powi(step));
            *tensor = fitted.autodiff();
        }
    }
    println!("focus {}, aperture {}", lens.focus, lens.aperture);
}
