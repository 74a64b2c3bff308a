//! The gauge of the paths: what their means have in common may as well be the scene's, which then lies elsewhere. So it is, but for
//! what the given poses foretell.

use super::foretold::{Accelerations, Foretold};
use crate::scene_shift::{SceneShift, Shared};
use crate::views::CameraView;
use capture::{RIGID, Taken, shift_of, turn_of};

/// What of the paths is the scene's.
#[derive(Clone, Debug)]
pub(super) struct Gauge {
    scene_shift: SceneShift,
    accelerations: Accelerations,
    /// Frames that were not explained far worse than others at the last trial: the paths of those that were do not tell what is the
    /// scene's.
    pub(super) explained: Vec<bool>,
    /// Of the paths that are there; made where it is needed.
    common: Option<Common>,
}

/// What paths have in common, and what is foretold of them.
#[derive(Clone, Debug)]
struct Common {
    /// In a scene that stays as it is.
    steady: Shared,
    /// Beyond one that drifts along the video.
    foretold: Foretold,
}

impl Gauge {
    /// Of frames in the order of time, in a scene of such a size.
    pub(super) fn of(views: &[CameraView], size: f64) -> Self {
        Self {
            scene_shift: SceneShift::of(views),
            accelerations: Accelerations::of(views, size),
            explained: vec![true; views.len()],
            common: None,
        }
    }

    /// To be called behind a trial, which may put paths in and out.
    pub(super) fn renew(&mut self) {
        self.common = None;
    }

    /// Takes out of the paths' means what is the scene's: of the shifts in the image what a scene that lies elsewhere shows, and of
    /// the turns about the optical axis and of the translations all that goes with the camera's place. Where the poses do not foretell
    /// what the frames have of their own, slow waves of all these are a drift of the scene, too. (A path that a trial left out stays
    /// out.)
    pub(super) fn fix(&mut self, frames: &mut [Taken]) {
        let common = self.common.take();
        let common = common.unwrap_or_else(|| self.common_of(frames));
        let Common { steady, foretold } = &common;
        let belief = foretold.belief(&mean_shifts(frames));
        let shared = if belief < 1.0 {
            &foretold.shared
        } else {
            steady
        };
        // Turns about x and y shift the image: those are held with the shifts, below.
        for number in 2..RIGID {
            let means: Vec<f64> = frames.iter().map(|f| f.mean_motion()[number]).collect();
            for (frame, scenes) in frames.iter_mut().zip(shared.of_any(&means)) {
                let mut back = [0.0; RIGID];
                back[number] = -scenes;
                frame.bend(back);
            }
        }
        let missed = foretold.missed(&mean_shifts(frames), belief);
        for (frame, [x, y]) in frames.iter_mut().zip(shared.of_shifts(&missed)) {
            frame.bend(turn_of([-x, -y]));
        }
        self.common = Some(common);
    }

    /// Of such paths: those of no length are not there.
    fn common_of(&self, frames: &[Taken]) -> Common {
        let moving = frames.iter().map(|f| f.path.iter().any(|p| *p != 0.0));
        let moving: Vec<bool> = moving.collect();
        let explained = moving.iter().zip(&self.explained);
        let explained: Vec<bool> = explained.map(|(moves, e)| *moves && *e).collect();
        let told = self.accelerations.known(&explained);
        let steady = self.scene_shift.among(&moving, &told);
        let drifting = self.scene_shift.clone().drifting().among(&moving, &told);
        let foretold = self.accelerations.foretold(told, drifting);
        Common { steady, foretold }
    }
}

