//! What a backward pass is asked for and what it gives.

/// Which optional parts of the gradient are computed.
#[derive(Clone, Copy, Debug)]
pub struct BackwardOptions {
    /// The gradient of the pose; without it `cam_from_world` stays 0.
    pub pose: bool,
    /// The paths through the direction in which SH are evaluated. Off, the direction counts as a
    /// constant, as in references whose generator leaves these paths out.
    pub view_direction: bool,
}

impl Default for BackwardOptions {
    fn default() -> Self {
        Self {
            pose: true,
            view_direction: true,
        }
    }
}

/// Gradients of all inputs, in the inputs' shapes.
#[derive(Clone, Debug)]
pub struct Gradients<T> {
    /// [N, 3].
    pub means: Vec<T>,
    /// [N, 4].
    pub quats: Vec<T>,
    /// [F, 3, 3].
    pub left_rotations: Vec<T>,
    /// [N, 3].
    pub log_scales: Vec<T>,
    /// `[N]`.
    pub opacity_logits: Vec<T>,
    /// [N, B, 3].
    pub sh: Vec<T>,
    /// [N, F].
    pub features: Vec<T>,
    /// [3, 4], the pose's entries as twelve free numbers.
    pub cam_from_world: [T; 12],
    /// Norm of the gradient of the mean in the image, in NDC units (half the image is 1), `[N]`:
    /// the statistic of density control.
    pub screen: Vec<T>,
}
