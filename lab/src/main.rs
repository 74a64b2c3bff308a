//! `limpid-lab`: plans a study, runs it, and gathers what came out. `cargo xtask lab` starts it.

use clap::{Args, Parser, Subcommand};
use limpid_lab::{
    Case, Children, Engine, Kept, LabError, Outcome, Places, Plan, Program, Scenes, Study, Tally,
    draw, execute, failure, gather, markdown, run_all, write_json, write_whole,
};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

/// Studies: what every choice costs and gains, over scenes and seeds.
#[derive(Debug, Parser)]
#[command(
    name = "cargo xtask lab",
    version,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true
)]
struct Arguments {
    #[command(flatten)]
    all: Option<StudyArguments>,
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List a study's runs in runs.json, with a command each, and write a script for a scheduler.
    Plan {
        #[command(flatten)]
        study: StudyArguments,
        /// The scheduler.
        #[arg(long)]
        engine: Option<Engine>,
    },
    /// Run what is not there yet, side by side on this machine.
    Run(StudyArguments),
    /// Make tables, a plot and JSON of what is there.
    Gather(GatherArguments),
    /// One run of a plan: what schedulers start.
    One {
        /// The plan, runs.json.
        plan: PathBuf,
        /// The run's name in it.
        run: String,
    },
}

#[derive(Debug, Args)]
struct StudyArguments {
    /// Name of a file in lab/studies/, or a path to one.
    study: String,
    /// Where everything goes.
    #[arg(long, value_name = "DIR", default_value = "out/lab")]
    out: PathBuf,
    /// The folder of the scenes.
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// The program that trains [default: limpid beside this one].
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// An earlier report of the study: what it holds is not run again, and stands in the new report too.
    // Not in a struct of its own: with a part that is flattened, clap takes this whole one for absent.
    #[arg(long, value_name = "STUDY.json")]
    kept: Option<PathBuf>,
    /// So many runs at a time, of one thread each [default: one a core].
    #[arg(long, value_name = "N")]
    jobs: Option<usize>,
}

#[derive(Debug, Args)]
struct GatherArguments {
    /// Name of a file in lab/studies/, or a path to one.
    study: String,
    /// Where everything is.
    #[arg(long, value_name = "DIR", default_value = "out/lab")]
    out: PathBuf,
    /// An earlier report of the study, which stands in the new one too.
    #[arg(long, value_name = "STUDY.json")]
    kept: Option<PathBuf>,
    /// Where tables, plot and JSON go [default: OUT/STUDY].
    #[arg(long, value_name = "DIR")]
    to: Option<PathBuf>,
}

/// Exit code after Ctrl-C, as shells have it.
const INTERRUPTED: u8 = 130;

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match (arguments.command, arguments.all) {
        (Some(Command::Plan { study, engine }), _) => study.plan_for(engine),
        (Some(Command::Run(arguments)), _) => arguments.run(),
        (Some(Command::Gather(arguments)), _) => arguments.gather(),
        (Some(Command::One { plan, run }), _) => one(&plan, &run),
        (None, Some(arguments)) => arguments.run_and_gather(),
        (None, None) => Err(LabError::Asked("no study is named".to_owned())),
    };
    result.unwrap_or_else(|error| {
        say(&format!("lab: {error}"));
        ExitCode::FAILURE
    })
}

/// A line on standard error; where nobody reads it, it is lost.
fn say(text: &str) {
    writeln!(std::io::stderr().lock(), "{text}").ok();
}

/// The checkout that this program was started in by cargo, or built in.
fn root() -> PathBuf {
    let here = std::env::var_os("CARGO_MANIFEST_DIR");
    let here = here.unwrap_or_else(|| env!("CARGO_MANIFEST_DIR").into());
    let root = Path::new(&here).parent();
    root.expect("lab/ lies in the root").to_owned()
}

/// A study that was asked for.
struct Asked {
    name: String,
    study: Study,
    path: PathBuf,
    places: Places,
    kept: Option<Kept>,
}