/// How far what is ahead is from its place in the sharp picture on average over each exposure.
fn mean_shifts(frames: &[Taken]) -> Vec<[f64; 2]> {
    let each = frames.iter();
    each.map(|frame| shift_of(frame.mean_motion())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};
    use splat_core::Camera;
    use std::f64::consts::PI;

    const FRAMES: usize = 9;

    /// Where the camera stands at a time.
    fn place(t: f64) -> DVec3 {
        DVec3::new(0.2 * t, 0.1 * (1.7 * t).sin(), 0.3 * (0.9 * t).cos())
    }

    /// The paths of some frames, [N, 12], once the gauge is fixed; those of `unexplained` do not tell.
    fn held(paths: &[f64], unexplained: Option<usize>) -> Vec<f64> {
        let view = |k: usize| CameraView {
            name: k.to_string(),
            camera: Camera::pinhole([8, 6], [8.0; 2], [4.0, 3.0]),
            cam_from_world: DAffine3::from_translation(-place(k as f64)),
            time: k as f32,
        };
        let views: Vec<CameraView> = (0..FRAMES).map(view).collect();
        let mut gauge = Gauge::of(&views, 2.0);
        if let Some(frame) = unexplained {
            gauge.explained[frame] = false;
        }
        let taken = paths.chunks_exact(2 * RIGID).map(|path| Taken {
            path: path.to_vec(),
            focus: 1.0,
            aperture: 0.0,
            shutter: 0.9,
        });
        let mut taken: Vec<Taken> = taken.collect();
        gauge.fix(&mut taken);
        taken.into_iter().flat_map(|taken| taken.path).collect()
    }

    /// By how much two lists are apart where most; NaN where one is.
    fn most_apart(a: &[f64], b: &[f64]) -> f64 {
        assert_eq!(a.len(), b.len());
        let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        apart.max_by(f64::total_cmp).unwrap_or(0.0)
    }

    #[test]
    fn a_frame_that_was_not_explained_moves_no_other() {
        let tame: Vec<f64> = (0..FRAMES * 2 * RIGID)
            .map(|k| 0.01 * (1.3 * k as f64 + 0.2).sin())
            .collect();
        let mut wild = tame.clone();
        let bend = 4 * 2 * RIGID + RIGID;
        (wild[bend], wild[bend + 1]) = (0.7, -0.9);
        let off = |unexplained| {
            let [one, other] = [&tame, &wild].map(|paths| {
                let mut held = held(paths, unexplained);
                held.drain(4 * 2 * RIGID..5 * 2 * RIGID);
                held
            });
            most_apart(&one, &other)
        };
        assert!(off(Some(4)) < 1e-12, "{}", off(Some(4)));
        assert!(off(None) > 1e-2, "{}", off(None));
    }

    #[test]
    fn slow_waves_are_the_hands_where_the_poses_foretell_paths_and_the_scenes_elsewhere() {
        let bends = |of: &dyn Fn(f64) -> [f64; RIGID]| -> Vec<f64> {
            let frames = (0..FRAMES).flat_map(|k| [[0.0; RIGID], of(k as f64)]);
            frames.flatten().collect()
        };
        // As the camera is accelerated, in its own axes.
        let foretold = bends(&|t| {
            let second = 2.0 * place(t) - place(t - 1.0) - place(t + 1.0);
            [0.0, 0.0, 0.0, second.x, second.y, second.z].map(|v| 0.1 * v)
        });
        let other = bends(&|t| {
            let (x, y) = ((2.9 * t).sin(), (2.3 * t).cos());
            [0.01 * x, 0.01 * y, 0.0, 0.0, 0.0, 0.0]
        });
        // Down in the picture and up again, which is no matter of where the camera stands.
        let wave = bends(&|t| {
            let swing = (PI * (t + 0.5) / FRAMES as f64).cos();
            [0.02 * swing, 0.0, 0.0, 0.0, 0.0, 0.0]
        });
        let left = |paths: &[f64]| -> f64 {
            let waving: Vec<f64> = paths.iter().zip(&wave).map(|(p, w)| p + w).collect();
            most_apart(&held(&waving, None), &held(paths, None)) / 0.02
        };
        assert!(left(&foretold) > 0.5, "{}", left(&foretold));
        assert!(left(&other) < 1e-12, "{}", left(&other));
    }
}
