//! The blur model by itself, to be held against the same network in another framework.

use std::time::Instant;

use bpnet::{BlurInputs, BpNet, BpNetConfig, Extractor, HeadInit, composite};
use burn::tensor::{DType, Device, Tensor, TensorData};
use serde::Serialize;

use crate::workload::FRAMES;

/// Times of extractor, BP-Net and blur, forward and backward.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct NetTimes {
    /// Median, ms.
    pub median_ms: f64,
    /// Fastest, ms.
    pub fastest_ms: f64,
}

/// Times `repeats` passes after two, K = 9.
///
/// # Errors
/// The network refuses the size, or the device fails.
pub fn time_net(
    [width, height]: [usize; 2],
    extractor: Extractor,
    device: &Device,
    repeats: usize,
) -> Result<NetTimes, Box<dyn std::error::Error>> {
    let config = BpNetConfig {
        kernel_size: 9,
        num_frames: FRAMES,
        shortcut: true,
        downscale: 1,
        head: HeadInit::Mild,
        seed: 1,
    };
    let device = device.clone().autodiff();
    let net = BpNet::new(&config, &device, DType::F32)?;
    let values = |channels: usize| -> Tensor<3> {
        let values: Vec<f32> = (0..width * height * channels)
            .map(|i| (i * 7919 % 10_007) as f32 / 10_007.0)
            .collect();
        Tensor::from_data(
            TensorData::new(values, [height, width, channels]),
            (&device, DType::F32),
        )
    };
    let inputs = BlurInputs {
        color: values(3),
        disparity: values(1).squeeze_dim(2),
        mask: values(1).squeeze_dim(2),
    };
    let mut times = Vec::new();
    for pass in 0..repeats + 2 {
        let image = values(3).require_grad();
        device.sync()?;
        let start = Instant::now();
        let field = net.forward(1, &inputs, extractor)?;
        let blurred = composite(image.clone(), &field)?;
        let grads = blurred.picture().sum().backward();
        device.sync()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
        // Where a device's memory was short, kernels were skipped, and only who reads is told.
        if pass == 0 || pass == repeats + 1 {
            for (_, parameter) in net.parameters() {
                if let Some(gradient) = parameter.grad(&grads) {
                    gradient.sum().try_into_data()?;
                }
            }
        }
    }
    let mut times = times.split_off(2);
    times.sort_by(f64::total_cmp);
    Ok(NetTimes {
        median_ms: times[times.len() / 2],
        fastest_ms: times[0],
    })
}
