//! Looking at the world: where from, and what comes of it.

use crate::TrainError;
use crate::views::{CameraView, ViewRef, pose_tensor};
use crate::world::{Posed, World};
use burn::tensor::{DType, Device, Tensor};
use capture::moved;
use splat_core::{Extra, Rendered, Splats, Viewpoint, render};
use tracing::trace_span;

/// What is looked at, and how.
#[derive(Clone)]
pub(crate) struct Look<'a> {
    pub(crate) viewpoint: &'a CameraView,
    /// The training frame whose blur is shown; `None` for a sharp view.
    pub(crate) frame: Option<usize>,
    /// 1-based iteration, or iterations done.
    pub(crate) iteration: usize,
    pub(crate) sh_degree: usize,
    /// The view that is learned from, for the blur model's own terms of the loss.
    pub(crate) view: Option<&'a ViewRef<'a>>,
    /// The frame's pose, [3, 4], where the given one is corrected.
    pub(crate) pose: Option<Tensor<2>>,
    /// By how much the frame is brighter than the others, `[1, 1]`; `None` where it is not.
    pub(crate) gain: Option<Tensor<2>>,
    /// Receives the norms of the screen-space gradient, `[N]`.
    pub(crate) screen_grad: Option<Tensor<1>>,
}

impl Look<'_> {
    /// Its viewpoint as the renderer takes it.
    pub(crate) fn viewpoint_of(&self, splats: &Splats) -> Viewpoint {
        let means = &splats.means;
        Viewpoint {
            camera: self.viewpoint.camera.clone(),
            cam_from_world: self.cam_from_world((&means.device(), means.dtype())),
            sh_degree: self.sh_degree,
        }
    }

    /// The same from behind a rigid motion [1, 6] in the camera's axes: a turn (rad), and a translation in units of `size`.
    pub(crate) fn moved(&self, motion: Tensor<2>, size: f64) -> Self {
        let given = self.cam_from_world((&motion.device(), motion.dtype()));
        let pose = moved(motion, &given, size).reshape([3, 4]);
        Self {
            pose: Some(pose),
            ..self.clone()
        }
    }

    /// Its pose, [3, 4].
    fn cam_from_world(&self, options: (&Device, DType)) -> Tensor<2> {
        let given = || pose_tensor(&self.viewpoint.cam_from_world, options);
        self.pose.clone().unwrap_or_else(given)
    }

    /// A picture as bright as the frame is.
    pub(crate) fn gained(&self, picture: Tensor<3>) -> Tensor<3> {
        match &self.gain {
            Some(gain) => picture * gain.clone().reshape([1, 1, 1]),
            None => picture,
        }
    }
}

/// What a model shows of a view; `T` is what the blur model wants to keep of it.
pub(crate) struct Shown<T> {
    /// The sharp render.
    pub(crate) rendered: Rendered,
    /// What the model says the camera saw, [H, W, 3].
    pub(crate) seen: Tensor<3>,
    /// Radius of every Gaussian where it was drawn largest, px, `[N]`; 0 for those that were not drawn.
    pub(crate) radii: Tensor<1>,
    /// The blur model's own terms of the loss.
    pub(crate) terms: Terms,
    /// `None` where the camera saw the sharp render.
    pub(crate) trace: Option<T>,
}

impl<T> Shown<T> {
    /// The camera saw the scene as it is.
    pub(crate) fn sharp(rendered: Rendered) -> Self {
        Self {
            seen: rendered.color(),
            radii: rendered.radii(),
            rendered,
            terms: Terms::default(),
            trace: None,
        }
    }

    /// The same with something else kept.
    pub(crate) fn map<U>(self, keep: impl FnOnce(T) -> U) -> Shown<U> {
        Shown {
            rendered: self.rendered,
            seen: self.seen,
            radii: self.radii,
            terms: self.terms,
            trace: self.trace.map(keep),
        }
    }
}

/// Weighted terms of a loss by name, none of weight zero, each of shape `[1]`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Terms(pub(crate) Vec<(&'static str, Tensor<1>)>);

impl Terms {
    pub(crate) fn add(
        &mut self,
        name: &'static str,
        weight: f64,
        value: impl FnOnce() -> Tensor<1>,
    ) {
        if weight != 0.0 {
            self.0.push((name, value().mul_scalar(weight)));
        }
    }
}

/// The scene as a camera without blur sees it: posed at the look's time, rendered.
pub(crate) fn render_sharp(world: &World, look: &Look<'_>) -> Result<Rendered, TrainError> {
    let posed = trace_span!("pose").in_scope(|| world.pose(look.viewpoint.time));
    let viewpoint = look.viewpoint_of(&posed.splats);
    render_posed(posed, &viewpoint, look.screen_grad.clone())
}

/// Posed Gaussians, rendered with the flag of what moves.
pub(crate) fn render_posed(
    posed: Posed,
    viewpoint: &Viewpoint,
    screen_grad: Option<Tensor<1>>,
) -> Result<Rendered, TrainError> {
    let extra = Extra {
        features: posed.dynamic,
        screen_grad,
    };
    Ok(trace_span!("render").in_scope(|| render(posed.splats, viewpoint, extra))?)
}
