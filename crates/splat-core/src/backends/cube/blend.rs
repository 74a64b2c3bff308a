//! Pictures from what every tile sees.

use burn::backend::ops::FloatTensorOps as _;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{cubes, flat, full, units};

use super::tables::{Scene, Tables, read};
use crate::cpu::{BASE_CHANNELS, Transfer};
use crate::cube::exposure::{Curve, mean_kernel};
use crate::cube::project::{Rows, faults_kernel};
use crate::cube::raster::{PIXELS, STATE, raster_kernel};
use crate::cube::raster_backward::MAX_FEATURES;
use crate::error::SplatError;

/// Blended pictures.
#[derive(Clone, Debug)]
pub(super) struct Blend {
    /// [H, W, 5 + F] of a render, [n, H, W, 3] of samples.
    pub(super) output: CubeTensor,
    /// [n, H, W, 2].
    pub(super) state: CubeTensor,
}

impl Blend {
    /// Of a render with `features` [N, F], or of an exposure's samples, which have none.
    pub(super) fn new(
        tables: &Tables,
        features: &CubeTensor,
        render: bool,
    ) -> Result<Self, SplatError> {
        let scene = &tables.scene;
        let client = scene.client();
        let num_features = if render { features.meta.shape()[1] } else { 0 };
        if num_features > MAX_FEATURES {
            return Err(SplatError::TooManyFeatures {
                found: num_features,
                limit: MAX_FEATURES,
            });
        }
        let features = if num_features > 0 {
            let features = flat(features.clone());
            if !tables.features_checked {
                check_features(&features)?;
            }
            features
        } else {
            // A buffer that no kernel reads, but none may be empty.
            tables.splats.clone()
        };
        let (height, width) = (scene.camera.height, scene.camera.width);
        let pixels = scene.samples * height * width;
        let channels = if render {
            BASE_CHANNELS + num_features
        } else {
            3
        };
        let output = scene.table("pictures", pixels * channels, DType::F32)?;
        let state = scene.table("pixels' states", pixels * STATE, DType::F32)?;
        let (number, dim) = cubes(client, scene.tiles(), PIXELS);
        raster_kernel::launch(
            client,
            number,
            dim,
            scene.lens(),
            tables.splats.clone().into_buffer_arg(),
            features.into_buffer_arg(),
            tables.ranges.clone().into_buffer_arg(),
            tables.list.clone().into_buffer_arg(),
            output.clone().into_buffer_arg(),
            state.clone().into_buffer_arg(),
            num_features,
            render,
        );
        let output = if render {
            CubeBackend::float_reshape(output, [height, width, channels].into())
        } else {
            output
        };
        Ok(Self { output, state })
    }
}

/// Names the first row that is not finite; waits for the device.
fn check_features(features: &CubeTensor) -> Result<(), SplatError> {
    let faults = full(features, [1], u32::MAX);
    let (number, dim) = units(&features.client, features.meta.num_elements());
    faults_kernel::launch(
        &features.client,
        number,
        dim,
        features.clone().into_buffer_arg(),
        faults.clone().into_buffer_arg(),
        features.meta.shape()[1],
        0,
        Rows::Plain,
    );
    match read(&faults)?[0] {
        u32::MAX => Ok(()),
        row => Err(SplatError::NotFinite {
            tensor: "features",
            row: row as usize,
        }),
    }
}

/// The kernels' name of a curve, and its exponent.
pub(super) fn curve(transfer: Transfer) -> (Curve, f32) {
    match transfer {
        Transfer::Srgb => (Curve::Srgb, 1.0),
        Transfer::Power(gamma) => (Curve::Power, gamma as f32),
        Transfer::Linear => (Curve::Linear, 1.0),
    }
}

/// The mean of samples' pictures [n, H, W, 3] in light.
pub(super) fn mean_of_samples(
    scene: &Scene,
    samples: &CubeTensor,
    transfer: Transfer,
) -> Result<CubeTensor, SplatError> {
    let length = scene.camera.num_pixels() * 3;
    let picture = scene.table("pictures", length, DType::F32)?;
    let (number, dim) = units(scene.client(), length);
    let (curve, gamma) = curve(transfer);
    mean_kernel::launch(
        scene.client(),
        number,
        dim,
        samples.clone().into_buffer_arg(),
        picture.clone().into_buffer_arg(),
        1.0 / scene.samples as f32,
        gamma,
        curve,
    );
    Ok(picture)
}
