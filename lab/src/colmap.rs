//! Poses in a sparse model of COLMAP's, binary or text, and the same file with others in their place
//! (<https://colmap.github.io/format.html>).

use crate::error::LabError;
use glam::{DQuat, DVec2, DVec3};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Where a scene has its poses, relative to it: the file that `limpid` reads.
pub(crate) fn images_file(scene: &Path) -> Option<PathBuf> {
    let folders = ["sparse", "sparse/0"].map(|f| Path::new("flow3d_preprocessed/colmap").join(f));
    let files = folders
        .iter()
        .flat_map(|folder| ["images.bin", "images.txt"].map(|name| folder.join(name)));
    files.into_iter().find(|file| scene.join(file).is_file())
}

/// Camera from world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pose {
    /// Of length one.
    pub(crate) rotation: DQuat,
    pub(crate) translation: DVec3,
}

/// An image of a model.
#[derive(Debug)]
pub(crate) struct Posed {
    /// The file's name without folder and ending.
    pub(crate) stem: String,
    pub(crate) camera: u32,
    pub(crate) pose: Pose,
    /// Where the file has it: the pose in a binary one, the line in text.
    at: Range<usize>,
}

/// A camera of a model; its distortion is left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Lens {
    /// Width and height, px.
    pub(crate) size: DVec2,
    /// px
    pub(crate) focal: DVec2,
    /// px
    pub(crate) center: DVec2,
    /// Whether it has no distortion.
    pub(crate) is_pinhole: bool,
}

impl Lens {
    /// The same for pictures of another size.
    pub(crate) fn of_size(self, size: DVec2) -> Self {
        let factor = size / self.size;
        Self {
            size,
            focal: self.focal * factor,
            center: self.center * factor,
            ..self
        }
    }
}

/// COLMAP's camera models by their numbers: name, how many parameters, and whether there are two focal lengths.
const MODELS: [(&str, usize, bool); 11] = [
    ("SIMPLE_PINHOLE", 3, false),
    ("PINHOLE", 4, true),
    ("SIMPLE_RADIAL", 4, false),
    ("RADIAL", 5, false),
    ("OPENCV", 8, true),
    ("OPENCV_FISHEYE", 8, true),
    ("FULL_OPENCV", 12, true),
    ("FOV", 5, true),
    ("SIMPLE_RADIAL_FISHEYE", 4, false),
    ("RADIAL_FISHEYE", 5, false),
    ("THIN_PRISM_FISHEYE", 12, true),
];

/// The poses of a model.
#[derive(Debug)]
pub(crate) struct Model {
    path: PathBuf,
    bytes: Vec<u8>,
    pub(crate) images: Vec<Posed>,
    pub(crate) lenses: BTreeMap<u32, Lens>,
}

impl Model {
    /// A model from its file of poses, and that of cameras beside it.
    pub(crate) fn read(path: &Path) -> Result<Self, LabError> {
        let bytes = fs::read(path).map_err(LabError::file(path))?;
        let cameras = path.with_file_name(if is_text(path) {
            "cameras.txt"
        } else {
            "cameras.bin"
        });
        let lenses = fs::read(&cameras).map_err(LabError::file(&cameras))?;
        let broken = |path: &Path| LabError::content(path, "not a file of COLMAP's");
        let (images, lenses) = if is_text(path) {
            (text_images(&bytes), text_lenses(&lenses))
        } else {
            (binary_images(&bytes), binary_lenses(&lenses))
        };
        Ok(Self {
            path: path.to_owned(),
            images: images.ok_or_else(|| broken(path))?,
            lenses: lenses.ok_or_else(|| broken(&cameras))?,
            bytes,
        })
    }

    /// Which images are training frames, of which these are the stems, by the rule that `limpid` has: those of the same names,
    /// where the model has no others or there are no test views, and else those with an even number, or one that ends in `_left`.
    pub(crate) fn training(
        &self,
        stems: &BTreeSet<String>,
        has_test_views: bool,
    ) -> Result<Vec<usize>, LabError> {
        let all = 0..self.images.len();
        let same: Vec<usize> = all
            .clone()
            .filter(|at| stems.contains(&self.images[*at].stem))
            .collect();
        if same.len() == self.images.len() || (!has_test_views && same.len() == stems.len()) {
            return Ok(same);
        }
        let mut training = Vec::new();
        for at in all {
            let stem = &self.images[at].stem;
            let last = stem.bytes().last().filter(u8::is_ascii_digit);
            let is_left = match (
                stem.strip_suffix("_left"),
                stem.strip_suffix("_right"),
                last,
            ) {
                (Some(_), ..) => true,
                (_, Some(_), _) => false,
                (.., Some(digit)) => digit % 2 == 0,
                _ => {
                    let what = format!("it cannot be told whether `{stem}` is left or right");
                    return Err(LabError::content(&self.path, what));
                }
            };
            if is_left {
                training.push(at);
            }
        }
        Ok(training)
    }

