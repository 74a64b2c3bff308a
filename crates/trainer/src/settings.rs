//! Everything that can be chosen about a training run, with its default.

mod blur;
mod meanings;
mod ranges;
mod when;

pub(crate) use ranges::LEAST_ITERATIONS;

pub use blur::{BlurKind, BlurSettings, CameraSettings, DiscKind, TransferKind};
pub use meanings::Meaning;
pub use when::When;

use serde::{Deserialize, Serialize};

/// All settings of a training run.
///
/// Lengths that scenes give a scale are relative to the scene's size S (median z-depth of the
/// training pixels); moments are iterations of a run of 40,000 and shrink with shorter ones
/// (see [`crate::schedule::Schedule`]).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Number of training iterations, at least 200.
    pub iterations: usize,
    /// Seed of every random choice.
    pub seed: u64,
    /// Gaussians and density control.
    pub gaussians: GaussianSettings,
    /// Motion bases.
    pub motion: MotionSettings,
    /// The blur model.
    pub blur: BlurSettings,
    /// The blur model `camera`.
    pub camera: CameraSettings,
    /// What may have been given wrong of the training frames.
    pub frames: FrameSettings,
    /// Unseen views.
    pub unseen: UnseenSettings,
    /// Weights of the losses.
    pub loss: LossSettings,
    /// Learning rates.
    pub learning_rates: LearningRates,
    /// Iterations between checkpoints that the program writes; 0 for only at the end.
    pub checkpoint_every: usize,
    /// Minutes between them at most, whatever the number of iterations; 0 for no limit.
    pub checkpoint_minutes: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            iterations: 3000,
            seed: 1,
            gaussians: GaussianSettings::default(),
            motion: MotionSettings::default(),
            blur: BlurSettings::default(),
            camera: CameraSettings::default(),
            frames: FrameSettings::default(),
            unseen: UnseenSettings::default(),
            loss: LossSettings::default(),
            learning_rates: LearningRates::default(),
            checkpoint_every: 1000,
            checkpoint_minutes: 5.0,
        }
    }
}

/// Gaussians: how many, and how their number changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GaussianSettings {
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// The active degree rises by one every so many iterations (of 40,000).
    pub sh_degree_every: usize,
    /// Static Gaussians at the start: at most so many…
    pub max_initial_static: usize,
    /// … and at most so many for each pixel of a frame.
    pub initial_static_per_pixel: f64,
    /// Static Gaussians start this far from the dynamic mask, in pixels of a picture 256 wide.
    pub mask_margin: f64,
    /// Pixels between which depth jumps by more than this, relatively and beyond their surface's slope, lie on a depth
    /// edge ([`unseen_views::depth_edges`]): no Gaussian starts there, and unseen views are not warped from there.
    pub depth_edge: f64,
    /// Opacity at the start.
    pub initial_opacity: f64,
    /// Density control starts after this iteration (of 40,000).
    pub control_from: usize,
    /// Density control ends at this iteration (of 40,000).
    pub control_until: usize,
    /// Iterations between steps of density control (of 40,000; never under 25 or the number of frames).
    pub control_every: usize,
    /// Mean screen-space gradient from which a Gaussian is cloned or split (in units of half the picture, at a height of 288).
    pub gradient_threshold: f64,
    /// Gaussians above this scale are split, those below cloned, in units of S.
    pub split_scale: f64,
    /// Gaussians above this scale are removed once `prune_scale_from` has passed, in units of S.
    pub prune_scale: f64,
    /// See `prune_scale` (of 40,000).
    pub prune_scale_from: usize,
    /// Gaussians below this opacity are removed.
    pub prune_opacity: f64,
    /// At most so many Gaussians for each pixel of a frame, and 20,000 in any case, are made of those that there are; 0 for no limit.
    /// (A run that starts with more keeps them.)
    pub max_per_pixel: f64,
    /// Iterations between resets of the opacity, in runs of 10,000 iterations or more; 0 for never.
    pub opacity_reset_every: usize,
    /// Near plane in units of S.
    pub near: f64,
}

impl Default for GaussianSettings {
    fn default() -> Self {
        Self {
            sh_degree: 3,
            sh_degree_every: 1000,
            max_initial_static: 100_000,
            initial_static_per_pixel: 2.0,
            mask_margin: 3.0,
            depth_edge: 0.05,
            initial_opacity: 0.7,
            control_from: 500,
            control_until: 15_000,
            control_every: 100,
            gradient_threshold: 2e-4,
            split_scale: 0.01,
            prune_scale: 0.1,
            prune_scale_from: 3000,
            prune_opacity: 0.005,
            max_per_pixel: 3.0,
            opacity_reset_every: 3000,
            near: 0.01,
        }
    }
}

/// A run may always have so many Gaussians, however small its pictures.
const LEAST_MAX_GAUSSIANS: usize = 20_000;

impl GaussianSettings {
    /// The most Gaussians of a run whose frames have so many pixels.
    #[must_use]
    pub fn most(&self, pixels: usize) -> usize {
        if self.max_per_pixel == 0.0 {
            return usize::MAX;
        }
        LEAST_MAX_GAUSSIANS.max((self.max_per_pixel * pixels as f64) as usize)
    }
}

