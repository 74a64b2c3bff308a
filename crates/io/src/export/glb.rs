//! glTF 2.0 in one binary file, with the extension `KHR_gaussian_splatting`.
//!
//! Specifications: <https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html> (the container is its chapter 4) and
//! `extensions/2.0/Khronos/KHR_gaussian_splatting/README.md` in <https://github.com/KhronosGroup/glTF>.
//!
//! - glTF has y up, x left and z forward: positions, rotations and spherical harmonics are turned half a turn about z in the data,
//!   because not every reader turns spherical harmonics with a node.
//! - Scales and opacities are what they are, not logarithms and logits; rotations are unit quaternions (x, y, z, w).
//! - Colours are those of the pictures that were trained on: `srgb_rec709_display`.
//! - `COLOR_0`, linear as in the base format, shows points to readers that do not know the extension.
//! - What moves is a node with an animation of its translation and rotation. Readers that follow the extension turn its
//!   view-dependent colours with it; ours stay with the world.

use std::path::Path;

use serde_json::{Value, json};
use splat_core::Gaussians;

use super::gaussians::{GLTF, check, opacity, turned, turned_point, turned_quat, unit_quat};
use crate::{IoError, write_atomic};

/// A degree-0 coefficient's share of the colour.
const SH_C0: f32 = 0.282_094_8;
/// Component types of glTF.
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
/// The buffer holds vertices.
const ARRAY_BUFFER: u32 = 34962;

/// What a file holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Glb {
    /// Gaussians, each part as a node.
    pub parts: Vec<GlbPart>,
    /// When moving parts are where, in seconds: from 0 or later, and always later. Empty where none moves.
    pub seconds: Vec<f32>,
}

/// Gaussians that stand still, or that move as one.
#[derive(Clone, Debug, PartialEq)]
pub struct GlbPart {
    /// The node's name.
    pub name: String,
    /// In the world, or in the part's own frame where it moves; axes of PLY (y down).
    pub gaussians: Gaussians,
    /// How it moves.
    pub motion: Option<RigidMotion>,
}

/// A rigid motion: a pose at each of the file's times, world from part, axes of PLY (y down).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigidMotion {
    /// Unit quaternions (w, x, y, z), `[T]`.
    pub rotations: Vec<[f32; 4]>,
    /// Scene units, `[T]`.
    pub translations: Vec<[f32; 3]>,
}

