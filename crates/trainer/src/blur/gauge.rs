//! The blur's gauge: a common shift of all kernels hides in the scene, so its mean over all frames is held at zero.

use burn::tensor::{Device, Tensor, TensorData};

/// The kernels' mean shift per cell of the picture, as of each training frame's last visit.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Gauge {
    /// Rows and columns of cells.
    pub(crate) cells: [usize; 2],
    /// Mean of m Σ k Δx per cell (px; x, y), one vector per frame; empty before the frame's first visit.
    pub(crate) shifts: Vec<Vec<f32>>,
}

impl Gauge {
    pub(crate) fn new(cells: [usize; 2], num_frames: usize) -> Self {
        Self {
            cells,
            shifts: vec![Vec::new(); num_frames],
        }
    }

    /// The penalty of a frame's live shifts [rows · columns, 2].
    ///
    /// c is the mean over the frames seen so far, live for this frame and of their last visit for the
    /// others. The penalty is the number of frames times the mean over cells and axes of c²: the
    /// factor makes up for the live frame's share of 1 / frames, so that the pull on a frame does not
    /// depend on how many there are.
    pub(crate) fn penalty(&self, frame: usize, live: Tensor<2>) -> Tensor<1> {
        let (device, dtype, shape) = (live.device(), live.dtype(), live.dims());
        let mut others = vec![0.0_f32; shape[0] * shape[1]];
        let mut seen = 1;
        for (_, shifts) in self
            .shifts
            .iter()
            .enumerate()
            .filter(|(i, s)| *i != frame && !s.is_empty())
        {
            seen += 1;
            for (sum, value) in others.iter_mut().zip(shifts) {
                *sum += value;
            }
        }
        let others = Tensor::<2>::from_data(TensorData::new(others, shape), (&device, dtype));
        let mean = (live + others).div_scalar(seen as f64);
        mean.powi_scalar(2).mean().mul_scalar(seen as f64)
    }

    /// Keeps a frame's shifts for the frames that come after it.
    pub(crate) fn record(&mut self, frame: usize, shifts: Vec<f32>) {
        self.shifts[frame] = shifts;
    }

    /// The table as one matrix [frames, 1 + 2 · cells] for a checkpoint; the first column says whether a frame was seen.
    pub(crate) fn to_tensor(&self, device: &Device) -> Tensor<2> {
        let width = 1 + 2 * self.cells[0] * self.cells[1];
        let mut values = Vec::with_capacity(self.shifts.len() * width);
        for shifts in &self.shifts {
            values.push(if shifts.is_empty() { 0.0 } else { 1.0 });
            values.extend(shifts);
            values.resize(values.len().next_multiple_of(width), 0.0);
        }
        crate::tensors::tensor(values, [self.shifts.len(), width], device)
    }

    /// The inverse of [`Self::to_tensor`].
    pub(crate) fn from_tensor(cells: [usize; 2], tensor: Tensor<2>) -> Self {
        let [frames, width] = tensor.dims();
        let values = crate::tensors::host(tensor);
        let mut gauge = Self::new(cells, frames);
        for (shifts, row) in gauge.shifts.iter_mut().zip(values.chunks_exact(width)) {
            if row[0] > 0.5 {
                *shifts = row[1..].to_vec();
            }
        }
        gauge
    }
}
