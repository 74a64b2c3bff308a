//! The `limpid` program: trains, renders and scores.

mod asked;
mod budget;
mod check;
mod checkpoints;
mod claim;
mod clip;
mod compare;
mod config;
mod devices;
mod eval;
mod export;
mod failure;
mod keys;
mod lengths;
mod lock;
mod log;
mod memory;
mod moments;
mod numbered;
mod outputs;
mod page;
mod preset;
mod progress;
mod refresh;
mod render;
mod report;
mod say;
mod serve;
mod settings;
mod sheet;
mod shell;
mod stop;
mod train;
mod version;
mod video;
mod view;
mod watch;

use clap::{CommandFactory as _, Parser, Subcommand};
use failure::with_causes;
use say::conclude;
use std::process::ExitCode;

/// An iteration frees and takes hundreds of megabytes; the system's allocator would hand them back and fault them in
/// again, which cost a quarter of the time (docs/PERFORMANCE.md).
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Limpid turns one blurry handheld video into a sharp 3D scene that moves.
#[derive(Debug, Parser)]
#[command(name = "limpid", version = version::long())]
struct Arguments {
    /// Work with so many threads [default: as many as the machine runs at once]. Results do not depend on it.
    #[arg(long, value_name = "N", global = true, value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    #[command(flatten)]
    voice: say::Voice,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Train on a scene and write pictures, scores, a checkpoint and a PLY.
    Train(Box<asked::TrainArguments>),
    /// Render a trained scene again: its views, any moment, or along a path.
    Render(render::RenderArguments),
    /// Write a trained scene in formats that others read: PLY, glTF, SPZ, nerfstudio's and COLMAP's cameras.
    Export(export::ExportArguments),
    /// Score a trained scene on its test views.
    Eval(eval::EvalArguments),
    /// Hold several runs against each other: a table, and a page with their pictures side by side.
    Compare(compare::CompareArguments),
    /// Look whether a scene's files fit each other: exit code 0, 1 (doubtful) or 2 (wrong).
    Check(check::CheckArguments),
    /// Show a run's report in the browser, served on the loopback address.
    View(view::ViewArguments),
    /// List what tensors can live on, and whether a scene fits.
    Devices(devices::DevicesArguments),
    /// List every setting that --set and config files take beside flags of `train`: its default, its range and what it means.
    Settings(settings::SettingsArguments),
    /// Write what a shell needs to complete this program's arguments, to its standard output.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
}

fn main() -> ExitCode {
    let Arguments {
        threads,
        voice,
        command,
    } = Arguments::parse();
    if let Err(problem) = voice.set() {
        conclude!("limpid: {problem}");
        return ExitCode::FAILURE;
    }
    if let Some(threads) = threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads));
        if let Err(problem) = pool.build_global() {
            conclude!("limpid: --threads {threads}: {problem}");
            return ExitCode::FAILURE;
        }
    }
    let result = match command {
        Command::Train(arguments) => train::run(&arguments),
        Command::Render(arguments) => render::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Eval(arguments) => eval::run(&arguments),
        Command::Compare(arguments) => compare::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::View(arguments) => view::run(&arguments),
        Command::Devices(arguments) => devices::run(&arguments),
        Command::Settings(arguments) => settings::run(&arguments),
        Command::Completions { shell } => completions(shell),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            conclude!("limpid: {}", with_causes(&*error));
            ExitCode::FAILURE
        }
    }
}

fn completions(shell: clap_complete::Shell) -> Result<ExitCode, failure::Failure> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Arguments::command(), "limpid", &mut script);
    say::print(String::from_utf8(script)?.trim_end())?;
    Ok(ExitCode::SUCCESS)
}