/// Motion bases and dynamic Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionSettings {
    /// When what masks and tracks show is modelled as moving: by default unless the tracks stay where something that stands still
    /// would be seen.
    pub when: When,
    /// Number of motion bases N_b, at most: those that move alike become one.
    pub num_bases: usize,
    /// Whether there are only as many bases as the tracks themselves need, by cross-validation.
    pub fewest_bases: bool,
    /// At most so many 2D tracks are lifted, and no more than a picture has pixels.
    pub max_tracks: usize,
    /// Whether tracks are smoothed in time, over as many frames as foretell their positions best; where that says less than the
    /// positions themselves, they stay as they are.
    pub smooth_tracks: bool,
    /// Steps of the first fit of the bases to the tracks.
    pub first_fit_steps: usize,
    /// Whether dynamic Gaussians are densified once (paper, N_d).
    pub densify: bool,
    /// When dynamic Gaussians are densified (of 40,000).
    pub densify_at: usize,
    /// A frame adds at most so many dynamic Gaussians then.
    pub densify_per_frame: usize,
}

impl Default for MotionSettings {
    fn default() -> Self {
        Self {
            when: When::Auto,
            num_bases: 20,
            fewest_bases: false,
            max_tracks: 40_000,
            smooth_tracks: true,
            first_fit_steps: 1000,
            densify: true,
            densify_at: 2500,
            densify_per_frame: 1000,
        }
    }
}

/// What may have been given wrong of the training frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameSettings {
    /// Whether the given poses are refined.
    pub offsets: bool,
    /// When each frame has a gain of its own, for auto-exposure: by default where the survey finds that frames differ.
    pub gains: When,
    /// Share of every training frame's blocks that training is not shown, to tell how well it does there; 0 for none.
    pub held_back: f64,
}

/// Unseen views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct UnseenSettings {
    /// When unseen views are used: by default where kernels explain blur by themselves, since warping blurs a frame once more, which
    /// no camera did.
    pub when: When,
    /// Unseen views start after this iteration (of 40,000).
    pub from: usize,
    /// Every so many iterations is an unseen view (paper, N_u; not scaled).
    pub every: usize,
    /// Largest perpendicular offset in units of S; each view draws from [0.5, 1] of it.
    pub offset: f64,
    /// Sharpness of the soft z-buffer.
    pub sharpness: f64,
    /// Views with a smaller share of valid pixels are dropped.
    pub min_valid: f64,
}

impl Default for UnseenSettings {
    fn default() -> Self {
        Self {
            when: When::Auto,
            from: 3000,
            every: 5,
            offset: 0.05,
            sharpness: 50.0,
            min_valid: 0.6,
        }
    }
}

/// Weights of the losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossSettings {
    /// Share of 1 − SSIM in the photometric loss (paper, β).
    pub ssim: f64,
    /// Huber loss on disparity.
    pub depth: f64,
    /// Differences of disparity, times S, up to which that loss is round; 0 for L1.
    pub depth_round: f64,
    /// Square of the mean difference in disparity to the sparse points.
    pub depth_shift: f64,
    /// Dynamic mask L1.
    pub mask: f64,
    /// Kernel-centre loss L_spa.
    pub kernel_center: f64,
    /// L_spa starts after this iteration (of 40,000), never before blur's start + `min(500, n / 4)`.
    pub kernel_center_from: usize,
    /// Mean blur intensity, never before L_spa's start.
    pub intensity: f64,
    /// The gauge on the kernels' common shift.
    pub gauge: f64,
    /// Square of how far a frame's offset shifts it, px: what of the offsets no frame tells is held at zero.
    pub offset_shift: f64,
    /// Fine detail of what the camera is said to have seen against the frame.
    pub detail: f64,
    /// Four times smaller sharp render against the blurry frame.
    pub downsample: f64,
    /// The downsample loss starts so many iterations (of 40,000) after blur.
    pub downsample_after: usize,
    /// Second differences of the bases.
    pub bases_acceleration: f64,
    /// Second differences of the dynamic means.
    pub means_acceleration: f64,
    /// Motion along the viewing ray.
    pub along_ray: f64,
}

impl Default for LossSettings {
    fn default() -> Self {
        Self {
            ssim: 0.2,
            depth: 0.075,
            depth_round: 0.05,
            depth_shift: 100.0,
            mask: 0.075,
            kernel_center: 0.001,
            kernel_center_from: 5500,
            intensity: 0.0,
            gauge: 0.1,
            offset_shift: 0.02,
            detail: 1.0,
            downsample: 0.0,
            downsample_after: 1000,
            bases_acceleration: 0.1,
            means_acceleration: 1.0,
            along_ray: 1.0,
        }
    }
}

