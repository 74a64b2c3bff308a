//! Videos, by the ffmpeg that a user has.

use crate::failure::Failure;
use crate::numbered::Numbered;
use crate::say::conclude;
use crate::shell::quoted;
use std::io::ErrorKind;
use std::path::Path;
use std::process::{Command, Stdio};

/// Makes a video of numbered pictures. Without ffmpeg, or where it fails, says how to make it: the pictures are there.
pub(crate) fn write(
    pictures: &Numbered,
    count: usize,
    fps: f64,
    video: &Path,
) -> Result<(), Failure> {
    let arguments = |to: &Path| -> Vec<String> {
        let text = |path: &Path| path.display().to_string();
        let (fps, count) = (fps.to_string(), count.to_string());
        let pattern = pictures.pattern();
        let to = text(to);
        [
            // H.264 in 4:2:0, which everything plays, wants even sides.
            ["-framerate", &fps, "-i", &pattern, "-frames:v", &count].as_slice(),
            &[
                "-vf",
                "pad=ceil(iw/2)*2:ceil(ih/2)*2",
                "-c:v",
                "libx264",
                "-crf",
                "18",
            ],
            &[
                "-pix_fmt",
                "yuv420p",
                "-movflags",
                "+faststart",
                "-f",
                "mp4",
                "-y",
                &to,
            ],
        ]
        .concat()
        .into_iter()
        .map(str::to_owned)
        .collect()
    };
    let unfinished = video.with_extension("mp4.part");
    let run = Command::new("ffmpeg")
        .args(["-nostdin", "-loglevel", "error"])
        .args(arguments(&unfinished))
        .stdin(Stdio::null())
        .output();
    let problem = match run {
        Ok(run) if run.status.success() => {
            std::fs::rename(&unfinished, video).map_err(|e| format!("{e}: {}", video.display()))?;
            conclude!("{}", video.display());
            return Ok(());
        }
        Ok(run) => {
            std::fs::remove_file(&unfinished).ok();
            let said = String::from_utf8_lossy(&run.stderr);
            format!("ffmpeg failed: {}", said.trim())
        }
        Err(e) if e.kind() == ErrorKind::NotFound => "there is no ffmpeg on the path".to_owned(),
        Err(e) => format!("ffmpeg does not start: {e}"),
    };
    let line: Vec<String> = arguments(video)
        .iter()
        .map(|argument| quoted(argument))
        .collect();
    conclude!(
        "no video: {problem}; the pictures are there, and this makes it:\n  ffmpeg {}",
        line.join(" ")
    );
    Ok(())
}
