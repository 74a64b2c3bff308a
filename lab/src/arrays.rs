//! Arrays of real numbers, in npy's format.

use crate::error::LabError;
use half::f16;
use npyz::{NpyFile, Order, WriterBuilder as _};
use std::fs;
use std::path::Path;

/// An array as f32, row-major.
#[derive(Debug)]
pub(crate) struct Array {
    pub(crate) shape: Vec<u64>,
    pub(crate) values: Vec<f32>,
}

impl Array {
    /// An array of f16, f32 or f64.
    pub(crate) fn read(path: &Path) -> Result<Self, LabError> {
        Self::parse(&fs::read(path).map_err(LabError::file(path))?, path)
    }

    /// See [`Array::read`]; `path` is for messages.
    pub(crate) fn parse(bytes: &[u8], path: &Path) -> Result<Self, LabError> {
        let open = || NpyFile::new(bytes).map_err(LabError::file(path));
        let file = open()?;
        if file.order() != Order::C {
            return Err(LabError::content(path, "an array that is not row-major"));
        }
        let shape = file.shape().to_vec();
        let values: Result<Vec<f32>, _> = if let Ok(data) = file.try_data::<f32>() {
            data.collect()
        } else if let Ok(data) = open()?.try_data::<f16>() {
            data.map(|value| value.map(f32::from)).collect()
        } else if let Ok(data) = open()?.try_data::<f64>() {
            data.map(|value| value.map(|v| v as f32)).collect()
        } else {
            return Err(LabError::content(path, "no array of f16, f32 or f64"));
        };
        let values = values.map_err(LabError::file(path))?;
        Ok(Self { shape, values })
    }

    /// The bytes of its file, f32; `path` is for messages.
    pub(crate) fn bytes(&self, path: &Path) -> Result<Vec<u8>, LabError> {
        let mut out = Vec::new();
        let options = npyz::WriteOptions::new().default_dtype().shape(&self.shape);
        let written = options.writer(&mut out).begin_nd().and_then(|mut writer| {
            writer.extend(self.values.iter().copied())?;
            writer.finish()
        });
        written.map_err(LabError::file(path))?;
        Ok(out)
    }

    /// Writes it as f32.
    pub(crate) fn write(&self, path: &Path) -> Result<(), LabError> {
        fs::write(path, self.bytes(path)?).map_err(LabError::file(path))
    }
}
