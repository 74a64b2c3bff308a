//! Numbers that come back from the device all at once.

use crate::TrainError;
use burn::tensor::Tensor;
use std::ops::Range;

/// Tensors of one device and dtype that are read together, so that the device is waited for once.
#[derive(Default)]
pub(crate) struct Readings {
    tensors: Vec<Tensor<1>>,
    length: usize,
}

impl Readings {
    /// Says where the values of a tensor will be.
    pub(crate) fn add(&mut self, tensor: Tensor<1>) -> Range<usize> {
        let from = self.length;
        self.length += tensor.dims()[0];
        self.tensors.push(tensor.inner());
        from..self.length
    }

    /// The values of all.
    ///
    /// # Errors
    /// The device fails.
    pub(crate) fn read(self) -> Result<Vec<f64>, TrainError> {
        let values = host::try_read(Tensor::cat(self.tensors, 0));
        let values = values.map_err(|reason| TrainError::Device { reason })?;
        Ok(values.iter().collect())
    }
}