impl Asked {
    /// Reads a study by its name in the repository, or by its path.
    fn read(given: &str, out: &Path, kept: Option<&Path>) -> Result<Self, LabError> {
        let given = Path::new(given);
        let path = if given.extension().is_some() {
            given.to_owned()
        } else {
            let studies = root().join("lab/studies");
            let path = studies.join(given).with_extension("toml");
            if !path.exists() {
                let names = std::fs::read_dir(&studies).into_iter().flatten().flatten();
                let names = names.filter_map(|entry| {
                    Some(entry.path().file_stem()?.to_string_lossy().into_owned())
                });
                let mut names: Vec<String> = names.collect();
                names.sort();
                let (given, names) = (given.display(), names.join(", "));
                let problem = format!("there is no study `{given}`; there are {names}");
                return Err(LabError::Asked(problem));
            }
            path
        };
        let name = path.file_stem().unwrap_or_default();
        let name = name.to_string_lossy().into_owned();
        if Places::OURS.contains(&&*name) {
            let problem = format!(
                "a study cannot be called `{name}`: {} is taken",
                out.join(&name).display()
            );
            return Err(LabError::Asked(problem));
        }
        let study = Study::read(&path)?;
        Ok(Self {
            kept: kept
                .map(|kept| Kept::read(kept, &name, &study))
                .transpose()?,
            name,
            study,
            path,
            places: Places {
                out: out.to_owned(),
            },
        })
    }

    fn parts(&self) -> (&str, &Study, &Path) {
        (&self.name, &self.study, &self.path)
    }
}

impl StudyArguments {
    fn plan(&self, asked: &Asked) -> Result<Plan, LabError> {
        let places = &asked.places;
        let this = std::env::current_exe();
        let this = this.map_err(|e| LabError::Asked(format!("this program is nowhere: {e}")))?;
        let limpid = format!("limpid{}", std::env::consts::EXE_SUFFIX);
        let program = match &self.program {
            Some(program) => Program::keep(program, places, None)?,
            None => Program::keep(&this.with_file_name(limpid), places, Some(&root()))?,
        };
        let scenes = Scenes {
            demo: root().join("demo"),
            folder: self.scenes.clone(),
            links: places.links(),
        };
        let is_kept = |case: &Case| asked.kept.as_ref().is_some_and(|kept| kept.holds(case));
        let plan = Plan::new(asked.parts(), program, &scenes, places, is_kept, &this)?;
        let file = places.plan(&asked.name);
        plan.write(&file)?;
        say(&format!("{} runs: {}", plan.runs.len(), file.display()));
        Ok(plan)
    }

    fn jobs(&self) -> usize {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        self.jobs.unwrap_or(cores)
    }

    fn plan_for(&self, engine: Option<Engine>) -> Result<ExitCode, LabError> {
        let plan = self.plan(&self.asked()?)?;
        if let Some(engine) = engine {
            let places = Places {
                out: self.out.clone(),
            };
            let script = engine.write(&plan, self.jobs(), &places.study(&plan.study))?;
            say(&script.map_or_else(
                || "all of them are finished: no script is written".to_owned(),
                |script| script.display().to_string(),
            ));
        }
        Ok(ExitCode::SUCCESS)
    }

    fn asked(&self) -> Result<Asked, LabError> {
        Asked::read(&self.study, &self.out, self.kept.as_deref())
    }

    fn run(&self) -> Result<ExitCode, LabError> {
        Ok(self.run_of(&self.asked()?)?.1)
    }

    /// Runs a study; what was planned comes back with the exit code.
    fn run_of(&self, asked: &Asked) -> Result<(Plan, ExitCode), LabError> {
        let children = listen()?;
        let plan = self.plan(asked)?;
        let tally = run_all(&plan, self.jobs(), &children, say)?;
        summary(&tally);
        let code = if children.are_stopped() && tally.failed.is_empty() {
            ExitCode::from(INTERRUPTED)
        } else if tally.failed.is_empty() && tally.left == 0 {
            ExitCode::SUCCESS
        } else {
            ExitCode::FAILURE
        };
        Ok((plan, code))
    }

    fn run_and_gather(&self) -> Result<ExitCode, LabError> {
        let asked = self.asked()?;
        let (plan, code) = self.run_of(&asked)?;
        write_report(&asked, &plan, &asked.places.study(&asked.name))?;
        Ok(code)
    }
}

