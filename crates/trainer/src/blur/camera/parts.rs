//! Parts: whether the camera needs its lens, and its paths at all. What does not pay goes for good.

use super::CameraBlur;
use super::errors::total;
use super::moments::{Asked, Trial};
use crate::TrainError;
use crate::look::Look;
use crate::settings::When;
use crate::tensors::{host, set_row};
use crate::world::World;
use burn::tensor::Tensor;
use std::fmt;

/// Paths, or another aperture, pay if without them the error of all frames is larger by more than this share.
/// Gaussians have sharpened under what they were trained with, so that leaving it out costs something even where it was not
/// there. (RESULTS.md, "What a trial sees", has what was seen.)
const PATHS_PAY: f64 = 0.05;
/// The same of paths without a lens once Gaussians have sharpened for long. Beside a lens they have to be worth more than it is by
/// then. (RESULTS.md, "Paths that come late" and "Believed by how much they explain", has what was seen.)
const PATHS_PAY_LATE: f64 = 0.015;
/// The same of a lens. Less, since without it frames may be softer, each by itself, so that it is worth only what blurs things at
/// one depth more than those at another. (RESULTS.md, "A lens that is not there", has what was seen.)
const LENS_PAYS: f64 = 0.04;
/// Beside a lens that stays, paths pay if they are worth more than this: they can take a share of what it blurs, which no softness
/// explains either. (RESULTS.md, "What a trial sees".)
const PATHS_PAY_BESIDE_LENS: f64 = 0.12;
/// Paths that pay less than that, but so many times as much as the lens, stay in its place. (RESULTS.md, "Either a lens or paths".)
const PATHS_INSTEAD: f64 = 2.0;
/// A lens that does not pay stays if without it the error is larger by more than this share than with the focus that explains each
/// frame best, and pays beyond softer frames with it: in a short run focus has not come far by itself. So much more, since many
/// distances are tried on the very frames that are to be explained. (RESULTS.md, "Focus that is tried out" and "A lens that is not
/// there", has what was seen.)
const FOCUSED_LENS_PAYS: f64 = 0.13;
/// How many distances of focus are tried on a frame.
const FOCUSES: usize = 5;
/// Where a lens does not pay they are tried on every third frame first, if these are four or more, and on the others if by these the
/// lens is worth so much: half of what it has to be. (RESULTS.md, "Focus that is tried out".)
const FOCUSED_FIRST: usize = 3;
const LEAST_FOCUSED: usize = 4;
const FOCUS_PROMISES: f64 = LENS_PAYS / 2.0;

/// By what share the error of all frames grows without the lens, and without the paths.
#[derive(Clone, Copy, Debug)]
pub(super) struct Worth {
    lens: f64,
    paths: f64,
}

/// Which parts there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Parts {
    paths: bool,
    lens: bool,
}

/// Which parts a trial left in, and why.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Decision {
    /// What there was; of anything else nothing was asked.
    before: Parts,
    parts: Parts,
    worth: Worth,
    /// Behind which iteration the next trial asks whether paths stay, if this one left that to it.
    until: Option<usize>,
    /// Which parts the settings ask for, whatever trials find.
    asked: Parts,
    /// Behind which iteration kernels begin, where they are to stand on the camera.
    pub(in crate::blur) kernels_from: Option<usize>,
}

