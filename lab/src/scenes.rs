//! Where scenes are, and copies of them in which something is as in truth: folders of links.

use crate::error::LabError;
use crate::study::Truth;
use half::f16;
use npyz::{NpyFile, WriterBuilder as _};
use std::fs;
use std::path::{Path, PathBuf};

/// Where the scenes of a study are.
#[derive(Clone, Debug)]
pub struct Scenes {
    /// The repository's scene, which studies call `demo`.
    pub demo: PathBuf,
    /// The folder of all others.
    pub folder: Option<PathBuf>,
    /// Where folders of links go.
    pub links: PathBuf,
}

/// The depth that a scene in the layout of Shape-of-Motion gives to training, as disparity.
const DEPTH: &str = "flow3d_preprocessed/aligned_depth_anything_colmap";

/// Its truth, as z-depth.
const TRUE_DEPTH: &str = "truth/depth";

impl Scenes {
    /// The folder of a scene, with the given parts as in truth.
    ///
    /// # Errors
    /// There is no such scene, it has not such a truth, or links cannot be made.
    pub fn find(&self, name: &str, replaced: &[Truth]) -> Result<PathBuf, LabError> {
        let folder = if name == "demo" {
            self.demo.clone()
        } else {
            let all = self.folder.as_ref().ok_or_else(|| {
                let need = "is not in the repository: say where with --scenes DIR";
                LabError::Asked(format!("the scene `{name}` {need}"))
            })?;
            all.join(name)
        };
        let folder = fs::canonicalize(&folder).map_err(LabError::file(&folder))?;
        replaced
            .iter()
            .try_fold(folder, |folder, truth| match truth {
                Truth::Images => Ok(folder),
                Truth::Depth => self.with_true_depth(name, &folder),
            })
    }

    /// An error where a scene lacks what a run is to be given from the truth.
    ///
    /// # Errors
    /// It does.
    pub fn check_truth(&self, scene: &Path, arguments: &[String]) -> Result<(), LabError> {
        let given = arguments.iter().find_map(|a| a.strip_prefix("images="));
        match given.map(|images| scene.join(images)) {
            Some(images) if !images.is_dir() => Err(LabError::content(
                &images,
                "there is no such folder: leave the scene out of the variant with `except`",
            )),
            _ => Ok(()),
        }
    }