/// Processes that Ctrl-C will end.
fn listen() -> Result<Arc<Children>, LabError> {
    let children = Arc::new(Children::default());
    let heard = children.clone();
    let set = signals::on_end(move || {
        if !heard.are_stopped() {
            say(
                "ending; what is running writes its checkpoint, and the same command goes on from there",
            );
        }
        heard.stop();
    });
    set.map_err(|e| LabError::Asked(format!("Ctrl-C cannot be listened to: {e}")))?;
    Ok(children)
}

fn summary(tally: &Tally) {
    let mut text = format!("runs: {} finished", tally.finished);
    for (count, what) in [
        (tally.there, "there already"),
        (tally.left, "left"),
        (tally.failed.len(), "failed"),
    ] {
        if count > 0 {
            text.push_str(&format!(", {count} {what}"));
        }
    }
    say(&text);
    if !tally.failed.is_empty() {
        say("these failed; the same command tries them again:");
        for (run, failed) in &tally.failed {
            let line = failure(run, failed);
            say(&format!("  {}", line.lines().next().unwrap_or_default()));
        }
    }
}

impl GatherArguments {
    fn gather(&self) -> Result<ExitCode, LabError> {
        let asked = Asked::read(&self.study, &self.out, self.kept.as_deref())?;
        let folder = asked.places.study(&asked.name);
        let plan = Plan::read(&asked.places.plan(&asked.name))?;
        write_report(&asked, &plan, self.to.as_ref().unwrap_or(&folder))?;
        Ok(ExitCode::SUCCESS)
    }
}

/// Writes `STUDY.md`, `STUDY.json` and `STUDY.svg`.
fn write_report(asked: &Asked, plan: &Plan, to: &Path) -> Result<(), LabError> {
    let name = &asked.name;
    let kept = asked.kept.as_ref();
    let report = gather(asked.parts(), &plan.program, &asked.places, kept)?;
    std::fs::create_dir_all(to).map_err(LabError::file(to))?;
    let [table, json, picture] = ["md", "json", "svg"].map(|end| to.join(format!("{name}.{end}")));
    let is_drawn = match &asked.study.plot {
        Some(plot) => draw(&report, plot, &picture)?,
        None => false,
    };
    let picture_name = format!("{name}.svg");
    let text = markdown(&report, is_drawn.then_some(&*picture_name));
    write_whole(&table, &text)?;
    write_json(&json, &report)?;
    say(&format!(
        "{} of {} runs: {}",
        report.finished,
        report.planned,
        table.display()
    ));
    Ok(())
}

/// Runs one run of a plan.
fn one(plan: &Path, id: &str) -> Result<ExitCode, LabError> {
    let (plan, run) = Plan::with_run(plan, id)?;
    let children = listen()?;
    Ok(match execute(&run, &plan.program, &children)? {
        Outcome::Finished | Outcome::WasThere => ExitCode::SUCCESS,
        Outcome::Stopped => ExitCode::from(INTERRUPTED),
        Outcome::Elsewhere => {
            say(&format!("another process is at run {id}"));
            ExitCode::FAILURE
        }
        Outcome::Failed(failed) => {
            say(&failure(&run, &failed));
            ExitCode::FAILURE
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_study_is_named_with_and_without_a_command() {
        let kept = ["demo-study", "--kept", "earlier.json"];
        for command in [None, Some("run"), Some("plan"), Some("gather")] {
            let line = ["lab"].into_iter().chain(command).chain(kept);
            let read = Arguments::try_parse_from(line).expect("arguments");
            let (study, earlier) = match (read.command, read.all) {
                (Some(Command::Run(asked) | Command::Plan { study: asked, .. }), _)
                | (None, Some(asked)) => (asked.study, asked.kept),
                (Some(Command::Gather(asked)), _) => (asked.study, asked.kept),
                read => panic!("{command:?}: {read:?}"),
            };
            assert_eq!(study, "demo-study", "{command:?}");
            assert_eq!(earlier.as_deref(), Some(Path::new("earlier.json")));
        }
    }
}
