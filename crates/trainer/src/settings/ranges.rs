//! The range of every setting.

use super::{DiscKind, Settings, TransferKind, When};
use crate::TrainError;

/// What a setting may be.
pub(super) struct Range {
    pub(super) key: &'static str,
    /// In words behind "must be".
    pub(super) allowed: &'static str,
    pub(super) holds: bool,
}

/// The shortest run.
pub(crate) const LEAST_ITERATIONS: usize = 200;

impl Settings {
    /// Checks every range.
    ///
    /// # Errors
    /// Names the first setting that is out of its range, and the range.
    pub fn validate(&self) -> Result<(), TrainError> {
        match self.ranges().into_iter().find(|range| !range.holds) {
            None => Ok(()),
            Some(Range { key, allowed, .. }) => {
                Err(TrainError::setting(key, format!("must be {allowed}")))
            }
        }
    }

    /// All ranges, and whether each holds here.
    pub(super) fn ranges(&self) -> Vec<Range> {
        let mut ranges = Vec::new();
        let mut check = |holds, key, allowed| {
            ranges.push(Range {
                key,
                allowed,
                holds,
            });
        };
        check(
            self.iterations >= LEAST_ITERATIONS,
            "iterations",
            "200 or more (a shorter run has no room for the schedule)",
        );
        let g = &self.gaussians;
        check(g.sh_degree <= 3, "gaussians.sh_degree", "0 to 3");
        check(
            g.sh_degree_every > 0,
            "gaussians.sh_degree_every",
            "positive",
        );
        check(g.control_every > 0, "gaussians.control_every", "positive");
        check(
            g.max_initial_static > 0,
            "gaussians.max_initial_static",
            "positive",
        );
        check(
            g.initial_opacity > 0.0 && g.initial_opacity < 1.0,
            "gaussians.initial_opacity",
            "between 0 and 1, both excluded",
        );
        check(
            (0.0..1.0).contains(&g.prune_opacity),
            "gaussians.prune_opacity",
            "0 or more and under 1",
        );
        check(
            (0.0..=256.0).contains(&g.mask_margin),
            "gaussians.mask_margin",
            "0 to 256 (pixels of a picture 256 wide)",
        );
        check(
            (0.0..=0.2).contains(&self.frames.held_back),
            "frames.held_back",
            "0 to 0.2",
        );
        let k = self.blur.kernel_size;
        check(k % 2 == 1 && k <= 15, "blur.kernel_size", "odd, 1 to 15");
        check(
            (1..=bpnet::MAX_DOWNSCALE).contains(&self.blur.downscale),
            "blur.downscale",
            "1 to 4",
        );
        check(
            self.blur.gauge_cells.iter().all(|n| (1..=64).contains(n)),
            "blur.gauge_cells",
            "two numbers, 1 to 64",
        );
        let c = &self.camera;
        check(
            (1..=3).contains(&c.path_degree),
            "camera.path_degree",
            "1 to 3",
        );
        check(
            c.disc != DiscKind::Layers || c.path == When::Never,
            "camera.disc",
            "`points` or `grown` where there are paths (`layers` wants camera.path = \"never\")",
        );
        check((2..=64).contains(&c.samples), "camera.samples", "2 to 64");
        if let TransferKind::Power(gamma) = c.transfer {
            let key = "camera.transfer.power";
            check((1.0..=4.0).contains(&gamma), key, "1 to 4");
        }
        check(self.motion.num_bases > 0, "motion.num_bases", "positive");
        check(self.motion.max_tracks > 0, "motion.max_tracks", "positive");
        check(self.unseen.every > 0, "unseen.every", "positive");
        check(
            (0.0..=1.0).contains(&self.unseen.min_valid),
            "unseen.min_valid",
            "0 to 1",
        );
        check(self.loss.ssim <= 1.0, "loss.ssim", "0 to 1");
        let round = self.loss.depth_round;
        check(
            round == 0.0 || (1e-4..=10.0).contains(&round),
            "loss.depth_round",
            "0, or 0.0001 to 10",
        );
        let l = &self.learning_rates;
        let positive = [
            (
                g.initial_static_per_pixel,
                "gaussians.initial_static_per_pixel",
            ),
            (g.gradient_threshold, "gaussians.gradient_threshold"),
            (g.split_scale, "gaussians.split_scale"),
            (g.prune_scale, "gaussians.prune_scale"),
            (g.depth_edge, "gaussians.depth_edge"),
            (g.near, "gaussians.near"),
            (l.means, "learning_rates.means"),
            (l.means_final, "learning_rates.means_final"),
            (l.static_final_share, "learning_rates.static_final_share"),
            (l.motion_final_share, "learning_rates.motion_final_share"),
            (l.blur_final_share, "learning_rates.blur_final_share"),
            (
                l.blur_short_run_share,
                "learning_rates.blur_short_run_share",
            ),
            (l.short_run_boost, "learning_rates.short_run_boost"),
            (c.spacing_px, "camera.spacing_px"),
            (c.lens_spacing_px, "camera.lens_spacing_px"),
            (l.camera_final_share, "learning_rates.camera_final_share"),
        ];
        for (value, key) in positive {
            check(value.is_finite() && value > 0.0, key, "a positive number");
        }
        let w = &self.loss;
        let not_negative = [
            (g.max_per_pixel, "gaussians.max_per_pixel"),
            (self.unseen.offset, "unseen.offset"),
            (self.unseen.sharpness, "unseen.sharpness"),
            (self.checkpoint_minutes, "checkpoint_minutes"),
            (w.ssim, "loss.ssim"),
            (w.depth, "loss.depth"),
            (w.depth_shift, "loss.depth_shift"),
            (w.mask, "loss.mask"),
            (w.kernel_center, "loss.kernel_center"),
            (w.intensity, "loss.intensity"),
            (w.gauge, "loss.gauge"),
            (w.detail, "loss.detail"),
            (w.offset_shift, "loss.offset_shift"),
            (w.downsample, "loss.downsample"),
            (w.bases_acceleration, "loss.bases_acceleration"),
            (w.means_acceleration, "loss.means_acceleration"),
            (w.along_ray, "loss.along_ray"),
            (l.sh_dc, "learning_rates.sh_dc"),
            (l.sh_rest, "learning_rates.sh_rest"),
            (l.opacity, "learning_rates.opacity"),
            (l.scales, "learning_rates.scales"),
            (l.rotations, "learning_rates.rotations"),
            (l.coefficients, "learning_rates.coefficients"),
            (l.bases, "learning_rates.bases"),
            (l.blur, "learning_rates.blur"),
            (c.start_px, "camera.start_px"),
            (c.aperture, "camera.aperture"),
            (c.shutter, "camera.shutter"),
            (l.camera_path, "learning_rates.camera_path"),
            (l.frame_offset, "learning_rates.frame_offset"),
            (l.frame_gain, "learning_rates.frame_gain"),
            (l.camera_focus, "learning_rates.camera_focus"),
            (l.camera_aperture, "learning_rates.camera_aperture"),
            (l.camera_shutter, "learning_rates.camera_shutter"),
        ];
        for (value, key) in not_negative {
            check(
                value.is_finite() && value >= 0.0,
                key,
                "zero or a positive number",
            );
        }
        ranges
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_are_named() {
        let mistake = |change: fn(&mut Settings)| {
            let mut settings = Settings::default();
            change(&mut settings);
            settings.validate().expect_err("out of range").to_string()
        };
        assert!(mistake(|s| s.blur.kernel_size = 8).contains("blur.kernel_size"));
        assert!(mistake(|s| s.iterations = 199).contains("iterations"));
        assert!(mistake(|s| s.loss.depth = f64::NAN).contains("loss.depth"));
        for round in [f64::NAN, -0.05, 1e-40, f64::INFINITY] {
            let mut settings = Settings::default();
            settings.loss.depth_round = round;
            assert!(settings.validate().is_err(), "{round}");
        }
        assert!(Settings::default().validate().is_ok());
        assert!(Settings::paper().validate().is_ok());
    }
}
