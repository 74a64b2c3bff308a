//! `trainer`'s checkpoint. Apart from the parsers of `io`, because Burn takes long to compile.

use std::fs;
use std::path::Path;

use io::Scene;
use trainer::{CHECKPOINT_FILE, Device, Run, TrainError, Trainer};

/// The checkpoint with the checksum that fits it: what is behind the check would never be reached else.
fn sealed(bytes: &[u8]) -> Vec<u8> {
    const OPEN: &[u8] = b"00000000";
    let before = br#"\"checksum\":\""#;
    let mut bytes = bytes.to_vec();
    let found = bytes.windows(before.len()).position(|w| w == before);
    let start = found.map_or(bytes.len(), |at| at + before.len());
    let digits = start..start + OPEN.len();
    if digits.end <= bytes.len() {
        bytes[digits.clone()].copy_from_slice(OPEN);
        let sum = format!("{:08x}", crc32fast::hash(&bytes));
        bytes[digits].copy_from_slice(sum.as_bytes());
    }
    bytes
}

/// A checkpoint of the scene `binary`, loaded and asked for its Gaussians.
pub fn checkpoint(scenes: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    let scene = Scene::open(&scenes.join("binary"))?;
    fs::write(scenes.join(CHECKPOINT_FILE), sealed(bytes)).expect("a file can be written");
    let run = Run::open(scenes, &Device::flex())?;
    if run.views().train[0].camera.num_pixels() < 1 << 12 {
        // Whatever its numbers are, a picture or an error comes out.
        run.render_training_view(0).ok();
    }
    let trainer = Trainer::load(scenes, scene, &Device::flex())?;
    let model = trainer.model();
    for time in [None, Some(0.5)] {
        let gaussians = trainer.run().gaussians(time)?;
        let lengths = [
            gaussians.means.len(),
            gaussians.quats.len(),
            gaussians.log_scales.len(),
            gaussians.opacity_logits.len(),
            gaussians.sh.len() / (3 * (gaussians.sh_degree + 1).pow(2)),
        ];
        assert_eq!(lengths, [model.num_gaussians(); 5], "rows");
    }
    for (parameter, tensor) in model.parameters() {
        let name = parameter.name;
        let values: Vec<f32> = tensor.into_data().try_to_vec().expect("f32");
        assert!(values.iter().all(|v| v.is_finite()), "{name}: {values:?}");
    }
    Ok(())
}
