//! The checkpoints of a run in their folder: the last one, and the one before it.

use crate::TrainError;
use crate::checksum;
use crate::error::{CheckpointProblem, with_causes};
use crate::guarded::guarded;
use crate::run::Run;
use burn::tensor::Device;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

/// Name of the last checkpoint in its folder.
pub const FILE_NAME: &str = "state.safetensors";

/// Name of the checkpoint before it.
pub const PREVIOUS_NAME: &str = "previous.safetensors";

impl Run {
    /// Writes the whole run to `folder/state.safetensors`: under a temporary name first, synced, then renamed,
    /// so that a file that is there is whole. What had that name becomes `folder/previous.safetensors`, unless it is damaged: at
    /// every moment [`Self::open`] finds one that is whole.
    ///
    /// # Errors
    /// The file cannot be written, or the device fails; what was there before is unharmed then.
    pub fn save(&self, folder: &Path) -> Result<(), TrainError> {
        let path = folder.join(FILE_NAME);
        let is_whole = fs::read(&path).is_ok_and(|bytes| checksum::holds(&bytes));
        let kept = is_whole.then(|| folder.join(PREVIOUS_NAME));
        let bytes = guarded(&self.device, || {
            self.to_bytes().map_err(|problem| TrainError::Checkpoint {
                path: path.clone(),
                problem,
            })
        })?;
        let written = io::write_atomic_keeping(&path, kept.as_deref(), |f| f.write_all(&bytes));
        Ok(written?)
    }

    /// Reads a checkpoint back, to render it, to export it, or to go on from it ([`crate::Trainer::resume`]). Where the last one
    /// is damaged or missing, the one before it is taken, and [`Self::setback`] says so.
    ///
    /// # Errors
    /// There is none, or none can be used: they cannot be read, are not whole, or are of another version; the device
    /// fails.
    pub fn open(folder: &Path, device: &Device) -> Result<Self, TrainError> {
        guarded(device, || Self::open_last(folder, device))
    }

    fn open_last(folder: &Path, device: &Device) -> Result<Self, TrainError> {
        let [last, before] = [FILE_NAME, PREVIOUS_NAME].map(|name| folder.join(name));
        let problem = match read(&last, device) {
            Ok(run) => return Ok(run),
            Err(problem) => problem,
        };
        let is_none = is_missing(&problem);
        let error = TrainError::Checkpoint {
            path: last,
            problem,
        };
        match read(&before, device) {
            Ok(mut run) => {
                run.setback = Some(error);
                Ok(run)
            }
            Err(other) if !is_missing(&other) => Err(TrainError::Checkpoints {
                before,
                older: with_causes(&other),
                last: Box::new(error),
            }),
            Err(_) if is_none => Err(TrainError::NoCheckpoint {
                folder: folder.to_owned(),
            }),
            Err(_) => Err(error),
        }
    }

    /// Why this run is not from the last checkpoint in its folder, where it is from the one before it.
    #[must_use]
    pub fn setback(&self) -> Option<&TrainError> {
        self.setback.as_ref()
    }
}

fn read(path: &Path, device: &Device) -> Result<Run, CheckpointProblem> {
    Run::from_bytes(&fs::read(path)?, device)
}

fn is_missing(problem: &CheckpointProblem) -> bool {
    matches!(problem, CheckpointProblem::Unreadable(e) if e.kind() == ErrorKind::NotFound)
}
