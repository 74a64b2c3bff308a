//! Inputs of training made worse by so much: which, by how much, and how for depth, tracks and masks.

use crate::arrays::Array;
use crate::copies::{PICTURES, rewrite};
use crate::error::LabError;
use crate::hash::hashed;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use serde::{Deserialize, Serialize};
use std::fs;
use std::io::{Cursor, Read as _, Write as _};
use std::path::Path;
use toml::{Table, Value};
use zip::write::FileOptions;
use zip::{ZipArchive, ZipWriter};

/// How much worse the inputs of training are than the scene's; where it is 0, a part is as it is. (Frames that are taken anew are
/// blurred as much as is said, however blurry the scene's own are.)
///
/// A px is one of the scene's stored pictures, before `downscale`. What is drawn depends on the scene's name, the run's seed, the
/// part and the frame, and not on how much: a larger step errs in the same directions as a smaller one, and on every machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Perturb {
    /// x makes `a z + b m` of a frame's depth z, whose median is m, with a between 1 - x and 1 + x and b between -x / 2 and x / 2,
    /// drawn for each frame. No depth is shifted to less than half of `a z`. Below 1.
    pub depth: f64,
    /// Every place of every track is moved by up to so many px to the left or right, and up or down.
    pub tracks_px: f64,
    /// In so many squares of each mask what moved stands still, and what stood still moves. Their sides are 25/512 of its width.
    pub mask_squares: u16,
    /// The camera of every training frame is turned and shifted, so that points at the scene's median depth move by so many px
    /// (root mean square over pictures and frames); about as far by turning as by shifting, and both are zero on average over
    /// the frames, in the world's axes: else the scene would be elsewhere for the test views. Those stay where they are.
    pub poses_px: f64,
    /// Frames are taken anew of the sharp truth, with the true depth, by a camera that shakes while its shutter is open: turning and
    /// shifting each move a point at the median depth along a bent path, which is about half as many px long, and in the calmest
    /// frames a tenth. The copy's truth holds the cameras, from which `limpid` computes true kernels.
    pub shake_px: f64,
    /// The same by a lens whose focus is elsewhere in each frame, between depths that a tenth of the pixels lie before and behind:
    /// what is at one of these while it is focused at the other becomes a disc with a diameter of so many px.
    pub disc_px: f64,
}

impl Perturb {
    /// Its fields' names.
    pub(crate) const PARTS: [&str; 6] = [
        "depth",
        "tracks_px",
        "mask_squares",
        "poses_px",
        "shake_px",
        "disc_px",
    ];

    /// Whether anything is other than in the scene.
    #[must_use]
    pub fn is_any(&self) -> bool {
        *self != Self::default()
    }

    /// With one of its parts at another value.
    ///
    /// # Errors
    /// Why that part cannot have it.
    pub(crate) fn with(&self, part: &str, value: &Value) -> Result<Self, String> {
        let message = |e: toml::de::Error| e.message().to_owned();
        let mut table = Table::try_from(self).map_err(|e| e.to_string())?;
        table.insert(part.to_owned(), value.clone());
        let changed: Self = table.try_into().map_err(message)?;
        changed.check().map_err(|(_, problem)| problem)?;
        Ok(changed)
    }

    /// # Errors
    /// The field that cannot be so, and why.
    pub(crate) fn check(&self) -> Result<(), (&'static str, String)> {
        let wrong = |part, problem: &str| Err((part, problem.to_owned()));
        if !(0.0..1.0).contains(&self.depth) {
            let problem = "must be at least 0, and below 1: a frame's depth is multiplied by 1 less this, or more";
            return wrong("depth", problem);
        }
        for (part, px) in [
            ("tracks_px", self.tracks_px),
            ("poses_px", self.poses_px),
            ("shake_px", self.shake_px),
            ("disc_px", self.disc_px),
        ] {
            if !(0.0..=1e4).contains(&px) {
                return wrong(part, "must be at least 0, and at most 10000");
            }
        }
        Ok(())
    }

    /// What stands for it in a run's name: nothing where nothing is perturbed.
    pub(crate) fn names(&self) -> Vec<String> {
        let amounts = [
            self.depth,
            self.tracks_px,
            f64::from(self.mask_squares),
            self.poses_px,
            self.shake_px,
            self.disc_px,
        ];
        let parts = Self::PARTS.iter().zip(amounts);
        let parts = parts.filter(|(_, amount)| *amount > 0.0);
        parts.map(|(part, x)| format!("{part}={x}")).collect()
    }
}

/// What random numbers are drawn for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Draw<'a> {
    /// The scene's name in the study.
    pub(crate) scene: &'a str,
    /// The run's seed.
    pub(crate) seed: u64,
}

/// Random numbers, the same on every machine.
pub(crate) struct Noise(ChaCha8Rng);

impl Draw<'_> {
    /// The numbers of a part of a frame.
    pub(crate) fn noise(&self, part: &str, frame: &str) -> Noise {
        let seed = self.seed.to_string();
        let key = ["limpid-lab perturb 1", self.scene, &seed, part, frame];
        Noise(ChaCha8Rng::from_seed(hashed(key)))
    }
}

impl Noise {
    /// Between 0 and 1, without 1.
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Between -1 and 1.
    pub(crate) fn either_way(&mut self) -> f64 {
        2.0 * self.unit() - 1.0
    }

