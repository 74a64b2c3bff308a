//! When things happen in a run of n iterations (design: at 40,000 as in the paper, shorter runs scale).

use crate::settings::Settings;

/// Length of the run that the paper's moments are given for.
pub const REFERENCE_ITERATIONS: usize = 40_000;

/// The moments of one run; iterations count from 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    /// Number of iterations n.
    pub iterations: usize,
    /// Dynamic Gaussians are densified at the end of this iteration.
    pub densify_dynamic_at: Option<usize>,
    /// Unseen views are used after this iteration…
    pub unseen_from: Option<usize>,
    /// … at every iteration that this divides.
    pub unseen_every: usize,
    /// The iterations after which the blur model starts or changes, its start first; none where blur is not modelled.
    pub blur_moments: Vec<usize>,
    /// The iteration after which trials leave the camera alone, where there is a camera.
    pub camera_settled: Option<usize>,
    num_frames: usize,
    control_from: usize,
    control_until: usize,
    control_every: usize,
    prune_scale_from: usize,
    sh_degree_every: f64,
    sh_degree: usize,
    opacity_reset_every: usize,
}

/// What a run of a scene models, as far as the schedule cares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Modelled {
    /// There are dynamic Gaussians.
    pub motion: bool,
    /// There are unseen views.
    pub unseen: bool,
    /// See [`Schedule::blur_moments`].
    pub blur_moments: Vec<usize>,
    /// See [`Schedule::camera_settled`].
    pub camera_settled: Option<usize>,
}

/// In runs that are shorter than this, Gaussians that move, paths and focus learn the faster the shorter the run is; in longer
/// ones paths learn slower…
pub(crate) const PACED_ITERATIONS: usize = 3000;
/// … where there are so many frames at most; of more, each is seen as rarely as in a shorter run.
const PACED_FRAMES: usize = 24;
/// The same of Gaussians that stand still. (RESULTS.md, "Static Gaussians learn faster", has what was seen.)
const STATIC_PACED_ITERATIONS: usize = 12_000;
/// For so many iterations they come closer at their whole rate; from then on what single frames leave in them counts for more.
const STEADY_ITERATIONS: f64 = 1000.0;
/// So many times faster at most, Gaussians…
const FASTEST_GAUSSIANS: f64 = 4.0;
/// … and paths.
const FASTEST_PATHS: f64 = 8.0;

/// A moment of a run of 40,000 iterations in one of n.
pub(crate) fn scaled_moment(moment: usize, n: usize) -> usize {
    (moment as f64 * (n as f64 / REFERENCE_ITERATIONS as f64)) as usize
}

impl Schedule {
    /// The schedule of a run on a scene of `num_frames` training frames.
    #[must_use]
    pub fn new(settings: &Settings, num_frames: usize, modelled: Modelled) -> Self {
        let n = settings.iterations;
        let s = n as f64 / REFERENCE_ITERATIONS as f64;
        let at = |moment| scaled_moment(moment, n);
        Self {
            iterations: n,
            densify_dynamic_at: (modelled.motion && settings.motion.densify)
                .then(|| at(settings.motion.densify_at).max(1)),
            unseen_from: modelled.unseen.then(|| at(settings.unseen.from)),
            unseen_every: settings.unseen.every,
            blur_moments: modelled.blur_moments,
            camera_settled: modelled.camera_settled,
            num_frames,
            control_from: at(settings.gaussians.control_from),
            control_until: at(settings.gaussians.control_until),
            control_every: at(settings.gaussians.control_every).max(num_frames).max(25),
            prune_scale_from: at(settings.gaussians.prune_scale_from),
            sh_degree_every: settings.gaussians.sh_degree_every as f64 * s,
            sh_degree: settings.gaussians.sh_degree,
            opacity_reset_every: if n >= 10_000 {
                settings.gaussians.opacity_reset_every
            } else {
                0
            },
        }
    }

    /// Whether iteration `it` shows an unseen view.
    #[must_use]
    pub fn is_unseen(&self, it: usize) -> bool {
        self.unseen_from.is_some_and(|from| it > from) && it.is_multiple_of(self.unseen_every)
    }

    /// Whether screen-space gradients are gathered at iteration `it`.
    #[must_use]
    pub fn gathers_density(&self, it: usize) -> bool {
        it < self.control_until
    }

    /// Whether density control acts at the end of iteration `it`.
    #[must_use]
    pub fn controls_density(&self, it: usize) -> bool {
        it > self.control_from && it < self.control_until && it.is_multiple_of(self.control_every)
    }

    /// Whether density control removes Gaussians that are too large at iteration `it`.
    #[must_use]
    pub fn prunes_scale(&self, it: usize) -> bool {
        it > self.prune_scale_from
    }

    /// Degree of the spherical harmonics at iteration `it`.
    #[must_use]
    pub fn sh_degree_at(&self, it: usize) -> usize {
        self.sh_degree
            .min((it as f64 / self.sh_degree_every) as usize)
    }

