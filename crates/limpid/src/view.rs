//! `limpid view`.

use crate::checkpoints;
use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::log;
use crate::outputs;
use crate::report;
use crate::say::{print, say};
use crate::serve::Server;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

/// Arguments of `limpid view`.
#[derive(Debug, clap::Args)]
pub(crate) struct ViewArguments {
    /// Folder with a run's results.
    run: PathBuf,
    /// Folder of the scene, where it is no longer at the place it was trained from.
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Where tensors live, if the report is to be written first [default: where they did in training].
    #[arg(long)]
    backend: Option<Backend>,
    /// Port on 127.0.0.1 [default: any that is free].
    #[arg(
        long,
        value_name = "PORT",
        default_value_t = 0,
        hide_default_value = true
    )]
    port: u16,
    /// Say the address, and leave opening it to the user.
    #[arg(long)]
    no_open: bool,
}

pub(crate) fn run(arguments: &ViewArguments) -> Result<ExitCode, Failure> {
    let out = &arguments.run;
    let config = Config::of_run(out)?.on(arguments.backend);
    if !is_current(out) {
        say!("writing {} …", out.join(report::FILE).display());
        write(arguments, &config)?;
    }
    let server = Server::new(out, report::FILE, arguments.port)
        .map_err(|e| format!("{e}: 127.0.0.1, port {}", arguments.port))?;
    let address = format!("http://{}/", server.address());
    print(&address)?;
    say!(
        "{} is served to this machine alone, until Ctrl-C",
        out.display()
    );
    if !arguments.no_open && !open(&address) {
        say!("open this address in a browser");
    }
    server.run();
    Ok(ExitCode::SUCCESS)
}

/// Whether the report is there and not older than the checkpoint.
fn is_current(out: &Path) -> bool {
    let written = |path: PathBuf| path.metadata().and_then(|data| data.modified()).ok();
    let checkpoint = written(checkpoints::file(out));
    written(out.join(report::FILE))
        .is_some_and(|report| checkpoint.is_none_or(|saved| saved <= report))
}

/// Writes the report from the last checkpoint.
fn write(arguments: &ViewArguments, config: &Config) -> Result<(), Failure> {
    let out = &arguments.run;
    let run = checkpoints::open(out, config)?;
    let scene = outputs::frames(&run, config, arguments.scene.as_deref())?;
    let gallery = outputs::write_renders(&run, scene.as_ref(), &out.join("renders"))?;
    // Scores of an earlier state are none of this one.
    let metrics = io::read_json::<Value>(&out.join(outputs::METRICS_FILE)).unwrap_or(Value::Null);
    let metrics = if metrics["iterations"] == run.iteration() {
        metrics
    } else {
        Value::Null
    };
    let mut curves = log::read(&out.join(log::LOG_FILE));
    curves.retain(|line| line.iteration <= run.iteration());
    report::write(out, &run, config, &gallery, (&metrics, &curves))
}

/// Has the system open an address; whether there was something to ask.
fn open(address: &str) -> bool {
    let program = if cfg!(target_os = "macos") {
        "open"
    } else if cfg!(windows) {
        "explorer"
    } else {
        "xdg-open"
    };
    let asked = Command::new(program)
        .arg(address)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    asked.is_ok()
}
