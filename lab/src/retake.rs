//! Frames taken anew of the sharp truth, by a camera of which everything is known: so the true kernels are.

use crate::arrays::Array;
use crate::colmap::{Lens, Model, images_file};
use crate::copies::{PICTURES, entries, has_ending, picture_size, rewrite};
use crate::error::LabError;
use crate::perturb::{Draw, Perturb, median};
use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use image::RgbImage;
use std::fs;
use std::path::{Path, PathBuf};

/// The training frames of a scene.
pub(crate) const FRAMES: &str = "images";

/// Where the truth says from which cameras a frame's light came.
pub(crate) const EXPOSURE: &str = "truth/exposure";

/// The training frames without blur.
const SHARP: &str = "truth/images_sharp";

/// Cameras from which a frame's light comes in equal parts.
const CAMERAS: usize = 128;

/// Steps that cover a square evenly: powers of the inverse of the number whose cube is one more than itself (M. Roberts' R2).
const STEPS: [f64; 2] = [0.754_877_666_246_692_7, 0.569_840_290_998_053_3];

/// A scene's camera as it takes frames anew.
pub(crate) struct Retake {
    scene: PathBuf,
    /// Folder of true depth.
    truth: PathBuf,
    lens: Lens,
    /// Median of the true depths, scene units.
    depth: f64,
    /// Disparities between which the middle four fifths of the pixels lie, far and near, 1 / scene units.
    disparities: [f64; 2],
    shake_px: f64,
    disc_px: f64,
}

impl Retake {
    /// Of a scene with its folder of true depth, as [`Perturb::shake_px`] and [`Perturb::disc_px`] say.
    pub(crate) fn new(scene: &Path, truth: &Path, by: &Perturb) -> Result<Self, LabError> {
        let file = images_file(scene);
        let file = file.unwrap_or_else(|| "flow3d_preprocessed/colmap/sparse".into());
        let model = Model::read(&scene.join(&file))?;
        let mut lenses = model.lenses.values();
        let lens = *lenses.next().ok_or_else(|| {
            LabError::content(&scene.join(&file), "it knows no camera of any image")
        })?;
        if lenses.any(|other| *other != lens) {
            let what = "its cameras differ in size or focal length: frames are taken anew by one";
            return Err(LabError::content(&scene.join(&file), what));
        }
        if !lens.is_pinhole {
            let what = "its lens is distorted: frames are taken anew by a pinhole";
            return Err(LabError::content(&scene.join(&file), what));
        }
        let frames = scene.join(FRAMES);
        let mut pictures = entries(&frames)?
            .into_iter()
            .filter(|file| has_ending(file, PICTURES));
        let size = picture_size(&pictures.next().unwrap_or(frames))?;
        let mut depths = Vec::new();
        for file in entries(truth)? {
            if has_ending(&file, &["npy"]) {
                let is_there = |z: &f32| *z > 0.0 && z.is_finite();
                depths.extend(Array::read(&file)?.values.into_iter().filter(is_there));
            }
        }
        let at = |share: f64, depths: &mut Vec<f32>| {
            let place = (share * (depths.len() - 1) as f64) as usize;
            f64::from(*depths.select_nth_unstable_by(place, f32::total_cmp).1)
        };
        let Some(depth) = median(depths.clone()) else {
            return Err(LabError::content(truth, "there is no depth in it"));
        };
        let disparities = [0.9, 0.1].map(|share| 1.0 / at(share, &mut depths));
        Ok(Self {
            scene: scene.to_owned(),
            truth: truth.to_owned(),
            lens: lens.of_size(size),
            depth,
            disparities,
            shake_px: by.shake_px,
            disc_px: by.disc_px,
        })
    }

    /// From the camera of the frame's pose to those from which its light comes, in the scene's units.
    fn cameras(&self, frame: &str, draw: Draw<'_>) -> Vec<DAffine3> {
        let lens = &self.lens;
        let mut noise = draw.noise("retake", frame);
        let mut vector = || DVec2::new(noise.either_way(), noise.either_way());
        let [turned, moved] = [vector(), vector()].map(|way| way.normalize_or(DVec2::X));
        let [turn_bend, move_bend] = [vector(), vector()];
        let [length, focus] = vector().to_array().map(|x| 0.5 + 0.5 * x);
        // Some frames are sharper than others, or no method could tell the blur from the world.
        let half = 0.5 * self.shake_px * (0.2 + 0.8 * length);
        let [far, near] = self.disparities;
        let focus = far + focus * (near - far);
        let range = (near - far).max(1e-3 / self.depth);
        let aperture = self.disc_px / (2.0 * lens.focal.x * range);
        let cameras = (0..CAMERAS).zip(disc()).map(|(k, point)| {
            let s = (k as f64 + 0.5) / CAMERAS as f64 - 0.5;
            let px = |way: DVec2, bend: DVec2| half * (way * s + bend * s * s) / lens.focal;
            // What is ahead moves by (y, -x) of a turn about x and y.
            let by = px(turned, turn_bend);
            let turn = 0.5 * DVec3::new(-by.y, by.x, 0.0);
            let turn = DQuat::from_xyzw(turn.x, turn.y, turn.z, 1.0).normalize();
            let shift = self.depth * px(moved, move_bend);
            let path = DAffine3::from_rotation_translation(turn, shift.extend(0.0));
            // x += a u (d z - 1): what lies in focus is where the lens' middle sees it.
            let slope = aperture * point;
            let shear = DAffine3 {
                matrix3: DMat3::from_cols(DVec3::X, DVec3::Y, (focus * slope).extend(1.0)),
                translation: -slope.extend(0.0),
            };
            shear * path
        });
        cameras.collect()
    }

