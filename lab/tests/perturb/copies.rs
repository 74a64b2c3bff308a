//! The repository's scene, copies of it, and what is in them.

use limpid_lab::{Perturb, Scenes};
use npyz::NpyFile;
use std::collections::{BTreeMap, BTreeSet};
use std::error::Error;
use std::fs;
use std::io::{Cursor, Read as _};
use std::path::{Path, PathBuf};

pub(crate) type Outcome = Result<(), Box<dyn Error>>;

pub(crate) const DEPTH: &str = "flow3d_preprocessed/aligned_depth_anything_colmap";
pub(crate) const TRACKS: &str = "flow3d_preprocessed/2d_tracks.npz";
pub(crate) const IMAGES: &str = "flow3d_preprocessed/colmap/sparse/images.bin";

pub(crate) const NONE: Perturb = Perturb {
    depth: 0.0,
    tracks_px: 0.0,
    mask_squares: 0,
    poses_px: 0.0,
    shake_px: 0.0,
    disc_px: 0.0,
};

pub(crate) fn demo() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo")
}

/// Scenes of which `demo` is the given one, with copies in `folder`.
pub(crate) fn scenes(demo: PathBuf, folder: &Path) -> Scenes {
    Scenes {
        demo,
        folder: None,
        links: folder.to_owned(),
    }
}

pub(crate) fn copy(perturb: Perturb, seed: u64, folder: &Path) -> Result<PathBuf, Box<dyn Error>> {
    Ok(scenes(demo(), folder).find("demo", seed, &[], &perturb)?)
}

/// All files below a folder, as seen through links.
pub(crate) fn files(folder: &Path) -> std::io::Result<BTreeMap<PathBuf, Vec<u8>>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next)? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("below it").to_owned();
                found.insert(name, fs::read(&path)?);
            }
        }
    }
    Ok(found)
}

/// The names of files that differ between two folders.
pub(crate) fn differing(a: &Path, b: &Path) -> Result<BTreeSet<PathBuf>, Box<dyn Error>> {
    let (a, b) = (files(a)?, files(b)?);
    let names: BTreeSet<_> = a.keys().chain(b.keys()).cloned().collect();
    let differs = |name: &PathBuf| a.get(name) != b.get(name);
    Ok(names.into_iter().filter(differs).collect())
}

/// A copy of the repository's scene in `folder` whose files are its own, so that they can be changed.
pub(crate) fn whole_copy(folder: &Path) -> Result<PathBuf, Box<dyn Error>> {
    let scene = folder.join("scene");
    for (name, bytes) in files(&demo())? {
        let path = scene.join(name);
        fs::create_dir_all(path.parent().expect("a file lies in a folder"))?;
        fs::write(path, bytes)?;
    }
    Ok(scene)
}

pub(crate) fn array(bytes: &[u8]) -> std::io::Result<Vec<f32>> {
    NpyFile::new(bytes)?.into_vec()
}

/// Arrays in an archive, by their names.
pub(crate) fn archive(path: &Path) -> Result<BTreeMap<String, Vec<f32>>, Box<dyn Error>> {
    let mut zip = zip::ZipArchive::new(Cursor::new(fs::read(path)?))?;
    let mut arrays = BTreeMap::new();
    for i in 0..zip.len() {
        let mut entry = zip.by_index(i)?;
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes)?;
        arrays.insert(entry.name().to_owned(), array(&bytes)?);
    }
    Ok(arrays)
}
