//! Where scenes are, and copies of them in which something is as in truth, or worse than it is.

use crate::arrays::Array;
use crate::colmap::images_file;
use crate::copies::{entries, make, rewrite};
use crate::error::LabError;
use crate::perturb::{Draw, Perturb, depth, masks, tracks};
use crate::poses::poses;
use crate::retake::{EXPOSURE, FRAMES, Retake};
use crate::study::Truth;
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

/// Its tracks, and where they are when there is no such folder of arrays.
const TRACKS: [&str; 2] = [
    "flow3d_preprocessed/2d_tracks",
    "flow3d_preprocessed/2d_tracks.npz",
];

impl Scenes {
    /// The folder of a scene, with the given parts as in truth and others perturbed, by what the run's seed draws.
    ///
    /// # Errors
    /// There is no such scene, it has not such a part, or a copy cannot be made.
    pub fn find(
        &self,
        name: &str,
        seed: u64,
        replaced: &[Truth],
        perturb: &Perturb,
    ) -> Result<PathBuf, LabError> {
        let folder = if name == "demo" {
            self.demo.clone()
        } else {
            let all = self.folder.as_ref().ok_or_else(|| {
                let need = "is not in the repository: say where with --scenes DIR";
                LabError::Asked(format!("the scene `{name}` {need}"))
            })?;
            all.join(name)
        };
        let scene = fs::canonicalize(&folder).map_err(LabError::file(&folder))?;
        let links = std::path::absolute(&self.links).map_err(LabError::file(&self.links))?;
        let mut copy = Changed {
            links,
            name: name.to_owned(),
            folder: scene.clone(),
        };
        let draw = Draw { scene: name, seed };
        if perturb.shake_px > 0.0 || perturb.disc_px > 0.0 {
            copy.retake(perturb, draw)?;
        }
        if perturb.poses_px > 0.0 {
            let file = images_file(&scene);
            let file = file.unwrap_or_else(|| "flow3d_preprocessed/colmap/sparse".into());
            let px = perturb.poses_px;
            let beside = (scene.join(DEPTH), scene.join("images"));
            copy.perturb("poses_px", px, seed, &file, |from, to| {
                poses(from, to, (&beside.0, &beside.1), px, draw)
            })?;
        }
        if replaced.contains(&Truth::Depth) {
            let truth = scene.join(TRUE_DEPTH);
            if !has_some(&truth) {
                return Err(missing(&truth));
            }
            let name = format!("{}+depth", copy.name);
            copy.change(name, Path::new(DEPTH), |_, to| true_depth(&truth, to))?;
        }
        if perturb.depth > 0.0 {
            let by = perturb.depth;
            copy.perturb("depth", by, seed, Path::new(DEPTH), |from, to| {
                depth(from, to, by, draw)
            })?;
        }
        if perturb.tracks_px > 0.0 {
            let px = perturb.tracks_px;
            let is_there = |part: &&&str| has_some(&scene.join(part));
            let part = Path::new(TRACKS.iter().find(is_there).unwrap_or(&TRACKS[0]));
            copy.perturb("tracks_px", px, seed, part, |from, to| {
                tracks(from, to, px, draw)
            })?;
        }
        if perturb.mask_squares > 0 {
            let squares = perturb.mask_squares;
            let part = Path::new("masks");
            copy.perturb("mask_squares", squares.into(), seed, part, |from, to| {
                masks(from, to, squares, draw)
            })?;
        }
        Ok(copy.folder)
    }

    /// An error where a scene lacks what a run is to be given from the truth.
    ///
    /// # Errors
    /// It does.
    pub fn check_truth(&self, scene: &Path, arguments: &[String]) -> Result<(), LabError> {
        let given = arguments.iter().find_map(|a| a.strip_prefix("images="));
        match given.map(|images| scene.join(unquoted(images))) {
            Some(images) if !images.is_dir() => Err(missing(&images)),
            _ => Ok(()),
        }
    }
}

/// Text as it was before `--set` needed it in quotes.
fn unquoted(text: &str) -> String {
    let table = format!("v = {text}").parse::<toml::Table>().ok();
    let value = table.and_then(|mut table| table.remove("v"));
    match value {
        Some(toml::Value::String(inner)) => inner,
        _ => text.to_owned(),
    }
}

/// A scene, or a copy of one with one thing after the other changed.
struct Changed {
    /// Where copies go.
    links: PathBuf,
    /// Its name there.
    name: String,
    /// Where it is.
    folder: PathBuf,
}

impl Changed {
    /// With another `part`, a path below it, which `write` makes of the one that there is.
    fn change(
        &mut self,
        name: String,
        part: &Path,
        write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
    ) -> Result<(), LabError> {
        let there = self.folder.join(part);
        if !has_some(&there) {
            return Err(missing(&there));
        }
        self.put(name, part, write)
    }

    /// The same, whether there is such a part or not.
    fn put(
        &mut self,
        name: String,
        part: &Path,
        write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
    ) -> Result<(), LabError> {
        let copy = self.links.join(&name);
        make(&copy, &self.folder, part, write)?;
        self.folder = copy;
        self.name = name;
        Ok(())
    }