    /// A copy of a scene, all links but for the depth, which is that of the truth.
    fn with_true_depth(&self, name: &str, scene: &Path) -> Result<PathBuf, LabError> {
        let links = std::path::absolute(&self.links).map_err(LabError::file(&self.links))?;
        let copy = links.join(format!("{name}+depth"));
        let whole = copy.join(".whole");
        if whole.exists() {
            return Ok(copy);
        }
        let truth = scene.join(TRUE_DEPTH);
        let arrays = entries(&truth)?;
        if copy.exists() {
            fs::remove_dir_all(&copy).map_err(LabError::file(&copy))?;
        }
        link_all_but(scene, &copy, Path::new(DEPTH))?;
        let depth = copy.join(DEPTH);
        fs::create_dir_all(&depth).map_err(LabError::file(&depth))?;
        for file in arrays {
            let target = depth.join(file.file_name().unwrap_or_default());
            write_disparity(&file, &target)?;
        }
        fs::write(&whole, "").map_err(LabError::file(&whole))?;
        Ok(copy)
    }
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, LabError> {
    let read = fs::read_dir(folder).map_err(LabError::file(folder))?;
    let paths = read.map(|entry| entry.map(|entry| entry.path()));
    let mut paths: Vec<PathBuf> = paths
        .collect::<Result<_, _>>()
        .map_err(LabError::file(folder))?;
    paths.sort();
    Ok(paths)
}

/// Makes `to` a folder of links to everything in `from` but `but`, a path below it.
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

/// Writes z-depth (f16 or f32, [H, W]) as disparity (f32), 0 where it is missing.
fn write_disparity(from: &Path, to: &Path) -> Result<(), LabError> {
    let bytes = fs::read(from).map_err(LabError::file(from))?;
    let open = || NpyFile::new(&bytes[..]).map_err(LabError::file(from));
    let shape = open()?.shape().to_vec();
    let depth: Vec<f32> = match open()?.try_data::<f32>() {
        Ok(data) => data.collect::<Result<_, _>>(),
        Err(file) => match file.try_data::<f16>() {
            Ok(data) => data.map(|value| value.map(f32::from)).collect(),
            Err(_) => return Err(LabError::content(from, "no array of f16 or f32")),
        },
    }
    .map_err(LabError::file(from))?;
    let mut out = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(&shape);
    let written = options.writer(&mut out).begin_nd().and_then(|mut writer| {
        writer.extend(depth.iter().map(|z| if *z > 0.0 { 1.0 / z } else { 0.0 }))?;
        writer.finish()
    });
    written.map_err(LabError::file(to))?;
    fs::write(to, out).map_err(LabError::file(to))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenes(folder: &Path) -> Scenes {
        Scenes {
            demo: Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo"),
            folder: Some(folder.join("scenes")),
            links: folder.join("links"),
        }
    }

    fn array(path: &Path) -> Vec<f32> {
        let bytes = fs::read(path).expect("an array");
        let file = NpyFile::new(&bytes[..]).expect("npy");
        assert_eq!(file.shape(), [2, 2], "as it was");
        file.into_vec().expect("f32")
    }

    #[test]
    fn a_scene_with_true_depth_is_the_scene_but_for_its_depth() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = folder.path().join("scenes/s");
        for (file, text) in [
            ("images/0.png", "picture"),
            ("flow3d_preprocessed/colmap/x", "model"),
        ] {
            let path = scene.join(file);
            fs::create_dir_all(path.parent().expect("a folder")).expect("made");
            fs::write(path, text).expect("written");
        }
        let write = |path: &str, values: &[f16]| {
            let mut out = Vec::new();
            let options = npyz::WriteOptions::new().default_dtype().shape(&[2, 2]);
            let mut writer = options.writer(&mut out).begin_nd().expect("npy");
            writer.extend(values.iter().copied()).expect("values");
            writer.finish().expect("npy");
            let path = scene.join(path);
            fs::create_dir_all(path.parent().expect("a folder")).expect("made");
            fs::write(path, out).expect("written");
        };
        write(&format!("{DEPTH}/0.npy"), &[f16::from_f32(9.0); 4]);
        let truth = [4.0, 0.5, 0.0, 8.0].map(f16::from_f32);
        write(&format!("{TRUE_DEPTH}/0.npy"), &truth);

        let scenes = scenes(folder.path());
        let copy = scenes.find("s", &[Truth::Depth]).expect("links");
        assert_eq!(scenes.find("s", &[Truth::Depth]).expect("again"), copy);
        assert_ne!(scenes.find("s", &[]).expect("the scene"), copy);
        assert_eq!(
            array(&copy.join(DEPTH).join("0.npy")),
            [0.25, 2.0, 0.0, 0.125]
        );
        for (file, text) in [
            ("images/0.png", "picture"),
            ("flow3d_preprocessed/colmap/x", "model"),
        ] {
            assert_eq!(fs::read_to_string(copy.join(file)).expect("a link"), text);
        }
        let untouched = fs::read(scene.join(DEPTH).join("0.npy")).expect("there");
        assert!(untouched.len() > 8, "the scene's own is as it was");
    }

    #[test]
    fn what_is_not_there_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let scenes = scenes(folder.path());
        let missing = scenes.find("s", &[]).expect_err("no such scene");
        assert!(missing.to_string().contains('s'), "{missing}");
        let nowhere = Scenes {
            folder: None,
            ..scenes.clone()
        };
        let said = nowhere.find("s", &[]).expect_err("no folder").to_string();
        assert!(said.contains("--scenes"), "{said}");
        let demo = nowhere.find("demo", &[]).expect("in the repository");
        assert!(
            scenes
                .check_truth(&demo, &["images=truth/images_sharp".into()])
                .is_ok()
        );
        let said = scenes.check_truth(&demo, &["images=truth/none".into()]);
        let said = said.expect_err("no such truth").to_string();
        assert!(said.contains("except") && said.contains("none"), "{said}");
    }
}
