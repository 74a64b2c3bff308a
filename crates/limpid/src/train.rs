//! `limpid train`.

use crate::asked::TrainArguments;
use crate::budget::{self, Forecast};
use crate::check;
use crate::checkpoints::{self, Checkpoints};
use crate::config::{self, CONFIG_FILE, Config};
use crate::failure::{Failure, with_causes};
use crate::lengths::{HELD_BACK, Lengths, Next};
use crate::lock::Lock;
use crate::log::{LOG_FILE, Log};
use crate::memory;
use crate::outputs;
use crate::progress::{Progress, during};
use crate::report;
use crate::say::{self, conclude, say};
use crate::shell::quoted;
use crate::stop::{INTERRUPTED, SaveRequest, Stop};
use crate::watch::{Listening, Watch};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;
use toml::{Table, Value};
use trainer::{Change, Settings, TrainError, Trainer, differences};

/// A run that is about to be trained, alone in its folder.
struct Started {
    out: PathBuf,
    config: Config,
    trainer: Trainer,
    checkpoints: Checkpoints,
    /// Where the run is trained in several lengths.
    lengths: Option<Lengths>,
    lock: Lock,
    /// What is to be said of the time that it is said to take.
    remark: String,
}

pub(crate) fn run(arguments: &TrainArguments) -> Result<ExitCode, Failure> {
    if arguments.dry_run {
        say::print(&serde_json::to_string_pretty(&configured(arguments)?)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    // From the beginning: the signal ends a program that does not know it.
    let save = SaveRequest::listen()?;
    let watch = arguments.watch.listen()?;
    let mut started = if arguments.resume {
        go_on(arguments)?
    } else {
        begin(arguments)?
    };
    let ended = started.train(&save, watch);
    ended.map_err(|error| {
        let error = with_causes(&*error);
        if !started.lock.holds() {
            // What is there now is another run's.
            return error.into();
        }
        format!("{error}; {}", started.checkpoints.account()).into()
    })
}

impl Started {
    /// Trains, and writes what comes of it.
    fn train(&mut self, save: &SaveRequest, watch: Option<Listening>) -> Result<ExitCode, Failure> {
        let stop = Stop::listen()?;
        let mut watch = match watch {
            Some(listening) => Some(Watch::start(
                listening,
                (&self.trainer, &self.config),
                &self.out,
            )?),
            None => None,
        };
        loop {
            self.iterate(&stop, save, watch.as_mut())?;
            if stop.is_asked() || !self.trainer.is_done() {
                break;
            }
            stop.unsaved();
            let again = self.begins_again(&stop)?;
            stop.saved();
            if !again {
                break;
            }
        }
        let Self {
            out,
            config,
            trainer,
            ..
        } = self;
        if !trainer.is_done() {
            conclude!(
                "stopped after iteration {} of {}; to go on:\n  {}",
                trainer.iteration(),
                trainer.settings().iterations,
                to_go_on(out)
            );
            return Ok(ExitCode::from(INTERRUPTED));
        }
        let evaluation = during("rendering and scoring", || {
            outputs::write_all(trainer, config, out)
        })?;
        if let Some(watch) = watch {
            watch.end();
        }
        conclude!("{}", outputs::summary(&evaluation));
        conclude!(
            "{:.0} s of training; results in {}; {} shows them",
            trainer.run().seconds(),
            out.display(),
            out.join(report::FILE).display()
        );
        Ok(ExitCode::SUCCESS)
    }

    /// Makes of a run that is done one of twice the length, where that is asked for and pays, and no end. Says whether it did.
    fn begins_again(&mut self, stop: &Stop) -> Result<bool, Failure> {
        let Some(lengths) = &mut self.lengths else {
            return Ok(false);
        };
        let log_file = self.out.join(LOG_FILE);
        let log = match std::fs::read(&log_file) {
            // Removed on the way: what was trained is there all the same.
            Err(e) if e.kind() == ErrorKind::NotFound => Vec::new(),
            read => read.map_err(|e| format!("{e}: {}", log_file.display()))?,
        };
        let (said, next) = lengths.next(&mut self.trainer, log, || stop.is_asked())?;
        say!("{said}");
        self.config.settings.iterations = self.trainer.settings().iterations;
        // Where config.json says more iterations than a checkpoint does, a run is made longer: at no time may that be so here.
        match next {
            Next::Done => Ok(false),
            Next::Longer => {
                // The one before is of this length, too, should this one be damaged.
                self.checkpoints.save(&self.trainer)?;
                self.checkpoints.save(&self.trainer)?;
                io::write_json(&self.out.join(CONFIG_FILE), &self.config)?;
                Ok(true)
            }
            Next::Before(log) => {
                io::write_json(&self.out.join(CONFIG_FILE), &self.config)?;
                io::write_atomic(&log_file, |file| file.write_all(&log))?;
                self.checkpoints.save(&self.trainer)?;
                Ok(false)
            }
        }
    }

    /// Trains until all iterations are done or it is asked to stop, and saves.
    fn iterate(
        &mut self,
        stop: &Stop,
        save: &SaveRequest,
        mut watch: Option<&mut Watch>,
    ) -> Result<(), Failure> {
        let Self {
            out,
            config,
            trainer,
            checkpoints,
            lock,
            remark,
            ..
        } = self;
        stop.unsaved();
        let mut log = Log::open(out, trainer.iteration(), trainer.settings().iterations)?;
        let mut progress = Progress::new(trainer.iteration(), trainer.settings().iterations);
        let memory = memory::expected(trainer, config);
        let mut forecast = Forecast::new(trainer, memory, remark)?;
        while !trainer.is_done() && !stop.is_asked() {
            let started = Instant::now();
            let step = trainer.step();
            trainer.count_seconds(started.elapsed().as_secs_f64());
            let report = match step {
                Ok(report) => report,
                Err(error) => {
                    progress.finish();
                    // Where the renderer refuses a parameter, the state is no good any more: the checkpoint on disk stays.
                    let is_whole = matches!(error, TrainError::NotFinite { .. });
                    if is_whole {
                        let saved =
                            restore(out, config, lock).and_then(|()| checkpoints.save(trainer));
                        if let Err(problem) = saved {
                            conclude!("the checkpoint cannot be saved: {}", with_causes(&*problem));
                        }
                    }
                    return Err(error.into());
                }
            };
            progress.show(&report);
            if let Some(line) = forecast.after(report.iteration, Instant::now()) {
                say!("{line}");
            }
            log.add(&report, trainer.run().seconds());
            if let Some(watch) = &mut watch {
                watch.look(trainer, config);
            }
            let asked = save.take();
            if !trainer.is_done() && (asked || checkpoints.is_due(report.iteration)) {
                checkpoints.save_on_the_way(trainer, || restore(out, config, lock));
            }
        }
        progress.finish();
        restore(out, config, lock)?;
        checkpoints.save(trainer)?;
        stop.saved();
        Ok(())
    }
}

/// Makes a run's folder anew where it was removed, or moved away, while it trained: without its configuration nothing could go on
/// with what is written there. An error where another run has taken its place.
fn restore(out: &Path, config: &Config, lock: &mut Lock) -> Result<(), Failure> {
    let file = out.join(CONFIG_FILE);
    if !lock.holds() {
        std::fs::create_dir_all(out).map_err(|e| format!("{e}: {}", out.display()))?;
        let gone = "this run's own folder was moved, or removed, and with it its checkpoint, from which --resume goes on";
        let taken = Lock::of(out).map_err(|e| format!("{e}; {gone}"))?;
        // Where only the lock's file was removed, it is still this one's.
        let is_own = || Config::of_run(out).is_ok_and(|found| found == *config);
        if file.exists() && !is_own() {
            return Err(format!(
                "{} is another run's by now, and nothing is written there; {gone}",
                out.display()
            )
            .into());
        }
        *lock = taken;
    }
    if file.exists() {
        return Ok(());
    }
    say!(
        "warning: {} is gone: it is written again, in a folder made anew if need be; what else was removed, such as the log, is lost",
        file.display()
    );
    Ok(io::write_json(&file, config)?)
}

/// What a new run is asked for.
fn configured(asked: &TrainArguments) -> Result<Config, Failure> {
    let mut defaults = asked.defaults();
    if asked.until_done {
        defaults.frames.held_back = HELD_BACK;
    }
    let mut config = config::from_table(asked.table()?, &Config::of(defaults))?;
    if asked.until_done && config.settings.frames.held_back == 0.0 {
        return Err(format!(
            "--until-done goes by pixels that are held back, and frames.held_back is asked to be 0 (the config.json of a run says so \
             too): leave it out, or add --set frames.held_back={HELD_BACK}"
        )
        .into());
    }
    // An absolute path, so that the run can be repeated from anywhere.
    if let Some(scene) = &mut config.run.scene {
        *scene = absolute(scene)?;
    }
    Ok(config)
}

/// A new run.
fn begin(asked: &TrainArguments) -> Result<Started, Failure> {
    let began = Instant::now();
    let mut config = configured(asked)?;
    let out = asked.out(config.run.scene.as_deref())?;
    let device = config.run.backend.device()?;
    outputs::check_folder(&out, asked.force)?;
    // A folder that is not there yet is made once it is clear that there will be a run.
    let early = out.is_dir().then(|| Lock::of(&out)).transpose()?;
    let scene = during("reading the scene", || config.open_scene())?;
    // What it is scored against is read at the end: better to fail now.
    scene.truth()?;
    for note in &scene.notes {
        say!("note: {note}");
    }
    check::before_training(&scene, &config.settings, asked.unchecked)?;
    let settings = config.settings.clone();
    let mut trainer = during("fitting motion and placing Gaussians", || {
        Trainer::new(scene, settings, &device)
    })?;
    introduce(&trainer, &config);
    if let Some(minutes) = asked.minutes {
        let lines = during("trying how long an iteration takes", || {
            budget::fit(&mut trainer, minutes, began)
        })?;
        lines.iter().for_each(|line| say!("{line}"));
    }
    let most = trainer.settings().iterations;
    let (lengths, remark) = if asked.until_done {
        let remark = format!("; this is one length of up to {most}, and longer ones may follow");
        (Some(Lengths::begin(&mut trainer)?), remark)
    } else if asked.minutes.is_none() {
        (None, "; --minutes M makes a run of M minutes".to_owned())
    } else {
        (None, String::new())
    };
    config.settings.iterations = trainer.settings().iterations;
    std::fs::create_dir_all(&out).map_err(|e| format!("{e}: {}", out.display()))?;
    let lock = match early {
        Some(lock) => lock,
        None => Lock::of(&out)?,
    };
    // Another run may have come and gone since.
    outputs::check_folder(&out, asked.force)?;
    // Only now: a mistake in the arguments or the scene costs no earlier results.
    outputs::clear_folder(&out)?;
    io::write_json(&out.join(CONFIG_FILE), &config)?;
    Ok(Started {
        checkpoints: Checkpoints::new(&out, trainer.settings(), None),
        out,
        config,
        trainer,
        lengths,
        lock,
        remark,
    })
}

/// Says what was found in the scene of a run, what trials have decided so far, and where memory may not do.
fn introduce(trainer: &Trainer, config: &Config) {
    let found = trainer.survey().notes.iter();
    for note in found.chain(trainer.run().decisions()) {
        say!("{note}");
    }
    memory::warn(trainer, config);
}

/// The run in the results' folder.
fn go_on(asked: &TrainArguments) -> Result<Started, Failure> {
    let mut table = Table::new();
    for profile in differences(&asked.defaults(), &Settings::default()) {
        config::insert(&mut table, &profile.setting, Value::try_from(profile.here)?);
    }
    config::merge(&mut table, asked.table()?);
    let says_a_length = asked.says_a_length()?;
    if !says_a_length {
        // A profile, a preset or a file that it began with is no wish for another length than it was given then.
        table.remove("iterations");
    }
    let scene = table.get("scene").and_then(Value::as_str).map(Path::new);
    let scene = scene.map(absolute).transpose()?;
    let out = asked.out(scene.as_deref())?;
    let found = Config::of_run(&out)?;
    let lock = Lock::of(&out)?;
    let mut config = config::from_table(table, &found)?;
    config.run.scene = scene.or_else(|| found.run.scene.clone());
    found.check_reading(&config.run)?;

    let mut run = checkpoints::open(&out, &config)?;
    let edited = differences(&found.settings, run.settings());
    let trained = run.settings().iterations;
    let is_between = run.iteration() == 0 || run.is_done();
    if !says_a_length && config.settings.iterations < trained && is_between {
        // It ended on its way to another length (`--until-done`), before config.json or a checkpoint said so.
        say!("note: the checkpoint is that of a run of {trained} iterations, and is gone on with");
        config.settings.iterations = trained;
    }
    let changed = run.change(config.settings.clone(), asked.allow_change);
    let changes = changed.map_err(|error| -> Failure {
        match &error {
            TrainError::OtherSetting { setting, .. }
                if edited.iter().any(|edit| edit.setting == *setting) =>
            {
                format!("{}: {error}", out.join(CONFIG_FILE).display()).into()
            }
            _ => error.into(),
        }
    })?;
    let trainer = during("reading the scene", || -> Result<_, Failure> {
        Ok(Trainer::resume(run, config.open_scene()?)?)
    })?;
    introduce(&trainer, &config);
    config.changes = trainer.run().changes().to_vec();
    say!(
        "going on after iteration {} of {}",
        trainer.iteration(),
        trainer.settings().iterations
    );
    for change in &changes {
        say!("{}", consequence(change, trainer.schedule().iterations));
    }
    if config != found {
        io::write_json(&out.join(CONFIG_FILE), &config)?;
    }
    let last = Some(trainer.iteration());
    let mut checkpoints = Checkpoints::new(&out, trainer.settings(), last);
    if !changes.is_empty() {
        // What config.json says, the checkpoint says too.
        checkpoints.save(&trainer)?;
    }
    Ok(Started {
        out,
        config,
        trainer,
        checkpoints,
        lengths: None,
        lock,
        remark: String::new(),
    })
}

/// What a change means for the rest of a run whose schedule is one of so many iterations.
fn consequence(change: &Change, scheduled: usize) -> String {
    let Change {
        iteration,
        setting,
        from,
        to,
    } = change;
    if setting == "iterations" {
        format!(
            "iterations: {to} in the place of {from}. The schedule stays that of {scheduled} iterations: up to there all comes as it \
             would have come, and learning rates then stay where they are at its end"
        )
    } else {
        format!("{setting}: {to} in the place of {from}, after iteration {iteration}")
    }
}

/// The command that goes on with a run, as it can be pasted into a shell from the same folder.
fn to_go_on(out: &Path) -> String {
    let program = std::env::args_os().next();
    let program = program.map_or("limpid".into(), PathBuf::from);
    let word = |path: &Path| quoted(&path.display().to_string());
    format!("{} train --resume --out {}", word(&program), word(out))
}

fn absolute(scene: &Path) -> Result<PathBuf, Failure> {
    let found = scene.canonicalize();
    Ok(found.map_err(|e| format!("{e}: {}", scene.display()))?)
}