/// Writes a scene as binary glTF with `KHR_gaussian_splatting`, atomically.
///
/// Parts without Gaussians are left out. Scales that overflow are the largest f32.
///
/// # Errors
/// [`IoError::Invalid`]: arrays that do not fit each other, no Gaussian at all (glTF has no empty meshes), times that do not
/// increase, over 4 GiB; [`IoError::NotANumber`]; [`IoError::Access`].
pub fn write_glb(path: &Path, glb: &Glb) -> Result<(), IoError> {
    check_times(glb, path)?;
    let mut file = File::default();
    let (mut nodes, mut meshes, mut channels, mut samplers) = (vec![], vec![], vec![], vec![]);
    let moves = glb.parts.iter().any(|part| part.motion.is_some());
    let input = moves.then(|| file.times(&glb.seconds));
    for part in &glb.parts {
        check(&part.gaussians, path)?;
        if part.gaussians.is_empty() {
            continue;
        }
        let mut node = json!({ "name": part.name, "mesh": meshes.len() });
        meshes.push(json!({ "name": part.name, "primitives": [file.primitive(&part.gaussians)] }));
        if let (Some(motion), Some(input)) = (&part.motion, input) {
            let (rotations, translations) = turned_motion(motion);
            // Where readers that play no animation leave it.
            node["rotation"] = json!(rotations[0]);
            node["translation"] = json!(translations[0]);
            let outputs = [
                ("rotation", file.add("VEC4", rotations.as_flattened())),
                ("translation", file.add("VEC3", translations.as_flattened())),
            ];
            for (what, output) in outputs {
                let target = json!({ "node": nodes.len(), "path": what });
                channels.push(json!({ "sampler": samplers.len(), "target": target }));
                samplers.push(json!({ "input": input, "output": output }));
            }
        }
        nodes.push(node);
    }
    if nodes.is_empty() {
        let what = "there is no Gaussian to write, and glTF has no empty meshes";
        return Err(IoError::invalid(path, what));
    }
    let mut document = json!({
        "asset": { "version": "2.0", "generator": concat!("Limpid ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<_>>() }],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{ "byteLength": file.bytes.len() }],
    });
    if !channels.is_empty() {
        document["animations"] =
            json!([{ "name": "motion", "channels": channels, "samplers": samplers }]);
    }
    write_container(path, &document, &file.bytes)
}

fn check_times(glb: &Glb, path: &Path) -> Result<(), IoError> {
    let Glb { parts, seconds } = glb;
    let increase = seconds.windows(2).all(|pair| pair[0] < pair[1]);
    let start = seconds.first().is_none_or(|first| *first >= 0.0);
    if !increase || !start || !seconds.iter().all(|s| s.is_finite()) {
        let what =
            "the times of an animation are seconds from 0 on, each later than the one before";
        return Err(IoError::invalid(path, what));
    }
    for part in parts {
        let Some(motion) = &part.motion else { continue };
        let lengths = [motion.rotations.len(), motion.translations.len()];
        if seconds.is_empty() || lengths != [seconds.len(); 2] {
            let what = format!(
                "{} has {} rotations and {} translations for {} times",
                part.name,
                lengths[0],
                lengths[1],
                seconds.len()
            );
            return Err(IoError::invalid(path, what));
        }
        let rotations = motion.rotations.as_flattened().iter();
        let mut numbers = rotations.chain(motion.translations.as_flattened());
        if !numbers.all(|v| v.is_finite()) {
            let what = format!("a pose of {}", part.name);
            return Err(IoError::not_a_number(path, what, "leave the part out"));
        }
    }
    Ok(())
}

/// Rotations (x, y, z, w) and translations in glTF's axes. Of the two quaternions of a rotation, the one nearer to the one before.
fn turned_motion(motion: &RigidMotion) -> (Vec<[f32; 4]>, Vec<[f32; 3]>) {
    let mut rotations: Vec<[f32; 4]> = Vec::with_capacity(motion.rotations.len());
    for quat in &motion.rotations {
        let [w, x, y, z] = turned_quat(unit_quat(*quat), GLTF);
        let turned = [x, y, z, w];
        let before = rotations.last().unwrap_or(&turned);
        let cosine: f32 = turned.iter().zip(before).map(|(a, b)| a * b).sum();
        rotations.push(turned.map(|v| if cosine < 0.0 { -v } else { v }));
    }
    let translations = motion.translations.iter();
    (
        rotations,
        translations.map(|t| turned_point(*t, GLTF)).collect(),
    )
}

/// The binary chunk, and what the JSON says of it.
#[derive(Default)]
struct File {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl File {
    /// A piece of the buffer, and the accessor that sees all of it: their number.
    fn view(&mut self, bytes: &[u8], target: Option<u32>, accessor: Value) -> usize {
        let mut view =
            json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        let mut accessor = accessor;
        accessor["bufferView"] = json!(self.views.len());
        self.views.push(view);
        self.bytes.extend(bytes);
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats(&mut self, kind: &str, values: &[f32], target: Option<u32>) -> usize {
        let width = match kind {
            "VEC4" => 4,
            "VEC3" => 3,
            _ => 1,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let count = values.len() / width;
        let accessor = json!({ "componentType": FLOAT, "count": count, "type": kind });
        self.view(&bytes, target, accessor)
    }

    /// An animation's values.
    fn add(&mut self, kind: &str, values: &[f32]) -> usize {
        self.floats(kind, values, None)
    }

    /// An animation's times, whose range must be told.
    fn times(&mut self, seconds: &[f32]) -> usize {
        let at = self.add("SCALAR", seconds);
        self.accessors[at]["min"] = json!([f64::from(seconds[0])]);
        self.accessors[at]["max"] = json!([f64::from(seconds[seconds.len() - 1])]);
        at
    }

    /// A primitive of Gaussians, of which there is one or more.
    fn primitive(&mut self, gaussians: &Gaussians) -> Value {
        let turned = turned(gaussians, GLTF);
        let n = turned.len();
        let target = Some(ARRAY_BUFFER);
        let position = self.floats("VEC3", turned.means.as_flattened(), target);
        let mut range = [turned.means[0]; 2];
        for mean in &turned.means {
            for c in 0..3 {
                range[0][c] = range[0][c].min(mean[c]);
                range[1][c] = range[1][c].max(mean[c]);
            }
        }
        self.accessors[position]["min"] = json!(range[0].map(f64::from));
        self.accessors[position]["max"] = json!(range[1].map(f64::from));

        let rotations: Vec<[f32; 4]> = turned
            .quats
            .iter()
            .map(|quat| {
                let [w, x, y, z] = unit_quat(*quat);
                [x, y, z, w]
            })
            .collect();
        let scales: Vec<f32> = turned
            .log_scales
            .as_flattened()
            .iter()
            .map(|s| s.exp().min(f32::MAX))
            .collect();
        let opacities: Vec<f32> = turned.opacity_logits.iter().map(|o| opacity(*o)).collect();
        let num_sh = (turned.sh_degree + 1).pow(2);
        let mut colors = Vec::with_capacity(4 * n);
        for (sh, opacity) in turned.sh.chunks_exact(3 * num_sh).zip(&opacities) {
            let channels = [0, 1, 2].map(|c| linear(SH_C0 * sh[c] + 0.5));
            colors.extend(channels.map(to_u8));
            colors.push(to_u8(*opacity));
        }
        let accessor = json!({ "componentType": UNSIGNED_BYTE, "normalized": true, "count": n, "type": "VEC4" });
        let mut attributes = json!({
            "POSITION": position,
            "COLOR_0": self.view(&colors, target, accessor),
            "KHR_gaussian_splatting:ROTATION": self.floats("VEC4", rotations.as_flattened(), target),
            "KHR_gaussian_splatting:SCALE": self.floats("VEC3", &scales, target),
            "KHR_gaussian_splatting:OPACITY": self.floats("SCALAR", &opacities, target),
        });
        for degree in 0..=turned.sh_degree {
            for order in 0..=2 * degree {
                let k = degree * degree + order;
                let values: Vec<f32> = turned
                    .sh
                    .chunks_exact(3 * num_sh)
                    .flat_map(|sh| [sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]])
                    .collect();
                let name = format!("KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{order}");
                attributes[name] = json!(self.floats("VEC3", &values, target));
            }
        }
        json!({
            "mode": 0,
            "attributes": attributes,
            "extensions": { "KHR_gaussian_splatting": {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            } },
        })
    }
}

/// Of sRGB, clamped to [0, 1].
fn linear(srgb: f32) -> f32 {
    let v = srgb.clamp(0.0, 1.0);
    if v <= 0.04045 {
        v / 12.92
    } else {
        ((v + 0.055) / 1.055).powf(2.4)
    }
}

fn to_u8(value: f32) -> u8 {
    (value * 255.0).round() as u8
}

/// Header, JSON and binary chunk, each a multiple of four bytes long.
fn write_container(path: &Path, document: &Value, bytes: &[u8]) -> Result<(), IoError> {
    let mut text = serde_json::to_vec(document)
        .map_err(|e| IoError::invalid(path, format!("cannot be written as JSON: {e}")))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    // Every piece is a multiple of four long.
    let total = 12 + 8 + text.len() + 8 + bytes.len();
    let length = |value: usize| {
        let what = "over 4 GiB, which glTF's one file cannot hold; leave out spherical harmonics";
        u32::try_from(value).map_err(|_| IoError::invalid(path, what))
    };
    let (total, of_text, of_bytes) = (length(total)?, length(text.len())?, length(bytes.len())?);
    write_atomic(path, |out| {
        out.write_all(b"glTF")?;
        out.write_all(&2_u32.to_le_bytes())?;
        out.write_all(&total.to_le_bytes())?;
        for (of, kind, content) in [(of_text, b"JSON", &text[..]), (of_bytes, b"BIN\0", bytes)] {
            out.write_all(&of.to_le_bytes())?;
            out.write_all(kind)?;
            out.write_all(content)?;
        }
        Ok(())
    })
}