    /// The file with other poses for some images; all else is as it was, byte by byte.
    pub(crate) fn with(&self, poses: &BTreeMap<usize, Pose>) -> Vec<u8> {
        let (mut out, mut done) = (Vec::new(), 0);
        for (&image, pose) in poses {
            let at = &self.images[image].at;
            out.extend(&self.bytes[done..at.start]);
            let (r, t) = (pose.rotation, pose.translation);
            let numbers = [r.w, r.x, r.y, r.z, t.x, t.y, t.z];
            if is_text(&self.path) {
                let line = String::from_utf8_lossy(&self.bytes[at.clone()]);
                let mut fields: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
                for (field, number) in fields[1..8].iter_mut().zip(numbers) {
                    *field = number.to_string();
                }
                out.extend(fields.join(" ").bytes());
            } else {
                out.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
            }
            done = at.end;
        }
        out.extend(&self.bytes[done..]);
        out
    }
}

fn is_text(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "txt")
}

fn posed(numbers: [f64; 7], camera: u32, name: &str, at: Range<usize>) -> Option<Posed> {
    let [w, x, y, z, translation @ ..] = numbers;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let translation = DVec3::from_array(translation);
    let is_pose = translation.is_finite() && (1e-6..f64::INFINITY).contains(&rotation.length());
    let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    is_pose.then(|| Posed {
        stem: stem.to_owned(),
        camera,
        pose: Pose {
            rotation: rotation.normalize(),
            translation,
        },
        at,
    })
}

fn lens(
    size: [f64; 2],
    numbers: &[f64],
    (model, _, two_focals): (&str, usize, bool),
) -> Option<Lens> {
    let (focal, rest) = if two_focals {
        (
            DVec2::new(*numbers.first()?, *numbers.get(1)?),
            &numbers[2..],
        )
    } else {
        (DVec2::splat(*numbers.first()?), &numbers[1..])
    };
    let center = DVec2::new(*rest.first()?, *rest.get(1)?);
    let size = DVec2::from_array(size);
    let is_lens = focal.min_element() > 0.0 && (focal + center + size).is_finite();
    is_lens.then_some(Lens {
        size,
        focal,
        center,
        is_pinhole: model.ends_with("PINHOLE"),
    })
}

/// A place in a binary file.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let found = self.bytes.get(self.at..)?.first_chunk()?;
        self.at += N;
        Some(*found)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    /// A text that ends with a zero.
    fn text(&mut self) -> Option<&'a str> {
        let rest = self.bytes.get(self.at..)?;
        let end = rest.iter().position(|byte| *byte == 0)?;
        self.at += end + 1;
        std::str::from_utf8(&rest[..end]).ok()
    }

    fn skip(&mut self, count: u64, each: usize) -> Option<()> {
        let bytes = usize::try_from(count).ok()?.checked_mul(each)?;
        self.at = self.at.checked_add(bytes)?;
        (self.at <= self.bytes.len()).then_some(())
    }
}

fn binary_images(bytes: &[u8]) -> Option<Vec<Posed>> {
    let mut file = Cursor { bytes, at: 0 };
    let mut images = Vec::new();
    for _ in 0..file.u64()? {
        file.u32()?;
        let start = file.at;
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = file.f64()?;
        }
        let at = start..file.at;
        let camera = file.u32()?;
        let name = file.text()?;
        let points = file.u64()?;
        file.skip(points, 24)?;
        images.push(posed(numbers, camera, name, at)?);
    }
    Some(images)
}

fn binary_lenses(bytes: &[u8]) -> Option<BTreeMap<u32, Lens>> {
    let mut file = Cursor { bytes, at: 0 };
    let mut lenses = BTreeMap::new();
    for _ in 0..file.u64()? {
        let id = file.u32()?;
        let model = *MODELS.get(usize::try_from(file.u32()?).ok()?)?;
        let size = [file.u64()? as f64, file.u64()? as f64];
        let numbers: Option<Vec<f64>> = (0..model.1).map(|_| file.f64()).collect();
        lenses.insert(id, lens(size, &numbers?, model)?);
    }
    Some(lenses)
}

/// Lines that are no comments, and where they are.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut start = 0;
    let lines = text.split_inclusive('\n').map(move |line| {
        let at = start;
        start += line.len();
        (at, line.trim_end_matches(['\n', '\r']))
    });
    lines.filter(|(_, line)| !line.trim_start().starts_with('#'))
}

fn text_images(bytes: &[u8]) -> Option<Vec<Posed>> {
    let mut lines = lines(std::str::from_utf8(bytes).ok()?);
    let mut images = Vec::new();
    // Two lines an image; the second, with its 2D points, may be empty.
    while let Some((at, line)) = lines.find(|(_, line)| !line.trim().is_empty()) {
        let mut fields = line.split_whitespace().skip(1);
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = fields.next()?.parse().ok()?;
        }
        let camera = fields.next()?.parse().ok()?;
        let name = fields.collect::<Vec<_>>().join(" ");
        lines.next();
        images.push(posed(numbers, camera, &name, at..at + line.len())?);
    }
    Some(images)
}

fn text_lenses(bytes: &[u8]) -> Option<BTreeMap<u32, Lens>> {
    let mut lenses = BTreeMap::new();
    let lines = lines(std::str::from_utf8(bytes).ok()?);
    for (_, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
        let mut fields = line.split_whitespace();
        let id = fields.next()?.parse().ok()?;
        let name = fields.next()?;
        let model = *MODELS.iter().find(|model| model.0 == name)?;
        let numbers: Option<Vec<f64>> = fields.map(|field| field.parse().ok()).collect();
        let (size, numbers) = numbers.as_ref()?.split_first_chunk()?;
        lenses.insert(id, lens(*size, numbers, model)?);
    }
    Some(lenses)
}
