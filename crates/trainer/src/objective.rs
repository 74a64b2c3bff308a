//! The training loss of one view: weighted terms on what a model shows of it.

use crate::blur::Shown;
use crate::look::Terms;
use crate::losses;
use crate::plan::Plan;
use crate::views::ViewRef;
use crate::world::World;
use burn::tensor::Tensor;

/// What the loss of a view is made of, beside what is shown of it.
#[derive(Clone, Copy)]
pub(crate) struct Objective<'a> {
    pub(crate) plan: &'a Plan,
    pub(crate) world: &'a World,
    pub(crate) view: &'a ViewRef<'a>,
}

impl Objective<'_> {
    /// All terms. `target` is what the camera saw; `fixed` is what alpha under the depth is taken from, see
    /// [`crate::Trainer::loss_terms`].
    pub(crate) fn terms(&self, shown: &Shown, fixed: &Shown, target: Tensor<3>) -> Terms {
        let mut terms = Terms::default();
        self.add_image_terms(&mut terms, shown, fixed, target);
        terms.0.extend(shown.terms.0.iter().cloned());
        self.add_motion_terms(&mut terms);
        terms
    }

    fn add_image_terms(&self, terms: &mut Terms, shown: &Shown, fixed: &Shown, target: Tensor<3>) {
        let Self { plan, view, .. } = self;
        let weights = &plan.settings.loss;
        let rendered = &shown.rendered;
        terms.add("image", 1.0, || {
            losses::photometric(shown.seen.clone(), target.clone(), weights.ssim)
        });
        terms.add("detail", weights.detail, || {
            losses::detail_loss(shown.seen.clone(), target)
        });
        let seen = &shown.seen;
        if let Some(depth) = view.depth(seen) {
            terms.add("depth", weights.depth, || {
                let alpha = fixed.rendered.alpha();
                let options = [plan.survey.scene_size, weights.depth_round];
                losses::depth_loss(rendered.depth(), &alpha, depth, options)
            });
        }
        let size = plan.survey.scene_size;
        if let Some(points) = view.point_disparity(seen, size) {
            terms.add("depth_shift", weights.depth_shift, || {
                let alpha = fixed.rendered.alpha();
                losses::depth_shift_loss(rendered.depth(), &alpha, points, size)
            });
        }
        if let (Some(mask), Some(dynamic)) = (view.mask(seen), rendered.features()) {
            terms.add("mask", weights.mask, || {
                let band = losses::mask_band(view.viewpoint.camera.width);
                losses::mask_loss(dynamic.squeeze_dim(2), mask, view.valid, band)
            });
        }
    }

    /// Smoothness of the motion, on positions divided by S.
    fn add_motion_terms(&self, terms: &mut Terms) {
        let Self { plan, world, view } = self;
        let Some(motion) = &world.motion else {
            return;
        };
        let weights = &plan.settings.loss;
        let size = plan.survey.scene_size;
        terms.add("bases_acceleration", weights.bases_acceleration, || {
            motion_bases::bases_acceleration(&motion.bases, size)
        });
        let last = plan.views.train.len() as f32 - 1.0;
        if last < 2.0 || world.num_dynamic == 0 {
            return;
        }
        let middle = view.viewpoint.time.clamp(1.0, last - 1.0);
        let means = world.dynamic_means();
        let times = [middle - 1.0, middle, middle + 1.0];
        let (moved, _) = motion.bases.moved_at(&motion.coefficients, &means, &times);
        let [before, now, after] =
            &[0, 1, 2].map(|t| moved.clone().narrow(0, t, 1).reshape(means.dims()));
        terms.add("means_acceleration", weights.means_acceleration, || {
            motion_bases::means_acceleration([before, now, after], size)
        });
        terms.add("along_ray", weights.along_ray, || {
            motion_bases::along_ray([before, now, after], view.center(), size)
        });
    }
}