impl fmt::Display for Decision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            before,
            parts,
            worth,
            until,
            asked,
            kernels_from,
        } = self;
        let tried = [
            (before.lens, worth.lens, "a lens"),
            (before.paths, worth.paths, "paths"),
        ];
        let tried = tried.iter().filter(|(was, ..)| *was);
        let changes = tried
            .map(|(_, worth, part)| format!("by {:+.1} % without {part}", 100.0 * worth))
            .collect::<Vec<_>>();
        if changes.is_empty() {
            f.write_str("there is neither a lens nor are there paths: ")?;
        } else {
            let changes = changes.join(" and ");
            write!(f, "the error of the blurred frames changes {changes}: ")?;
        }
        let [no_lens, no_paths] = [
            (
                before.lens,
                " from here on (`camera.lens = \"always\"` keeps a lens)",
            ),
            (
                before.paths,
                " from here on (`camera.path = \"always\"` keeps paths)",
            ),
        ]
        .map(|(was, gone)| if was { gone } else { "" });
        match (parts.paths, parts.lens, until) {
            (true, true, None) => f.write_str("motion blur and defocus are modelled"),
            (true, true, Some(until)) => write!(
                f,
                "defocus is modelled, and motion blur until it is asked again (iteration {until})"
            ),
            (true, false, Some(until)) => write!(
                f,
                "no defocus is modelled{no_lens}, and motion blur until it is asked again (iteration {until})"
            ),
            (true, false, None) => write!(f, "motion blur is modelled, and no defocus{no_lens}"),
            (false, true, _) => {
                write!(
                    f,
                    "defocus is modelled, and no motion of the camera{no_paths}"
                )
            }
            (false, false, _) => {
                let (gone, otherwise) = match kernels_from {
                    Some(from) => (
                        "the camera explains no blur",
                        format!("kernels begin behind iteration {from}"),
                    ),
                    None => (
                        "no blur is modelled",
                        "`--blur kernels` has another model".to_owned(),
                    ),
                };
                write!(
                    f,
                    "{gone} from here on (a run of another length may find it; `camera.path` or `camera.lens` = \"always\" keeps it, \
                     and {otherwise})"
                )
            }
        }?;
        let asked = [
            (asked.lens && parts.lens, "`camera.lens`"),
            (asked.paths && parts.paths, "`camera.path`"),
        ];
        let asked = asked.iter().filter(|(is_asked, _)| *is_asked);
        let settings: Vec<&str> = asked.map(|(_, setting)| *setting).collect();
        match settings[..] {
            [] => Ok(()),
            [one] => write!(f, ", as {one} = \"always\" asks"),
            _ => write!(f, ", as {} = \"always\" ask", settings.join(" and ")),
        }
    }
}

impl CameraBlur {
    /// Which parts there are.
    pub(super) fn parts(&self) -> Parts {
        Parts {
            paths: is_there(&self.capture.paths),
            lens: is_there(&self.capture.aperture),
        }
    }

    /// What is to be said of a trial that found `worth`: where it was asked for, and where a part has gone.
    pub(super) fn decision(&self, before: Parts, worth: Worth, trial: &Trial) -> Option<Decision> {
        let parts = self.parts();
        let until = match trial.asked {
            Asked::Later(next) if self.settings.path == When::Auto => Some(next),
            _ => None,
        };
        (trial.says || parts != before).then_some(Decision {
            before,
            parts,
            worth,
            until: until.filter(|_| worth.paths <= PATHS_PAY_BESIDE_LENS),
            asked: Parts {
                paths: self.settings.path == When::Always,
                lens: self.settings.lens == When::Always,
            },
            kernels_from: None,
        })
    }

    /// Leaves out the lens, and then all paths, if they do not pay; returns the frames' errors with what stays, and what share of
    /// the error lens and paths are worth.
    pub(super) fn try_parts(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        trial: &Trial,
    ) -> Result<(Vec<f64>, Worth), TrainError> {
        let now = self.errors(world, looks)?;
        let (now, lens) = self.try_without_lens(world, looks, now, trial.refocuses)?;
        let (now, paths) = self.try_without_paths(world, looks, now, (lens, trial))?;
        Ok((now, Worth { lens, paths }))
    }

    /// Leaves the lens out if it does not pay, also with each frame in better focus; takes the frames' errors as it is, and returns
    /// them with what stays, and what share of the error the lens is worth: beyond softer frames, or where focus saved it, by itself.
    /// With `refocuses` every frame finds its best focus where the lens pays by itself, too.
    fn try_without_lens(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        now: Vec<f64>,
        refocuses: bool,
    ) -> Result<(Vec<f64>, f64), TrainError> {
        if !is_there(&self.capture.aperture) {
            return Ok((now, 0.0));
        }
        let mut without = self.clone();
        without.capture.aperture = self.capture.aperture.zeros_like();
        let (left, softer) = without.softer_frames_errors(world, looks)?;
        let worth = share_more(softer, &now);
        let pays = worth > LENS_PAYS || self.settings.lens == When::Always;
        if pays && !refocuses {
            return Ok((now, worth));
        }
        let mut focused = now.clone();
        let are_few = looks.len() < LEAST_FOCUSED * FOCUSED_FIRST;
        let (first, others): (Vec<_>, Vec<_>) =
            (0..looks.len()).partition(|frame| are_few || frame.is_multiple_of(FOCUSED_FIRST));
        self.try_focuses(world, looks, &first, &mut focused)?;
        let of_first = |errors: &[f64]| first.iter().map(|frame| errors[*frame]).sum::<f64>();
        let found = of_first(&now) / of_first(&focused);
        if pays || (1.0 + worth) * found - 1.0 > FOCUS_PROMISES {
            self.try_focuses(world, looks, &others, &mut focused)?;
        }
        if pays {
            return Ok((focused, worth));
        }
        let focused_worth = share_more(total(&left), &focused);
        if share_more(softer, &focused) > LENS_PAYS && focused_worth > FOCUSED_LENS_PAYS {
            return Ok((focused, focused_worth));
        }
        *self = without;
        Ok((left, worth))
    }

