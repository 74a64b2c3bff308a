//! Folders for pictures and exports, where the user names one.

use crate::failure::Failure;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The file that says of a folder that it was made for such things, which may be replaced then.
const MARK: &str = ".limpid";
const MARK_TEXT: &str = "Files of `limpid render` and `limpid export`, which may replace them.\n";

/// The folder that a user named, or else the run's own of a name, made where it is not there.
pub(crate) fn claimed(named: Option<&Path>, run: &Path, own: &str) -> Result<PathBuf, Failure> {
    if let Some(folder) = named {
        claim(folder)?;
        return Ok(folder.to_owned());
    }
    let folder = run.join(own);
    let at = |e: std::io::Error| format!("{e}: {}", folder.display());
    fs::create_dir_all(&folder).map_err(at)?;
    // So that it may be named too.
    fs::write(folder.join(MARK), MARK_TEXT).map_err(at)?;
    Ok(folder)
}

/// Makes a folder for what a command writes; one that holds other things is left alone, which may have the same names.
fn claim(folder: &Path) -> Result<(), Failure> {
    let at = |e: std::io::Error| Failure::from(format!("{e}: {}", folder.display()));
    let mark = folder.join(MARK);
    match fs::read_dir(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => fs::create_dir_all(folder).map_err(at)?,
        Err(e) => return Err(at(e)),
        Ok(mut entries) => {
            if mark.exists() {
                return Ok(());
            }
            if entries.next().is_some() {
                return Err(format!(
                    "{} holds files that are not of `limpid render` or `limpid export`, which could be overwritten; choose a folder \
                     that is new or empty with --out",
                    folder.display()
                )
                .into());
            }
        }
    }
    fs::write(&mark, MARK_TEXT).map_err(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_s_own_folder_may_be_named_too() -> Result<(), Box<dyn std::error::Error>> {
        let run = tempfile::tempdir()?;
        // With what training left in it.
        fs::create_dir_all(run.path().join("renders/train"))?;
        for own in ["export", "renders"] {
            for _ in 0..2 {
                let folder = claimed(None, run.path(), own)?;
                fs::write(folder.join("at_1.png"), "ours")?;
                assert_eq!(claimed(Some(&folder), run.path(), own)?, folder);
            }
        }
        Ok(())
    }

    #[test]
    fn a_folder_is_ours_if_it_was_new_or_empty() -> Result<(), Box<dyn std::error::Error>> {
        let base = tempfile::tempdir()?;
        let own = base.path().join("a/b");
        for _ in 0..2 {
            claim(&own)?;
            fs::write(own.join("at_1.png"), "ours")?;
        }
        let empty = base.path().join("empty");
        fs::create_dir(&empty)?;
        claim(&empty)?;

        let theirs = base.path().join("theirs");
        fs::create_dir(&theirs)?;
        fs::write(theirs.join("at_1.png"), "theirs")?;
        let said = claim(&theirs).expect_err("theirs").to_string();
        assert!(said.contains("theirs") && said.contains("--out"), "{said}");
        assert_eq!(fs::read_dir(&theirs)?.count(), 1);
        assert!(claim(&theirs.join("at_1.png")).is_err(), "a file");
        Ok(())
    }
}
