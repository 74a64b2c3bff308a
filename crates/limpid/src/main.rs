//! The `limpid` program: trains, renders and scores.

mod check;
mod checkpoints;
mod clip;
mod config;
mod devices;
mod eval;
mod export;
mod failure;
mod keys;
mod lock;
mod memory;
mod moments;
mod numbered;
mod outputs;
mod render;
mod say;
mod sheet;
mod stop;
mod train;
mod video;

use clap::{Parser, Subcommand};
use failure::with_causes;
use say::say;
use std::process::ExitCode;

/// An iteration frees and takes hundreds of megabytes; the system's allocator would hand them back and fault them in
/// again, which cost a quarter of the time (docs/PERFORMANCE.md).
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Limpid turns one blurry handheld video into a sharp 3D scene that moves.
#[derive(Debug, Parser)]
#[command(name = "limpid", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Train on a scene and write pictures, scores, a checkpoint and a PLY.
    Train(Box<train::TrainArguments>),
    /// Render a trained scene again: its views, any moment, or along a path.
    Render(render::RenderArguments),
    /// Write a trained scene in formats that others read: PLY, glTF, SPZ, nerfstudio's and COLMAP's cameras.
    Export(export::ExportArguments),
    /// Score a trained scene on its test views.
    Eval(eval::EvalArguments),
    /// Look whether a scene's files fit each other: exit code 0, 1 (doubtful) or 2 (wrong).
    Check(check::CheckArguments),
    /// List what tensors can live on, and whether a scene fits.
    Devices(devices::DevicesArguments),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Train(arguments) => train::run(&arguments),
        Command::Render(arguments) => render::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::Eval(arguments) => eval::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Devices(arguments) => devices::run(&arguments),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            say!("limpid: {}", with_causes(&*error));
            ExitCode::FAILURE
        }
    }
}