    /// With frames that are taken anew, and the truth about them.
    fn retake(&mut self, by: &Perturb, draw: Draw<'_>) -> Result<(), LabError> {
        let truth = self.folder.join(TRUE_DEPTH);
        if !has_some(&truth) {
            return Err(missing(&truth));
        }
        let retake = Retake::new(&self.folder, &truth, by)?;
        let (shake, disc, seed) = (by.shake_px, by.disc_px, draw.seed);
        let name = format!("{}+shake_px-{shake}+disc_px-{disc}-seed-{seed}", self.name);
        self.put(format!("{name}+exposure"), Path::new(EXPOSURE), |_, to| {
            retake.exposures(to, draw)
        })?;
        self.change(name, Path::new(FRAMES), |from, to| {
            retake.frames(from, to, draw)
        })
    }

    /// See [`Changed::change`]; the name says what was perturbed, how much, and by which draw.
    fn perturb(
        &mut self,
        what: &str,
        much: f64,
        seed: u64,
        part: &Path,
        write: impl FnOnce(&Path, &Path) -> Result<(), LabError>,
    ) -> Result<(), LabError> {
        let name = format!("{}+{what}-{much}-seed-{seed}", self.name);
        self.change(name, part, write)
    }
}

/// Whether there is such a file, or a folder with something in it.
fn has_some(path: &Path) -> bool {
    path.is_file() || entries(path).is_ok_and(|entries| !entries.is_empty())
}

fn missing(part: &Path) -> LabError {
    LabError::content(
        part,
        "the scene has no such file or folder: leave it out of the variant or knob with `except`",
    )
}

/// Makes a folder of disparity (f32) of one of z-depth; 0 is missing.
fn true_depth(from: &Path, to: &Path) -> Result<(), LabError> {
    rewrite(from, to, &["npy"], |_, from, to| {
        let mut array = Array::read(from)?;
        for z in &mut array.values {
            *z = if *z > 0.0 { 1.0 / *z } else { 0.0 };
        }
        array.write(to)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use half::f16;
    use npyz::{NpyFile, WriterBuilder as _};

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
        let copy = scenes
            .find("s", 1, &[Truth::Depth], &Perturb::default())
            .expect("links");
        assert_eq!(
            scenes
                .find("s", 1, &[Truth::Depth], &Perturb::default())
                .expect("again"),
            copy
        );
        assert_ne!(
            scenes
                .find("s", 1, &[], &Perturb::default())
                .expect("the scene"),
            copy
        );
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

        // A scene whose files are others by now is another scene.
        let again = || {
            let perturb = Perturb::default();
            let copy = scenes.find("s", 1, &[Truth::Depth], &perturb);
            array(&copy.expect("links").join(DEPTH).join("0.npy"))
        };
        let before = fs::metadata(copy.join(DEPTH)).expect("there").modified();
        again();
        let after = fs::metadata(copy.join(DEPTH)).expect("there").modified();
        assert_eq!(
            before.expect("a time"),
            after.expect("a time"),
            "not made anew"
        );
        let nearer = [2.0, 0.5, 0.0, 8.0, 1.0, 1.0].map(f16::from_f32);
        fs::remove_file(scene.join(TRUE_DEPTH).join("0.npy")).expect("removed");
        write(&format!("{TRUE_DEPTH}/0.npy"), &nearer[..4]);
        assert_eq!(again(), [0.5, 2.0, 0.0, 0.125]);
        fs::rename(&scene, folder.path().join("scenes/t")).expect("renamed");
        let copy = scenes.find("t", 1, &[Truth::Depth], &Perturb::default());
        let picture = copy.expect("links").join("images/0.png");
        assert_eq!(fs::read_to_string(picture).expect("a link"), "picture");
    }

    #[test]
    fn what_is_not_there_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let scenes = scenes(folder.path());
        let missing = scenes
            .find("s", 1, &[], &Perturb::default())
            .expect_err("no such scene");
        assert!(missing.to_string().contains('s'), "{missing}");
        let nowhere = Scenes {
            folder: None,
            ..scenes.clone()
        };
        let said = nowhere
            .find("s", 1, &[], &Perturb::default())
            .expect_err("no folder")
            .to_string();
        assert!(said.contains("--scenes"), "{said}");
        let demo = nowhere
            .find("demo", 1, &[], &Perturb::default())
            .expect("in the repository");
        assert!(
            scenes
                .check_truth(&demo, &["images=truth/images_sharp".into()])
                .is_ok()
        );
        let quoted = nowhere.check_truth(&demo, &["images=\"truth/images_sharp\"".into()]);
        assert!(quoted.is_ok(), "as names with spaces are written");
        let said = scenes.check_truth(&demo, &["images=truth/none".into()]);
        let said = said.expect_err("no such truth").to_string();
        assert!(said.contains("except") && said.contains("none"), "{said}");
    }
}