    /// Makes the folder of training frames.
    pub(crate) fn frames(&self, from: &Path, to: &Path, draw: Draw<'_>) -> Result<(), LabError> {
        rewrite(from, to, PICTURES, |frame, _, to| {
            let sharp = self.sharp(frame)?;
            let depth = Array::read(&self.truth.join(format!("{frame}.npy")))?;
            let [height, width] = [sharp.height(), sharp.width()].map(u64::from);
            if depth.shape != [height, width] {
                let what = format!("the true depth of {frame} is {:?}, not [H, W]", depth.shape);
                return Err(LabError::content(&self.scene, what));
            }
            if DVec2::new(width as f64, height as f64) != self.lens.size {
                let what = format!("the sharp picture of {frame} has not the size of the frames");
                return Err(LabError::content(&self.scene, what));
            }
            let cameras = self.cameras(frame, draw);
            let taken = self.taken(&sharp, &depth.values, &cameras);
            let to = to.with_extension("png");
            taken.save(&to).map_err(|e| LabError::content(&to, e))
        })
    }

    /// Makes the folder of the truth about them.
    pub(crate) fn exposures(&self, to: &Path, draw: Draw<'_>) -> Result<(), LabError> {
        fs::create_dir_all(to).map_err(LabError::file(to))?;
        for file in entries(&self.scene.join(FRAMES))? {
            if !has_ending(&file, PICTURES) {
                continue;
            }
            let frame = file.file_stem().unwrap_or_default().to_string_lossy();
            let cameras = self.cameras(&frame, draw);
            let rows = cameras.iter().flat_map(|camera| {
                let (m, t) = (camera.matrix3.transpose(), camera.translation);
                [0, 1, 2].map(|row| m.col(row).extend(t[row]).to_array())
            });
            let array = Array {
                shape: vec![cameras.len() as u64, 3, 4],
                values: rows.flatten().map(|x| x as f32).collect(),
            };
            array.write(&to.join(format!("{frame}.npy")))?;
        }
        Ok(())
    }

    fn sharp(&self, frame: &str) -> Result<RgbImage, LabError> {
        let folder = self.scene.join(SHARP);
        let paths = PICTURES
            .iter()
            .map(|end| folder.join(format!("{frame}.{end}")));
        let Some(path) = paths.into_iter().find(|path| path.is_file()) else {
            let what = format!("there is no sharp picture of {frame}: leave it out with `except`");
            return Err(LabError::content(&folder, what));
        };
        let sharp = image::open(&path).map_err(|e| LabError::content(&path, e))?;
        Ok(sharp.into_rgb8())
    }

    /// What cameras collect of a picture in light: every pixel from where they see what it shows, as far as its middle is.
    fn taken(&self, sharp: &RgbImage, depth: &[f32], cameras: &[DAffine3]) -> RgbImage {
        let lens = &self.lens;
        let light: Vec<f64> = (0..=255).map(|v| to_light(f64::from(v) / 255.0)).collect();
        let light = |x: u32, y: u32| {
            DVec3::from_array(sharp.get_pixel(x, y).0.map(|v| light[usize::from(v)]))
        };
        let back: Vec<DAffine3> = cameras.iter().map(DAffine3::inverse).collect();
        let last = DVec2::new(f64::from(sharp.width() - 1), f64::from(sharp.height() - 1));
        let seen_at = |place: DVec2| {
            let place = (place - 0.5).clamp(DVec2::ZERO, last);
            let (corner, part) = (place.floor(), place.fract_gl());
            let next = (corner + 1.0).min(last);
            let [x, y, u, v] = [corner.x, corner.y, next.x, next.y].map(|k| k as u32);
            let above = light(x, y).lerp(light(u, y), part.x);
            above.lerp(light(x, v).lerp(light(u, v), part.x), part.y)
        };
        RgbImage::from_fn(sharp.width(), sharp.height(), |x, y| {
            let z = f64::from(depth[(y * sharp.width() + x) as usize]);
            let z = if z > 0.0 && z.is_finite() {
                z
            } else {
                self.depth
            };
            let at = DVec2::new(f64::from(x), f64::from(y)) + 0.5;
            let point = ((at - lens.center) / lens.focal).extend(1.0) * z;
            let collected = back.iter().map(|back| {
                let point = back.transform_point3(point);
                seen_at(lens.focal * point.truncate() / point.z + lens.center)
            });
            let mean = collected.sum::<DVec3>() / back.len() as f64;
            image::Rgb(
                mean.to_array()
                    .map(|v| (255.0 * from_light(v)).round() as u8),
            )
        })
    }
}

/// Points that cover the unit disc evenly.
fn disc() -> impl Iterator<Item = DVec2> {
    let square = (1..).map(|k| {
        let k = f64::from(k);
        DVec2::from_array(STEPS.map(|step| 2.0 * (step * k).fract() - 1.0))
    });
    square.filter(|point| point.length_squared() <= 1.0)
}

/// sRGB's curve (IEC 61966-2-1).
fn to_light(value: f64) -> f64 {
    if value <= 0.04045 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

fn from_light(light: f64) -> f64 {
    if light <= 0.003_130_8 {
        12.92 * light
    } else {
        1.055 * light.powf(1.0 / 2.4) - 0.055
    }
}
