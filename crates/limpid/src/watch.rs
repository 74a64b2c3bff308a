//! `limpid train --watch`: the report of a run as it is now, served on the loopback address while it trains.

use crate::config::Config;
use crate::failure::{Failure, with_causes};
use crate::log;
use crate::report::{self, Gallery, Live};
use crate::say::{conclude, detail, say};
use crate::serve::{Held, Server};
use crate::sheet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};
use trainer::Trainer;

/// A snapshot comes no sooner than after so many times what the last one took: they take about a hundredth of the time.
const PAUSES: u32 = 99;
/// Who asked so short a time ago is still there: pages ask every two seconds.
const STILL_THERE: Duration = Duration::from_secs(6);
/// At the end a page that is still there is given so long to take the whole report.
const LAST_WAIT: Duration = Duration::from_secs(8);

/// Arguments of what is watched.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(crate) struct WatchArguments {
    /// While it trains, serve the report of the run as it is to this machine's browser; where somebody looks, it is new every so
    /// many seconds, or less often where it would slow training by more than a hundredth [default: 10].
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, require_equals = true, default_missing_value = "10", value_parser = seconds)]
    watch: Option<Duration>,
    /// With --watch: port on 127.0.0.1 [default: any that is free].
    #[arg(
        long,
        value_name = "PORT",
        requires = "watch",
        default_value_t = 0,
        hide_default_value = true
    )]
    port: u16,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    Duration::try_from_secs_f64(seconds).map_err(|problem| problem.to_string())
}

impl WatchArguments {
    /// Takes the port, if a run is to be watched: before anything is loaded or replaced, so that one that is taken is told at once.
    pub(crate) fn listen(self) -> Result<Option<Listening>, Failure> {
        let Some(every) = self.watch else {
            return Ok(None);
        };
        let held: Arc<Held> = Arc::default();
        let server = Server::of_memory(Arc::clone(&held), self.port)
            .map_err(|e| format!("{e}: 127.0.0.1, port {}", self.port))?;
        Ok(Some(Listening {
            server,
            held,
            every,
        }))
    }
}

/// A port that a run will be watched at.
pub(crate) struct Listening {
    server: Server,
    held: Arc<Held>,
    every: Duration,
}

/// A run that is watched.
pub(crate) struct Watch {
    held: Arc<Held>,
    /// The run's folder.
    out: PathBuf,
    every: Duration,
    /// When the last snapshot was taken, how many there were, and how long until the next one.
    last: Instant,
    snapshots: usize,
    pause: Duration,
}

impl Watch {
    /// Serves the run in a folder from now on.
    pub(crate) fn start(
        listening: Listening,
        (trainer, config): (&Trainer, &Config),
        out: &Path,
    ) -> Result<Self, Failure> {
        let Listening {
            server,
            held,
            every,
        } = listening;
        let mut watch = Self {
            held,
            out: out.to_owned(),
            every,
            last: Instant::now(),
            snapshots: 0,
            pause: every,
        };
        watch.take(trainer, config)?;
        conclude!("watch it at http://{}/", server.address());
        std::thread::spawn(|| server.run());
        Ok(watch)
    }

    /// Takes a snapshot where one is due and somebody looks. One that fails is said, and training goes on.
    pub(crate) fn look(&mut self, trainer: &Trainer, config: &Config) {
        if self.last.elapsed() < self.pause || !self.held.is_asked_since(self.last) {
            return;
        }
        if let Err(problem) = self.take(trainer, config) {
            say!("warning: no snapshot: {}", with_causes(&*problem));
        }
    }

    fn take(&mut self, trainer: &Trainer, config: &Config) -> Result<(), Failure> {
        let began = Instant::now();
        self.snapshots += 1;
        let live = Live {
            snapshot: self.snapshots,
            iterations: trainer.settings().iterations,
        };
        let curves = log::read(&self.out.join(log::LOG_FILE));
        let made = gallery(trainer)
            .and_then(|gallery| report::live(trainer.run(), config, &gallery, (&curves, live)));
        self.last = Instant::now();
        let took = self.last - began;
        self.pause = self.every.max(took * PAUSES);
        detail!("snapshot {} in {:.2} s", self.snapshots, took.as_secs_f64());
        let (html, splats) = made?;
        self.held.put(
            self.snapshots,
            vec![("", html.into_bytes()), (report::SIDE_FILE, splats)],
        );
        Ok(())
    }

    /// Gives who still looks the report of the whole run.
    pub(crate) fn end(mut self) {
        let names = [("", report::FILE), (report::SIDE_FILE, report::SIDE_FILE)];
        let read = |(name, file)| Some((name, std::fs::read(self.out.join(file)).ok()?));
        let files = names.into_iter().filter_map(read).collect();
        self.snapshots += 1;
        let began = Instant::now();
        let is_there = began
            .checked_sub(STILL_THERE)
            .is_some_and(|then| self.held.is_asked_since(then));
        self.held.put(self.snapshots, files);
        while is_there && !self.held.is_taken() && began.elapsed() < LAST_WAIT {
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

/// Pictures of a few training frames and of a test view: those of all would take too long.
fn gallery(trainer: &Trainer) -> Result<Gallery, Failure> {
    let (run, scene) = (trainer.run(), trainer.scene());
    let views = run.views();
    let mut gallery = Gallery::new(&views.train, &views.test);
    let shown = sheet::frames(views.train.len());
    for (index, frame) in scene.frames.iter().enumerate() {
        if shown.contains(&index) {
            let view = run.render_training_view(index)?;
            gallery.add_frame(Some(&frame.view.image), &view, None);
        } else {
            gallery.leave_out();
        }
    }
    for (index, view) in views.test.iter().enumerate() {
        if index == views.test.len() / 2 {
            let image = run.render_view(&view.camera, &view.cam_from_world, view.time)?;
            let truth = scene.test.get(index).map(|view| &view.image);
            gallery.add_test(&image, truth);
        } else {
            gallery.leave_out();
        }
    }
    Ok(gallery)
}