    /// The same of all paths. They are worth what they explain beyond a softer scene. Where only one of them and the lens, which is
    /// worth `lens`, is to stay, this says which.
    fn try_without_paths(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        now: Vec<f64>,
        (lens, trial): (f64, &Trial),
    ) -> Result<(Vec<f64>, f64), TrainError> {
        if !is_there(&self.capture.paths) {
            return Ok((now, 0.0));
        }
        let mut without = self.clone();
        without.capture.paths = self.capture.paths.zeros_like();
        let worth = share_more(without.softer_scene_error(world, looks)?, &now);
        let has_lens = is_there(&self.capture.aperture);
        let [lens_stays, paths_stay] = stay(has_lens.then_some(lens), worth, trial.asked);
        let paths_stay = paths_stay || self.settings.path == When::Always;
        let lens_goes = has_lens && !lens_stays && self.settings.lens != When::Always;
        if paths_stay && !lens_goes {
            return Ok((now, worth));
        }
        if !paths_stay {
            self.capture.paths = without.capture.paths;
        }
        if lens_goes {
            self.capture.aperture = self.capture.aperture.zeros_like();
        }
        Ok((self.errors(world, looks)?, worth))
    }

    /// Leaves on some frames the distance of focus that explains each best, of its own and of some between which the scene lies;
    /// `errors` are all frames', and become those with what stays.
    fn try_focuses(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        frames: &[usize],
        errors: &mut [f64],
    ) -> Result<(), TrainError> {
        let [near, far] = self.depth_range.map(|depth| self.scene_size / depth);
        for &frame in frames {
            let (look, least) = (&looks[frame], &mut errors[frame]);
            let mut best = host(self.capture.focus.clone().narrow(0, frame, 1));
            for k in 0..FOCUSES {
                let share = (k as f64 + 0.5) / FOCUSES as f64;
                let focus = [(far + share * (near - far)) as f32];
                set_row(&mut self.capture.focus, frame, &focus);
                let error = self.error(world, look)?;
                if error < *least {
                    *least = error;
                    best = focus.to_vec();
                }
            }
            set_row(&mut self.capture.focus, frame, &best);
        }
        Ok(())
    }

    /// Leaves a larger or smaller aperture if that pays; takes the frames' errors as it is, and returns them with what stays.
    pub(super) fn try_apertures(
        &mut self,
        world: &World,
        looks: &[Look<'_>],
        now: Vec<f64>,
    ) -> Result<Vec<f64>, TrainError> {
        if !is_there(&self.capture.aperture) {
            return Ok(now);
        }
        let own = self.capture.aperture.clone();
        let (mut least, mut best) = (total(&now) / (1.0 + PATHS_PAY), (now, 1.0));
        for times in [0.5, 0.7, 1.4, 2.0] {
            self.capture.aperture = own.clone() * times;
            let errors = self.errors(world, looks)?;
            if total(&errors) < least {
                least = total(&errors);
                best = (errors, times);
            }
        }
        self.capture.aperture = own * best.1;
        Ok(best.0)
    }
}

/// Whether a lens that pays by so much stays, and paths.
fn stay(lens: Option<f64>, paths: f64, asked: Asked) -> [bool; 2] {
    let late = matches!(asked, Asked::Late);
    let left = matches!(asked, Asked::Later(_));
    let Some(lens) = lens else {
        let least = if late { PATHS_PAY_LATE } else { PATHS_PAY };
        return [false, left || paths > least];
    };
    if paths > PATHS_PAY_BESIDE_LENS && (paths > lens || !late) {
        return [true, true];
    }
    let instead = paths > PATHS_PAY && paths > PATHS_INSTEAD * lens;
    [!instead, instead || left]
}

/// Whether any number of a part is not zero.
fn is_there(part: &Tensor<2>) -> bool {
    host(part.clone()).iter().any(|number| *number != 0.0)
}

/// By what share an error of all frames together is larger than theirs.
fn share_more(error: f64, errors: &[f64]) -> f64 {
    error / total(errors) - 1.0
}

#[cfg(test)]
mod tests {
    use super::{Asked, Decision, Parts, Worth, stay};

