//! What fixes an image beside its inputs.

/// Side of a square tile in pixels.
pub const TILE: usize = 16;
/// Alpha is clamped here; a clamped alpha passes no gradient.
pub const MAX_ALPHA: f64 = 0.999;
/// A Gaussian is skipped at pixels where its alpha is smaller.
pub const MIN_ALPHA: f64 = 1.0 / 255.0;
/// A pixel is done before the Gaussian that would bring its transmittance to this or below.
pub const MIN_TRANSMITTANCE: f64 = 1e-4;
/// Low-pass filter: added to the diagonal of the 2D covariance, in square pixels.
pub const LOW_PASS: f64 = 0.3;

/// Channels of the output before the features: colour 3, alpha 1, depth 1.
pub const BASE_CHANNELS: usize = 5;