    /// Whether opacities are reset at the end of iteration `it`: only while density control runs,
    /// never within 1,000 iterations before another event and never after blur is on.
    #[must_use]
    pub fn resets_opacity(&self, it: usize) -> bool {
        if self.opacity_reset_every == 0
            || !it.is_multiple_of(self.opacity_reset_every)
            || it >= self.control_until
            || self.blur_moments.first().is_some_and(|&start| it > start)
        {
            return false;
        }
        let others = [self.densify_dynamic_at, self.unseen_from];
        let mut events = others.iter().flatten().chain(&self.blur_moments);
        !events.any(|&event| event >= it && event <= it + 1000)
    }

    /// Factor on a learning rate that falls log-linearly from 1 to `final_share` over `length` iterations of 40,000.
    #[must_use]
    pub fn decay(&self, it: usize, final_share: f64, length: usize) -> f64 {
        let scaled = length as f64 * self.iterations as f64 / REFERENCE_ITERATIONS as f64;
        let progress = (it as f64 / scaled.max(1.0)).min(1.0);
        final_share.powf(progress)
    }

    /// Factor by which kernels learn faster in short runs: `min(limit, s^-1/2)`, at least 1.
    #[must_use]
    pub fn short_run_boost(&self, limit: f64) -> f64 {
        (REFERENCE_ITERATIONS as f64 / self.iterations as f64)
            .sqrt()
            .min(limit)
            .max(1.0)
    }

    /// How many times as far a step has to lead for what would have so many iterations.
    fn pace(&self, iterations: usize) -> f64 {
        iterations as f64 / self.iterations as f64
    }

    /// Factor on the rates of Gaussians that move: `3,000 / iterations`, between 1 and 4.
    #[must_use]
    pub fn dynamic_pace(&self) -> f64 {
        self.pace(PACED_ITERATIONS).clamp(1.0, FASTEST_GAUSSIANS)
    }

    /// Factor on the rates of Gaussians that stand still: `12,000 / iterations`, between 1 and 4.
    #[must_use]
    pub fn static_pace(&self) -> f64 {
        let pace = self.pace(STATIC_PACED_ITERATIONS);
        pace.clamp(1.0, FASTEST_GAUSSIANS)
    }

    /// What is left at iteration `it` of the rates of what stands still, whatever the length of the run: all for the first 1,000
    /// iterations, then `(1,000 / it)²`, and no less than `final_share`.
    #[must_use]
    pub fn settled(it: usize, final_share: f64) -> f64 {
        let left = STEADY_ITERATIONS / (it as f64).max(STEADY_ITERATIONS);
        left.powi(2).max(final_share)
    }

