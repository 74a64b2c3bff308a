//! Blurs a picture, and learns the kernel back from the sharp and the blurry one.
#![allow(clippy::print_stdout, reason = "an example prints what it finds")]

use bpnet::{BpNetError, blur};
use burn::tensor::{Device, Distribution, Tensor, activation::softmax};

/// The same kernel [1, 9] at every pixel.
fn everywhere(kernel: Tensor<2>) -> Tensor<3> {
    kernel.unsqueeze::<3>().expand([24, 32, 9])
}

fn main() -> Result<(), BpNetError> {
    let device = Device::flex().autodiff();
    device.seed(1);
    let sharp = Tensor::<3>::random([24, 32, 3], Distribution::Default, &device);
    // Light from the upper right, and some from the left.
    let truth = [[0.0, 0.0, 0.3, 0.2, 0.5, 0.0, 0.0, 0.0, 0.0]];
    let truth = Tensor::<2>::from_data(truth, &device);
    let blurry = blur(sharp.clone(), everywhere(truth.clone()))?;

    let mut logits = Tensor::<2>::zeros([1, 9], &device).require_grad();
    for step in 0..=300 {
        let guess = blur(sharp.clone(), everywhere(softmax(logits.clone(), 1)))?;
        let loss = (guess - blurry.clone()).square().mean();
        if step % 100 == 0 {
            println!("step {step}: loss {:?}", loss.clone().into_scalar::<f32>());
        }
        let gradient = logits.grad(&loss.backward()).expect("a leaf has one");
        let stepped = logits.inner() - gradient * 100.0;
        logits = stepped.autodiff().require_grad();
    }
    let off = (softmax(logits, 1) - truth).abs().max();
    println!("largest error of a weight: {}", off.into_scalar::<f32>());
    Ok(())
}