/// Learning rates of the parameter groups. In shorter runs those of Gaussians are higher, see
/// [`crate::schedule::Schedule::static_pace`] and [`crate::schedule::Schedule::dynamic_pace`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearningRates {
    /// Means at the start, in units of S.
    pub means: f64,
    /// Means at the end, in units of S.
    pub means_final: f64,
    /// The means' decay takes so many iterations (of 40,000).
    pub means_decay: usize,
    /// Spherical harmonics of degree 0.
    pub sh_dc: f64,
    /// Spherical harmonics of higher degrees.
    pub sh_rest: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// Log-scales.
    pub scales: f64,
    /// Quaternions.
    pub rotations: f64,
    /// Of Gaussians that stand still all of these but means fall from the thousandth iteration on, to this share at least
    /// ([`crate::schedule::Schedule::settled`]).
    pub static_final_share: f64,
    /// Motion coefficients at the start.
    pub coefficients: f64,
    /// Motion bases (translations in units of S) at the start.
    pub bases: f64,
    /// Bases and coefficients at the end, as a share of the start. A basis of one frame learns from that frame alone, but Adam's
    /// step goes on through the iterations between its visits: at a rate that stays large movers tremble by a third of a pixel.
    pub motion_final_share: f64,
    /// BP-Net, extractor and embeddings at the start.
    pub blur: f64,
    /// The same at the end of a run of 40,000 iterations or more, as a share of the start.
    pub blur_final_share: f64,
    /// The decay to it takes so many iterations (of 40,000).
    pub blur_decay: usize,
    /// The same at the end of a shorter run, over its whole length.
    pub blur_short_run_share: f64,
    /// In short runs the blur model learns faster by `min(this, s^-1/2)`, s = iterations / 40,000. Motion does not: what it
    /// learns faster than the blur model it takes from it, as per-frame shifts in the place of kernels.
    pub short_run_boost: f64,
    /// The camera's paths: turns, rad. Translations, in units of S, learn at a fifth of it. Runs of less than 3,000 iterations learn
    /// faster, longer ones slower ([`crate::schedule::Schedule::path_pace`]).
    pub camera_path: f64,
    /// Disparities of focus (S / distance). Runs of less than 3,000 iterations learn faster, as with paths.
    pub camera_focus: f64,
    /// Radius of the lens, in units of S.
    pub camera_aperture: f64,
    /// Time for which the shutter is open, in units of frames.
    pub camera_shutter: f64,
    /// Offsets from the given poses, as paths; no slower in long runs.
    pub frame_offset: f64,
    /// Logarithms of the frames' gains.
    pub frame_gain: f64,
    /// The camera's and the frames' at the end, as a share of the start.
    pub camera_final_share: f64,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 1.6e-4,
            means_final: 1.6e-6,
            means_decay: 30_000,
            sh_dc: 2.5e-3,
            sh_rest: 1.25e-4,
            opacity: 0.05,
            scales: 5e-3,
            rotations: 1e-3,
            static_final_share: 0.1,
            coefficients: 1e-2,
            bases: 1.6e-4,
            motion_final_share: 0.01,
            blur: 5e-4,
            blur_final_share: 0.02,
            blur_decay: 35_000,
            blur_short_run_share: 0.1,
            short_run_boost: 4.0,
            camera_path: 3e-3,
            camera_focus: 2e-2,
            camera_aperture: 1e-4,
            camera_shutter: 5e-3,
            frame_offset: 6e-4,
            frame_gain: 1e-2,
            camera_final_share: 0.05,
        }
    }
}

impl Settings {
    /// The paper's text where it differs from the defaults: 40,000 iterations; kernels in the place of the camera; movers wherever masks show some;
    /// tracks as they are; no loss on fine detail or shifts, L1 of disparity; what stands still, motion and blur learn at constant
    /// rates, no hold, no gauge, the blur model's head as a framework initialises it (the paper says nothing about it).
    #[must_use]
    pub fn paper() -> Self {
        let mut settings = Self {
            iterations: 40_000,
            ..Self::default()
        };
        settings.learning_rates.static_final_share = 1.0;
        settings.learning_rates.motion_final_share = 1.0;
        settings.learning_rates.blur_final_share = 1.0;
        settings.learning_rates.blur_short_run_share = 1.0;
        settings.motion.when = When::Always;
        settings.motion.smooth_tracks = false;
        settings.blur.model = BlurKind::Kernels;
        settings.blur.hold = 0;
        settings.blur.mild_start = false;
        settings.loss.gauge = 0.0;
        settings.loss.depth_round = 0.0;
        settings.loss.detail = 0.0;
        settings.loss.depth_shift = 0.0;
        settings.loss.offset_shift = 0.0;
        settings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_survive_toml_and_json() {
        let settings = Settings::paper();
        assert_eq!(
            toml::from_str::<Settings>(&toml::to_string(&settings).expect("toml")).expect("toml"),
            settings
        );
        assert_eq!(
            serde_json::from_str::<Settings>(&serde_json::to_string(&settings).expect("json"))
                .expect("json"),
            settings
        );
    }

    #[test]
    fn a_misspelt_setting_is_an_error() {
        let error = toml::from_str::<Settings>("[blur]\nkernel = 9\n").expect_err("unknown key");
        assert!(error.to_string().contains("kernel"), "{error}");
    }
}