    /// Factor on the rate of paths, with x = 3,000 / iterations, or with more than 24 frames x = 125 frames / iterations:
    /// `min(8, x)` where that is more than one, else `x^1/2`.
    ///
    /// A frame is seen so rarely in a short run that its path has to come as far in fewer steps. In a long one, Adam steps by
    /// its rate however small the gradient is, so that a path that nothing holds walks at random, as far as the rate times the
    /// root of its steps; the scene goes with it.
    #[must_use]
    pub fn path_pace(&self) -> f64 {
        let rarer = (self.num_frames as f64 / PACED_FRAMES as f64).max(1.0);
        let pace = self.pace(PACED_ITERATIONS) * rarer;
        pace.max(pace.min(1.0).sqrt()).min(FASTEST_PATHS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With the moments of the paper's blur model, which are its own.
    fn all(n: usize) -> Modelled {
        Modelled {
            motion: true,
            unseen: true,
            blur_moments: [3500, 3700, 5500, 4500]
                .map(|moment| scaled_moment(moment, n))
                .to_vec(),
            camera_settled: None,
        }
    }

    fn schedule(n: usize, frames: usize) -> Schedule {
        Schedule::new(
            &Settings {
                iterations: n,
                ..Settings::default()
            },
            frames,
            all(n),
        )
    }

    fn first(n: usize, happens: impl Fn(usize) -> bool) -> Option<usize> {
        (1..=n).find(|&it| happens(it))
    }

    #[test]
    fn at_40000_events_fire_at_the_papers_moments() {
        let s = schedule(40_000, 24);
        assert_eq!(s.densify_dynamic_at, Some(2500));
        let unseen: Vec<usize> = (1..=40_000).filter(|&it| s.is_unseen(it)).collect();
        assert_eq!(
            (unseen[0], unseen[1], *unseen.last().expect("some")),
            (3005, 3010, 40_000)
        );
        let control: Vec<usize> = (1..=40_000).filter(|&it| s.controls_density(it)).collect();
        assert_eq!(
            (control.len(), control[0], *control.last().expect("some")),
            (144, 600, 14_900)
        );
        assert_eq!(
            [999, 1000, 1999, 2000, 2999, 3000, 40_000].map(|it| s.sh_degree_at(it)),
            [0, 1, 1, 2, 2, 3, 3]
        );
        // A means' rate of 8e-4 after a third of its way to a hundredth.
        let expected = 8e-4 * 0.01_f64.powf(1.0 / 3.0);
        assert!((8e-4 * s.decay(10_000, 0.01, 30_000) - expected).abs() < 1e-12);
        assert_eq!(
            [30_000, 40_000].map(|it| s.decay(it, 0.01, 30_000)),
            [0.01; 2]
        );
    }

    #[test]
    fn opacity_is_never_reset_before_an_event_or_under_blur() {
        let s = schedule(40_000, 24);
        assert_eq!(
            first(40_000, |it| s.resets_opacity(it)),
            None,
            "3,000 lies 500 before blur"
        );
        let modelled = Modelled {
            blur_moments: Vec::new(),
            ..all(40_000)
        };
        let settings = Settings {
            iterations: 40_000,
            ..Settings::default()
        };
        let sharp = Schedule::new(&settings, 24, modelled);
        let resets: Vec<usize> = (1..=40_000)
            .filter(|&it| sharp.resets_opacity(it))
            .collect();
        assert_eq!(
            resets,
            vec![6000, 9000, 12_000],
            "unseen views follow on 3,000"
        );
        assert!((1..=9999).all(|it| !schedule(9999, 24).resets_opacity(it)));
    }

    #[test]
    fn shorter_runs_keep_the_order_and_the_minimum_distances() {
        let s = schedule(3000, 24);
        assert_eq!(s.densify_dynamic_at, Some(187));
        assert_eq!(s.unseen_from, Some(225));
        assert_eq!(first(3000, |it| s.controls_density(it)), Some(50));
        assert_eq!(schedule(300, 24).densify_dynamic_at, Some(18));
        for n in [200, 300, 1200, 3000, 10_000, 40_000] {
            let s = schedule(n, 24);
            let control = (1..=n)
                .filter(|&it| s.controls_density(it))
                .collect::<Vec<_>>();
            assert!(
                control.windows(2).all(|w| w[1] - w[0] >= 25),
                "at {n}: {control:?}"
            );
            assert!(s.densify_dynamic_at < s.unseen_from, "at {n}");
            let steps = (1..n)
                .filter(|&it| s.sh_degree_at(it) != s.sh_degree_at(it + 1))
                .count();
            assert_eq!((steps, s.sh_degree_at(n)), (3, 3), "at {n}");
        }
    }

    #[test]
    fn what_is_not_modelled_never_happens() {
        let none = Modelled {
            motion: false,
            unseen: false,
            blur_moments: Vec::new(),
            camera_settled: None,
        };
        let s = Schedule::new(
            &Settings {
                iterations: 3000,
                ..Settings::default()
            },
            24,
            none,
        );
        assert_eq!(s.densify_dynamic_at, None);
        assert!((1..=3000).all(|it| !s.is_unseen(it)));
    }

    #[test]
    fn gaussians_and_paths_come_as_far_in_short_runs_and_paths_walk_no_farther_in_long_ones() {
        let pace_of = |n: usize, frames: usize| schedule(n, frames).path_pace();
        for (n, frames) in [(3000, 36), (3000, 93), (1500, 48), (40_000, 300)] {
            let (seen, as_rarely) = (n * 24 / frames, pace_of(n, frames));
            assert!(
                (as_rarely / pace_of(seen, 24) - 1.0).abs() < 1e-3,
                "{n}, {frames}"
            );
        }
        assert!(
            (pace_of(3000, 8) - 1.0).abs() < 1e-12,
            "fewer frames are no slower"
        );
        let pace = |n: usize| pace_of(n, 24);
        let walk = |n: usize| pace(n) * (n as f64).sqrt();
        for n in [3000, 10_000, 40_000, 200_000] {
            assert!((walk(n) / walk(3000) - 1.0).abs() < 1e-12, "{n}");
        }
        for n in [375, 500, 1000, 2999] {
            let steps = pace(n) * n as f64;
            assert!((steps / 3000.0 - 1.0).abs() < 1e-12, "{n}");
        }
        for (n, moving, still) in [
            (200, 4.0, 4.0),
            (750, 4.0, 4.0),
            (1500, 2.0, 4.0),
            (3000, 1.0, 4.0),
            (6000, 1.0, 2.0),
            (12_000, 1.0, 1.0),
            (40_000, 1.0, 1.0),
        ] {
            let schedule = schedule(n, 24);
            let paces = (schedule.dynamic_pace(), schedule.static_pace());
            assert_eq!(paces, (moving, still), "{n}");
        }
        assert_eq!(pace(200), pace(375), "a limit");
    }

    #[test]
    fn short_runs_learn_faster_up_to_a_limit() {
        assert!((schedule(40_000, 24).short_run_boost(4.0) - 1.0).abs() < 1e-12);
        assert!((schedule(10_000, 24).short_run_boost(4.0) - 2.0).abs() < 1e-12);
        assert!((schedule(300, 24).short_run_boost(4.0) - 4.0).abs() < 1e-12);
    }
}
