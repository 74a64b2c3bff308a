//! Folders of numbered files, which viewers play and ffmpeg reads.

use crate::failure::Failure;
use std::path::{Path, PathBuf};

/// A folder for files of these names, such as `frame_0000.ply`.
#[derive(Debug)]
pub(crate) struct Numbered {
    folder: PathBuf,
    prefix: &'static str,
    extension: &'static str,
    digits: usize,
}

impl Numbered {
    /// For so many files, with at least so many digits.
    pub(crate) fn new(
        folder: PathBuf,
        (prefix, extension): (&'static str, &'static str),
        (digits, count): (usize, usize),
    ) -> Self {
        let digits = digits.max(count.saturating_sub(1).to_string().len());
        Self {
            folder,
            prefix,
            extension,
            digits,
        }
    }

    /// An error if there is anything in the folder but files of these names.
    pub(crate) fn alone(&self, why: &str) -> Result<(), Failure> {
        let unfinished: Vec<PathBuf> = io::unfinished(&self.folder).collect();
        let is_other = |path: &PathBuf| !self.is_ours(path) && !unfinished.contains(path);
        match self.entries().find(is_other) {
            None => Ok(()),
            Some(other) => Err(format!(
                "{} is in the way: {why}; move it away, or choose another folder with --out",
                other.display()
            )
            .into()),
        }
    }

    /// Makes the folder, and removes what an earlier time left in it under such names.
    pub(crate) fn clear(&self) -> Result<(), Failure> {
        let folder = &self.folder;
        std::fs::create_dir_all(folder).map_err(|e| format!("{e}: {}", folder.display()))?;
        let old = self.entries().filter(|path| self.is_ours(path));
        for path in io::unfinished(folder).chain(old) {
            std::fs::remove_file(&path).map_err(|e| format!("{e}: {}", path.display()))?;
        }
        Ok(())
    }

    /// The file of a number.
    pub(crate) fn path(&self, index: usize) -> PathBuf {
        let Self {
            folder,
            prefix,
            extension,
            digits,
        } = self;
        folder.join(format!("{prefix}{index:0digits$}.{extension}"))
    }

    /// All files, as ffmpeg takes them.
    pub(crate) fn pattern(&self) -> String {
        let Self {
            folder,
            prefix,
            extension,
            digits,
        } = self;
        // What the folder's own name has of it means nothing.
        let folder = folder.display().to_string().replace('%', "%%");
        let path = Path::new(&folder).join(format!("{prefix}%0{digits}d.{extension}"));
        path.display().to_string()
    }

    /// None where there is no folder.
    fn entries(&self) -> impl Iterator<Item = PathBuf> + use<> {
        let entries = std::fs::read_dir(&self.folder).into_iter().flatten();
        entries.flatten().map(|entry| entry.path())
    }

    fn is_ours(&self, path: &Path) -> bool {
        let name = path.file_name().and_then(|name| name.to_str());
        let number = name.and_then(|name| {
            let name = name.strip_prefix(self.prefix)?;
            name.strip_suffix(self.extension)?.strip_suffix('.')
        });
        number.is_some_and(|n| n.len() >= 4 && n.bytes().all(|b| b.is_ascii_digit()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_may_be_called_anything() {
        let folder = PathBuf::from("50%_blur/%d");
        let numbered = Numbered::new(folder.clone(), ("view_", "png"), (4, 3));
        assert_eq!(numbered.path(2), folder.join("view_0002.png"));
        let pattern = Path::new("50%%_blur/%%d").join("view_%04d.png");
        assert_eq!(Path::new(&numbered.pattern()), pattern);
    }
}