    fn parts([lens, paths]: [bool; 2]) -> Parts {
        Parts { paths, lens }
    }

    /// Of a trial that left these parts, lens and paths, of those that there were.
    fn decision(before: [bool; 2], after: [bool; 2]) -> Decision {
        Decision {
            before: parts(before),
            parts: parts(after),
            worth: Worth {
                lens: 0.25,
                paths: 0.5,
            },
            until: None,
            asked: parts([false, false]),
            kernels_from: None,
        }
    }

    #[test]
    fn only_what_was_there_is_said_to_go_and_told_how_it_stays() {
        let said = |before, after| decision(before, after).to_string();
        for (before, after) in [
            ([true, true], [true, true]),
            ([true, true], [true, false]),
            ([true, true], [false, true]),
            ([true, false], [true, false]),
            ([false, true], [false, true]),
        ] {
            let said = said(before, after);
            for (k, without, keeps) in [
                (0, "+25.0 % without a lens", "camera.lens = \"always\""),
                (1, "+50.0 % without paths", "camera.path = \"always\""),
            ] {
                assert_eq!(said.contains(without), before[k], "{said}");
                assert_eq!(said.contains(keeps), before[k] && !after[k], "{said}");
            }
        }
        for gone in [[true, true], [true, false], [false, true]] {
            let said = said(gone, [false, false]);
            assert!(said.contains("no blur is modelled from here on"), "{said}");
        }
    }

    #[test]
    fn what_stays_since_it_is_asked_for_is_told_so() {
        let said = |after, asked, kernels_from| {
            Decision {
                asked: parts(asked),
                kernels_from,
                ..decision([true, true], after)
            }
            .to_string()
        };
        let lens = said([true, false], [true, false], None);
        assert!(
            lens.ends_with(", as `camera.lens` = \"always\" asks"),
            "{lens}"
        );
        let both = said([true, true], [true, true], None);
        assert!(both.contains("`camera.lens` and `camera.path`"), "{both}");
        let found = said([true, true], [false, false], None);
        assert!(!found.contains("asks"), "{found}");
        // Kernels that stand on the camera explain what it does not.
        let over = said([false, false], [false, false], Some(500));
        assert!(
            over.contains("kernels begin behind iteration 500"),
            "{over}"
        );
        assert!(!over.contains("no blur is modelled"), "{over}");
    }

    /// What trials came to, on videos of which it is known what blurs them, and on real ones: the worth of the lens and of the paths.
    #[test]
    fn lens_and_paths_stay_where_there_is_what_they_explain() {
        use Asked::{Early, Late, Later};
        for (scene, asked, lens, paths, stays) in [
            ("both-a", Early, Some(0.061), 0.41, [true, true]),
            ("motion-a", Early, None, 1.57, [false, true]),
            ("defocus-a", Early, Some(0.143), 0.088, [true, false]),
            ("defocus-a", Later(703), Some(0.154), 0.095, [true, true]),
            ("defocus-a", Late, Some(0.682), 0.281, [true, false]),
            ("a quarter", Early, Some(0.05), 0.063, [true, false]),
            ("a quarter", Late, Some(0.233), 0.135, [true, false]),
            ("toycar", Early, Some(0.046), 0.104, [false, true]),
            ("toycar", Later(703), None, 0.014, [false, true]),
            ("toycar", Late, None, 0.172, [false, true]),
            ("toycar", Late, Some(0.086), 0.17, [true, true]),
            ("kitchen", Early, None, -0.028, [false, false]),
            ("kitchen", Late, None, 0.032, [false, true]),
            ("sharp-a", Late, None, -0.001, [false, false]),
        ] {
            assert_eq!(stay(lens, paths, asked), stays, "{scene}, {asked:?}");
        }
        assert_eq!(stay(Some(0.2), f64::NAN, Late), [true, false]);
    }
}
