//! Folders of frames: listing by file stem, in natural order.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use crate::IoError;
use crate::error::list_names;

/// File name endings of pictures that are read.
pub(crate) const PICTURES: &[&str] = &["png", "jpg", "jpeg"];

/// The files of one kind in a folder, by stem.
#[derive(Default)]
pub(crate) struct Listing {
    pub(crate) files: BTreeMap<String, PathBuf>,
    /// Files of other kinds, hidden ones not counted.
    pub(crate) others: usize,
}

impl Listing {
    /// The stems, numbers in them compared as numbers.
    pub(crate) fn stems(&self) -> Vec<String> {
        let mut stems: Vec<_> = self.files.keys().cloned().collect();
        stems.sort_by(|a, b| natural_order(a, b));
        stems
    }

    /// The files by stem, of which each of these stems may have one; an error where there are files and no stem has any, since who
    /// put them there expects them to be used.
    pub(crate) fn named_as(
        self,
        stems: &[String],
        folder: &Path,
    ) -> Result<BTreeMap<String, PathBuf>, IoError> {
        let first = self.files.keys().next();
        match (first, stems.first()) {
            (Some(found), Some(expected))
                if !stems.iter().any(|stem| self.files.contains_key(stem)) =>
            {
                Err(IoError::missing(
                    folder,
                    format!("files that are named as the frames: {expected}, not {found}"),
                    "rename them, or remove the folder to do without",
                ))
            }
            _ => Ok(self.files),
        }
    }

    /// The files of these stems; those that are missing are named in the error.
    pub(crate) fn pick(
        &self,
        stems: &[String],
        folder: &Path,
        what: &str,
        advice: &str,
    ) -> Result<Vec<PathBuf>, IoError> {
        let missing: Vec<_> = stems
            .iter()
            .filter(|s| !self.files.contains_key(*s))
            .collect();
        if !missing.is_empty() {
            return Err(IoError::missing(
                folder,
                format!("{what} {}", list_names(&missing)),
                advice,
            ));
        }
        Ok(stems.iter().map(|s| self.files[s].clone()).collect())
    }
}

/// Lists the files with one of these (lower-case) endings; a folder that is not there is empty.
pub(crate) fn list(folder: &Path, endings: &[&str]) -> Result<Listing, IoError> {
    let mut listing = Listing::default();
    if !folder.is_dir() {
        return Ok(listing);
    }
    let access = |e| IoError::access(folder, e);
    for entry in fs::read_dir(folder).map_err(access)? {
        let path = entry.map_err(access)?.path();
        let Some(name) = path.file_name().and_then(|n| n.to_str()).map(String::from) else {
            return Err(IoError::malformed(&path, "the file's name is not UTF-8"));
        };
        if name.starts_with('.') || path.is_dir() {
            continue;
        }
        let (stem, ending) = name.rsplit_once('.').unwrap_or((name.as_str(), ""));
        if !endings.contains(&ending.to_lowercase().as_str()) {
            listing.others += 1;
        } else if let Some(first) = listing.files.insert(stem.into(), path.clone()) {
            return Err(IoError::names(
                &path,
                format!("{} has the same stem, remove one", first.display()),
            ));
        }
    }
    Ok(listing)
}

/// As [`list`], where there may be none; files of other kinds alone are an error, since who put them there expects them to be used.
pub(crate) fn list_optional(folder: &Path, endings: &[&str]) -> Result<Listing, IoError> {
    let listing = list(folder, endings)?;
    if listing.files.is_empty() && listing.others > 0 {
        let what = format!(
            "files: no {} among {}",
            endings.join(" or "),
            listing.others
        );
        return Err(IoError::missing(
            folder,
            what,
            "convert them, or remove the folder to do without",
        ));
    }
    Ok(listing)
}

/// A path or file name without folder and ending.
pub(crate) fn stem_of(path: &str) -> &str {
    let name = path.rsplit(['/', '\\']).next().unwrap_or(path);
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

/// Compares texts with runs of digits as numbers, so that frame 10 comes after frame 9.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let digits = |s: &str| s.bytes().take_while(u8::is_ascii_digit).count();
    let (mut x, mut y) = (a, b);
    while let (Some(c), Some(d)) = (x.chars().next(), y.chars().next()) {
        let (m, n) = (digits(x), digits(y));
        let order = if m > 0 && n > 0 {
            let (u, v) = (
                x[..m].trim_start_matches('0'),
                y[..n].trim_start_matches('0'),
            );
            (x, y) = (&x[m..], &y[n..]);
            u.len().cmp(&v.len()).then(u.cmp(v))
        } else {
            (x, y) = (&x[c.len_utf8()..], &y[d.len_utf8()..]);
            c.cmp(&d)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    // Equal as numbers (01 and 1): the text decides, so that the order is total.
    x.len().cmp(&y.len()).then(a.cmp(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_count_as_numbers() {
        let mut names = ["f10", "f9", "f09", "e", "f", "f9b", "10", "9"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["9", "10", "e", "f", "f09", "f9", "f9b", "f10"]);
    }

    #[test]
    fn stems() {
        assert_eq!(stem_of("images/a.b.png"), "a.b");
        assert_eq!(stem_of("00012"), "00012");
        assert_eq!(stem_of("x\\y.jpg"), "y");
    }

    #[test]
    fn one_stem_twice_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.png", "a.JPG", "b.txt", ".hidden.png"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        assert!(matches!(
            list(folder.path(), PICTURES),
            Err(IoError::Names { .. })
        ));
        fs::remove_file(folder.path().join("a.JPG")).unwrap();
        let listing = list(folder.path(), PICTURES).unwrap();
        assert_eq!(
            (listing.stems(), listing.others),
            (vec!["a".to_string()], 1)
        );
    }
}
