//! `limpid view`.

use crate::config::{Backend, Config};
use crate::failure::Failure;
use crate::refresh;
use crate::report;
use crate::say::{print, say};
use crate::serve::Server;
use std::path::PathBuf;
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
    if !refresh::is_current(out) {
        refresh::write(out, &config, arguments.scene.as_deref())?;
    }
    let server = Server::of_folder(out, report::FILE, arguments.port)
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
