//! What training frames are compared with, as tensors.

use burn::tensor::{DType, Device, Tensor, TensorData};
use std::sync::OnceLock;

/// What of a training frame is on a GPU: each part is sent there when it is looked at first, and stays.
#[derive(Debug, Default)]
pub(crate) struct Sent {
    pub(crate) image: OnceLock<Tensor<3>>,
    pub(crate) depth: OnceLock<Tensor<2>>,
    pub(crate) points: OnceLock<Tensor<2>>,
    pub(crate) mask: OnceLock<Tensor<2>>,
}

/// Bytes of a GPU's memory that frames may take: those for which there is no room are sent anew each time.
const ROOM: usize = 1 << 30;
/// Numbers of a pixel: a colour, a depth, the sparse points' and a mask.
const NUMBERS: usize = 6;

impl Sent {
    /// Of the first of so many frames, as far as there is room; of none where tensors live in main memory, as the frames do.
    pub(crate) fn to(device: &Device, frames: usize, pixels: usize) -> Vec<Self> {
        if !crate::gpu::is_gpu(device) {
            return Vec::new();
        }
        let room = ROOM / (NUMBERS * size_of::<f32>() * pixels.max(1));
        (0..frames.min(room)).map(|_| Self::default()).collect()
    }
}

/// A tensor with the device, dtype and kind of another, from values that `kept` holds from then on.
pub(crate) fn on_device<const D: usize, const E: usize>(
    kept: Option<&OnceLock<Tensor<D>>>,
    like: &Tensor<E>,
    shape: [usize; D],
    values: impl FnOnce() -> Vec<f32>,
) -> Tensor<D> {
    let options: (&Device, DType) = (&like.device().inner(), like.dtype());
    let make = || Tensor::from_data(TensorData::new(values(), shape), options);
    let tensor = match kept {
        Some(kept) => kept.get_or_init(make).clone(),
        None => make(),
    };
    if like.is_autodiff() {
        Tensor::from_inner(tensor)
    } else {
        tensor
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_is_made_once_for_tensors_with_a_graph_and_without() {
        let device = Device::flex();
        let plain = Tensor::<1>::zeros([1], (&device, DType::F32));
        let tracked = Tensor::<1>::zeros([1], (&device.autodiff(), DType::F32)).require_grad();
        let sent = Sent::default();
        let mut made = 0;
        for _ in 0..2 {
            for like in [&plain, &tracked] {
                let mask = on_device(Some(&sent.mask), like, [1, 2], || {
                    made += 1;
                    vec![0.25, 1.0]
                });
                assert_eq!(mask.is_autodiff(), like.is_autodiff());
                let values = mask.try_into_vec_as::<f64>().expect("f32");
                assert_eq!(values, [0.25, 1.0]);
            }
        }
        assert_eq!(made, 1);
    }

    #[test]
    fn main_memory_holds_no_frame_twice() {
        assert!(Sent::to(&Device::flex(), 24, 100).is_empty());
    }
}
