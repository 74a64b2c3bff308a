//! A copy of a scene in which one thing is another: a folder of links but for that.

use crate::error::LabError;
use crate::files::write_whole;
use crate::hash::{hashed, hex};
use glam::DVec2;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// How pictures' names end.
pub(crate) const PICTURES: &[&str] = &["png", "jpg", "jpeg"];

/// Makes `copy` a folder of links to everything in `scene` but `part`, a path below it, which `write` makes: it is given where
/// that is in the scene and where it goes. Nothing is done where the copy is there already and the scene is still what it was made
/// of; one that is half made, or of what is another scene by now, is made anew.
///
/// # Errors
/// The scene has no such part, `write` says one, or nothing can be written.
pub(crate) fn make(
    copy: &Path,
    scene: &Path,
    part: &Path,
    write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
) -> Result<(), LabError> {
    let folder = copy.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(LabError::file(folder))?;
    // Another process may be at it.
    let path = folder.join(".lock");
    let lock = File::create(&path).map_err(LabError::file(&path))?;
    // Some file systems have no locks.
    lock.lock().ok();
    let made = make_alone(copy, scene, part, write);
    lock.unlock().ok();
    made
}

/// See [`make`]; no other process is at it.
fn make_alone(
    copy: &Path,
    scene: &Path,
    part: &Path,
    write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
) -> Result<(), LabError> {
    let beside = |ending: &str| {
        let mut path = copy.to_owned().into_os_string();
        path.push(ending);
        PathBuf::from(path)
    };
    let (half, note) = (beside(".half"), beside(".of"));
    let state = state(scene)?;
    let is_of = || fs::read_to_string(&note).is_ok_and(|noted| noted == state);
    if copy.exists() && is_of() {
        return Ok(());
    }
    make_at(&half, scene, part, write)?;
    if copy.exists() {
        fs::remove_dir_all(copy).map_err(LabError::file(copy))?;
    }
    fs::rename(&half, copy).map_err(LabError::file(copy))?;
    write_whole(&note, &state)
}

/// Stands for where a scene is and what is in it: names, sizes and times of its files.
fn state(scene: &Path) -> Result<String, LabError> {
    let mut found = vec![scene.to_string_lossy().into_owned()];
    list(scene, DEEPEST, &mut found)?;
    Ok(hex(&hashed(found.iter().map(String::as_str))[..8]))
}

/// Folders are not looked into that lie so deep in a scene: links may lead in a circle.
const DEEPEST: usize = 6;

fn list(folder: &Path, depth: usize, found: &mut Vec<String>) -> Result<(), LabError> {
    for entry in entries(folder)? {
        // What a link leads to; one that leads nowhere is no file.
        let Ok(about) = fs::metadata(&entry) else {
            continue;
        };
        if about.is_dir() {
            if depth > 1 {
                list(&entry, depth - 1, found)?;
            }
        } else {
            let (size, time) = (about.len(), about.modified().ok());
            found.push(format!("{} {size} {time:?}", entry.display()));
        }
    }
    Ok(())
}

fn make_at(
    half: &Path,
    scene: &Path,
    part: &Path,
    write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
) -> Result<(), LabError> {
    if half.exists() {
        fs::remove_dir_all(half).map_err(LabError::file(half))?;
    }
    link_all_but(scene, half, part)?;
    write(&scene.join(part), &half.join(part))
}

/// What is in a folder, in order.
pub(crate) fn entries(folder: &Path) -> Result<Vec<PathBuf>, LabError> {
    let read = fs::read_dir(folder).map_err(LabError::file(folder))?;
    let paths = read.map(|entry| entry.map(|entry| entry.path()));
    let mut paths: Vec<PathBuf> = paths
        .collect::<Result<_, _>>()
        .map_err(LabError::file(folder))?;
    paths.sort();
    Ok(paths)
}

/// Makes `to` a folder of everything in `from`: `write` makes the files with one of these endings, of which it is given the stem,
/// where it is and where it goes; others are links.
pub(crate) fn rewrite(
    from: &Path,
    to: &Path,
    endings: &[&str],
    mut write: impl FnMut(&str, &Path, &Path) -> Result<(), LabError>,
) -> Result<(), LabError> {
    fs::create_dir_all(to).map_err(LabError::file(to))?;
    for file in entries(from)? {
        let target = to.join(file.file_name().unwrap_or_default());
        if has_ending(&file, endings) {
            let stem = file.file_stem().unwrap_or_default().to_string_lossy();
            write(&stem, &file, &target)?;
        } else {
            link(&file, &target).map_err(LabError::file(&target))?;
        }
    }
    Ok(())
}

/// Width and height of a picture as it is stored, px.
pub(crate) fn picture_size(path: &Path) -> Result<DVec2, LabError> {
    let size = image::image_dimensions(path).map_err(|e| LabError::content(path, e))?;
    Ok(DVec2::new(f64::from(size.0), f64::from(size.1)))
}

/// Whether a path ends in a dot and one of these, in large or small letters.
pub(crate) fn has_ending(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str());
    ending.is_some_and(|ending| endings.iter().any(|e| ending.eq_ignore_ascii_case(e)))
}

fn link_all_but(from: &Path, to: &Path, but: &Path) -> Result<(), LabError> {
    fs::create_dir_all(to).map_err(LabError::file(to))?;
    let mut parts = but.components();
    let Some(first) = parts.next() else {
        return Ok(());
    };
    for entry in entries(from)? {
        let name = entry.file_name().unwrap_or_default();
        let target = to.join(name);
        if name == first.as_os_str() {
            if !parts.as_path().as_os_str().is_empty() {
                link_all_but(&entry, &target, parts.as_path())?;
            }
        } else {
            link(&entry, &target).map_err(LabError::file(&target))?;
        }
    }
    Ok(())
}

#[cfg(unix)]
fn link(original: &Path, link: &Path) -> std::io::Result<()> {
    std::os::unix::fs::symlink(original, link)
}

#[cfg(windows)]
fn link(original: &Path, link: &Path) -> std::io::Result<()> {
    if original.is_dir() {
        std::os::windows::fs::symlink_dir(original, link)
    } else {
        std::os::windows::fs::symlink_file(original, link)
    }
}
