//! What a parameter is: its name, what it stands for, and what its rows are.

/// What a parameter stands for; everything that treats parameters differently matches on this.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// Means of the Gaussians.
    Means,
    /// Quaternions of the Gaussians.
    Quats,
    /// Logarithms of the Gaussians' scales.
    LogScales,
    /// Logits of the Gaussians' opacities.
    OpacityLogits,
    /// Spherical harmonics of the Gaussians.
    Sh,
    /// Rotations of the motion bases.
    BasisRotations,
    /// Translations of the motion bases.
    BasisTranslations,
    /// Motion coefficients of the dynamic Gaussians.
    MotionCoefficients,
    /// Weights, biases and embeddings of BP-Net.
    BlurNet,
    /// Paths of the camera while the shutter is open.
    CameraPath,
    /// Disparities of focus.
    CameraFocus,
    /// Aperture of the lens.
    CameraAperture,
    /// Time for which the shutter is open.
    CameraShutter,
    /// Offsets from the given poses.
    FrameOffset,
    /// Logarithms of the frames' gains.
    FrameGain,
}

/// What a row of a parameter belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rows {
    /// A Gaussian each: density control edits them.
    Gaussians,
    /// A dynamic Gaussian each: density control edits them.
    DynamicGaussians,
    /// A training frame each: a row and its moments step only when its frame was drawn.
    Frames,
    /// Nothing in particular.
    Whole,
}

/// A trainable parameter, without its values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// Its name, under which checkpoints hold it.
    pub name: String,
    /// What it stands for.
    pub group: Group,
}

impl Parameter {
    pub(crate) fn new(name: impl Into<String>, group: Group) -> Self {
        Self {
            name: name.into(),
            group,
        }
    }

    /// What its rows belong to.
    #[must_use]
    pub fn rows(&self) -> Rows {
        match self.group {
            Group::Means | Group::Quats | Group::LogScales | Group::OpacityLogits | Group::Sh => {
                Rows::Gaussians
            }
            Group::MotionCoefficients => Rows::DynamicGaussians,
            Group::CameraPath | Group::CameraFocus | Group::FrameOffset | Group::FrameGain => {
                Rows::Frames
            }
            // BP-Net's embeddings have a row per frame, but the paper steps them as one tensor.
            Group::BasisRotations
            | Group::BasisTranslations
            | Group::BlurNet
            | Group::CameraAperture
            | Group::CameraShutter => Rows::Whole,
        }
    }
}
