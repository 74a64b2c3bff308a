//! Scripts with which other schedulers work through a plan.

use crate::error::LabError;
use crate::execute::is_finished;
use crate::hash::name_of;
use crate::plan::{Plan, PlannedRun};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A scheduler that exists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Engine {
    /// HyperQueue: a `hq submit` a run.
    Hq,
    /// Slurm: an array for `sbatch`.
    Slurm,
    /// GNU parallel, on this machine or others.
    Parallel,
}

impl Engine {
    /// Name of its script.
    #[must_use]
    pub fn file(self) -> &'static str {
        match self {
            Self::Hq => "hq.sh",
            Self::Slurm => "slurm.sh",
            Self::Parallel => "parallel.sh",
        }
    }

    /// Writes the script, and a list with a command a line, into a folder; runs that are finished are left out.
    /// The script's path comes back; `None` where all are finished, and then nothing is written.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write(
        self,
        plan: &Plan,
        jobs: usize,
        folder: &Path,
    ) -> Result<Option<PathBuf>, LabError> {
        let folder = std::path::absolute(folder).map_err(LabError::file(folder))?;
        let runs = plan.runs.iter().filter(|run| !is_finished(&run.folder));
        let runs: Vec<&PlannedRun> = runs.collect();
        if runs.is_empty() {
            return Ok(None);
        }
        let lines: String = runs.iter().map(|run| line(&run.command) + "\n").collect();
        // By what it holds: a task that still waits finds the list that it was made of.
        let name = name_of(&lines);
        let commands = folder.join(format!("commands-{name}.txt"));
        std::fs::write(&commands, lines).map_err(LabError::file(&commands))?;
        let script = folder.join(self.file());
        let text = match self {
            Self::Hq => hq(&plan.study, &runs),
            Self::Slurm => slurm(&plan.study, runs.len(), &commands),
            Self::Parallel => parallel(jobs, &commands),
        };
        std::fs::write(&script, text).map_err(LabError::file(&script))?;
        Ok(Some(script))
    }
}

fn hq(study: &str, runs: &[&PlannedRun]) -> String {
    let mut text = "\
#!/bin/sh
# A job of HyperQueue for each run. Start a server (`hq server start`) and workers (`hq worker start`, or `hq alloc add slurm`)
# first. What a run says is in its log, beside its folder.
set -e
"
    .to_owned();
    for run in runs {
        let name = quoted(&format!("{study}-{}", run.id));
        let command = line(&run.command);
        writeln!(
            text,
            "hq submit --name={name} --cpus=1 --stdout=none --stderr=none -- {command}"
        )
        .expect("a string takes text");
    }
    text
}

fn slurm(study: &str, runs: usize, commands: &Path) -> String {
    let (name, commands) = (quoted(study), quoted(&commands.to_string_lossy()));
    format!(
        "\
#!/bin/sh
#SBATCH --job-name={name}
#SBATCH --array=1-{runs}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --output=/dev/null
#SBATCH --signal=B:INT@120
# `sbatch slurm.sh`; say --time and --mem as the cluster wants them. Two minutes before its time is up, a run writes its
# checkpoint; `lab plan` and `sbatch` again go on from there. What a run says is in its log, beside its folder.
# The tests run this script task by task without Slurm; on a cluster it has not been run yet.
command=$(sed -n \"${{SLURM_ARRAY_TASK_ID}}p\" {commands})
eval \"exec $command\"
"
    )
}

fn parallel(jobs: usize, commands: &Path) -> String {
    let commands = quoted(&commands.to_string_lossy());
    format!(
        "\
#!/bin/sh
# All runs by GNU parallel; its exit code is the number of those that failed. With --sshloginfile they go to other machines,
# which see this folder under the same path.
exec parallel --jobs {jobs} --no-notice --bar --arg-file {commands}
"
    )
}

/// A command as a shell takes it.
fn line(command: &[String]) -> String {
    let words: Vec<String> = command.iter().map(|word| quoted(word)).collect();
    words.join(" ")
}

fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./=:,+@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Program;

    fn plan(folder: &Path) -> Plan {
        let run = |id: &str| PlannedRun {
            id: id.to_owned(),
            scene: "demo".to_owned(),
            arms: vec!["off".to_owned()],
            seed: 1,
            iterations: 200,
            folder: folder.join(id),
            arguments: Vec::new(),
            command: vec!["echo".to_owned(), "it's $HOME".to_owned(), id.to_owned()],
        };
        Plan {
            study: "a study".to_owned(),
            program: Program {
                path: "limpid".into(),
                fingerprint: "f".to_owned(),
                version: "limpid 0".to_owned(),
                commit: None,
                changed: false,
            },
            runs: ["aa", "bb", "cc"].map(run).to_vec(),
        }
    }

    /// What a shell says.
    #[cfg(unix)]
    fn said(shell: &mut std::process::Command) -> String {
        let output = shell.output().expect("a shell");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// What Slurm's script says in a task of the array.
    #[cfg(unix)]
    fn said_by_task(script: &Path, task: &str) -> String {
        let mut shell = std::process::Command::new("sh");
        said(shell.arg(script).env("SLURM_ARRAY_TASK_ID", task))
    }

    #[cfg(unix)]
    #[test]
    fn a_task_of_the_array_is_a_run_and_words_stay_words() {
        let folder = tempfile::tempdir().expect("a folder");
        let plan = plan(folder.path());
        let write = |engine: Engine| {
            let script = engine.write(&plan, 3, folder.path());
            script.expect("written").expect("runs that are left")
        };
        let script = write(Engine::Slurm);
        let text = std::fs::read_to_string(&script).expect("a script");
        assert!(text.contains("--array=1-3") && text.contains("--job-name='a study'"));
        for (task, id) in [("1", "aa"), ("3", "cc")] {
            let said = said_by_task(&script, task);
            assert_eq!(said, format!("it's $HOME {id}\n"));
        }
        let queued = folder.path().join("queued.sh");
        std::fs::copy(&script, &queued).expect("as Slurm keeps it");
        let text = std::fs::read_to_string(write(Engine::Parallel)).expect("a script");
        assert!(text.contains("--jobs 3"), "{text}");

        // What is finished is not asked for again.
        std::fs::create_dir(folder.path().join("aa")).expect("a folder");
        std::fs::write(folder.path().join("aa/metrics.json"), "{}").expect("written");
        let script = write(Engine::Hq);
        let text = std::fs::read_to_string(&script).expect("a script");
        assert_eq!(text.matches("\nhq submit").count(), 2, "{text}");
        write(Engine::Slurm);
        let waited = said_by_task(&queued, "3");
        assert_eq!(waited, "it's $HOME cc\n", "the list of a task that waits");
        // A function stands in for the program: a file just written cannot be started while a process that another test is
        // starting holds it open.
        let stand_in = "hq() { shift 5; echo \"$2|$4\"; }; . \"$1\"";
        let mut shell = std::process::Command::new("sh");
        assert_eq!(
            said(shell.args(["-c", stand_in, "sh"]).arg(&script)),
            "echo|bb\necho|cc\n",
            "arguments after the options"
        );

        for id in ["bb", "cc"] {
            std::fs::create_dir(folder.path().join(id)).expect("a folder");
            std::fs::write(folder.path().join(id).join("metrics.json"), "{}").expect("written");
        }
        let none = Engine::Slurm.write(&plan, 3, folder.path());
        assert!(none.expect("nothing to write").is_none(), "all finished");
    }
}