    /// A whole number from 0 to `most`.
    fn whole(&mut self, most: u32) -> u32 {
        (self.unit() * (f64::from(most) + 1.0)) as u32
    }
}

/// The value in the middle; none of nothing.
pub(crate) fn median(mut values: Vec<f32>) -> Option<f64> {
    let middle = values.len() / 2;
    let (_, median, _) =
        (!values.is_empty()).then(|| values.select_nth_unstable_by(middle, f32::total_cmp))?;
    Some(f64::from(*median))
}

/// Depths in a frame's disparity; 0 is missing.
pub(crate) fn depths(disparity: &Array) -> Vec<f32> {
    let there = |d: &&f32| **d > 0.0 && d.is_finite();
    disparity
        .values
        .iter()
        .filter(there)
        .map(|d| 1.0 / d)
        .collect()
}

/// Scales and shifts each frame's depth in a folder of disparity ([`Perturb::depth`]).
pub(crate) fn depth(from: &Path, to: &Path, by: f64, draw: Draw<'_>) -> Result<(), LabError> {
    rewrite(from, to, &["npy"], |frame, from, to| {
        let mut disparity = Array::read(from)?;
        let mut noise = draw.noise("depth", frame);
        let scale = 1.0 + by * noise.either_way();
        let shift = 0.5 * by * noise.either_way() * median(depths(&disparity)).unwrap_or(0.0);
        for d in disparity.values.iter_mut().filter(|d| **d > 0.0) {
            let scaled = scale / f64::from(*d);
            *d = (1.0 / (scaled + shift).max(0.5 * scaled)) as f32;
        }
        disparity.write(to)
    })
}

/// Jitters tracks ([`Perturb::tracks_px`]): a folder of arrays [P, 4], or an archive of them.
pub(crate) fn tracks(from: &Path, to: &Path, px: f64, draw: Draw<'_>) -> Result<(), LabError> {
    if from.is_dir() {
        return rewrite(from, to, &["npy"], |pair, from, to| {
            let mut tracks = Array::read(from)?;
            jitter(&mut tracks, px, &mut draw.noise("tracks", pair), from)?;
            tracks.write(to)
        });
    }
    let broken = |e| LabError::content(from, e);
    let bytes = fs::read(from).map_err(LabError::file(from))?;
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(broken)?;
    let mut out = ZipWriter::new(Cursor::new(Vec::new()));
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).map_err(broken)?;
        let name = entry.name().to_owned();
        let mut bytes = Vec::new();
        entry
            .read_to_end(&mut bytes)
            .map_err(LabError::file(from))?;
        if let Some(pair) = name.strip_suffix(".npy") {
            let mut tracks = Array::parse(&bytes, from)?;
            jitter(&mut tracks, px, &mut draw.noise("tracks", pair), from)?;
            bytes = tracks.bytes(to)?;
        }
        out.start_file(name, FileOptions::default())
            .map_err(broken)?;
        out.write_all(&bytes).map_err(LabError::file(to))?;
    }
    let out = out.finish().map_err(broken)?;
    fs::write(to, out.into_inner()).map_err(LabError::file(to))
}

fn jitter(tracks: &mut Array, px: f64, noise: &mut Noise, path: &Path) -> Result<(), LabError> {
    if !tracks.values.is_empty() && tracks.shape.last() != Some(&4) {
        let what = format!("tracks are [P, 4], and this is {:?}", tracks.shape);
        return Err(LabError::content(path, what));
    }
    for track in tracks.values.chunks_exact_mut(4) {
        for coordinate in &mut track[..2] {
            *coordinate = (f64::from(*coordinate) + px * noise.either_way()) as f32;
        }
    }
    Ok(())
}

/// Turns squares of each mask into their opposite ([`Perturb::mask_squares`]).
pub(crate) fn masks(from: &Path, to: &Path, squares: u16, draw: Draw<'_>) -> Result<(), LabError> {
    rewrite(from, to, PICTURES, |frame, from, to| {
        let stored = image::open(from).map_err(|e| LabError::content(from, e))?;
        let mut mask = stored.to_luma8();
        // `limpid` reads such masks by other rules, of which an opposite knows nothing.
        let is_plain = !stored.color().has_alpha()
            && stored.color().bytes_per_pixel() == stored.color().channel_count()
            && stored
                .to_rgb8()
                .pixels()
                .all(|pixel| pixel.0 == [pixel.0[0]; 3]);
        let largest = mask.iter().copied().max().unwrap_or(0);
        if !is_plain || (1..=127).contains(&largest) {
            let what = "squares are changed in masks of 8-bit grey, from 0 to 255, and this is another: leave the scene out with `except`";
            return Err(LabError::content(from, what));
        }
        let (width, height) = mask.dimensions();
        let side = (f64::from(width) * 25.0 / 512.0).round() as u32;
        let side = side.max(1).min(width).min(height);
        let mut noise = draw.noise("masks", frame);
        let before = mask.clone();
        for _ in 0..squares {
            let (left, top) = (noise.whole(width - side), noise.whole(height - side));
            for y in top..top + side {
                for x in left..left + side {
                    // Where two squares overlap, once.
                    mask.get_pixel_mut(x, y).0[0] = u8::MAX - before.get_pixel(x, y).0[0];
                }
            }
        }
        let to = to.with_extension("png");
        mask.save(&to).map_err(|e| LabError::content(&to, e))
    })
}
