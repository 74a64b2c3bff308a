//! PLY: Gaussians with the property names of 3DGS, and coloured points.

use std::path::Path;

use glam::DVec3;
use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_ply::{PlyFormat, PlyReader, PropertyType, ScalarType};
use splat_core::Gaussians;

use crate::bytes::read_file;
use crate::{IoError, SparsePoint, write_atomic};

/// Writes Gaussians as binary little-endian PLY with the names that 3DGS gave them, atomically:
/// x y z, nx ny nz (0), `f_dc_*`, `f_rest_*` (channel-major), opacity (logit), `scale_*` (logarithm),
/// `rot_*` (w, x, y, z).
///
/// The header is our own: viewers that know only the old type name `float` are common, and the PLY
/// writers at hand write `float32`.
///
/// # Errors
/// [`IoError::Invalid`] when the arrays' lengths disagree; [`IoError::Access`].
pub fn write_ply(path: &Path, gaussians: &Gaussians) -> Result<(), IoError> {
    let Gaussians {
        means,
        quats,
        log_scales,
        opacity_logits,
        sh,
        sh_degree,
    } = gaussians;
    let (n, num_sh) = (means.len(), (sh_degree + 1) * (sh_degree + 1));
    let lengths = [quats.len(), log_scales.len(), opacity_logits.len()];
    if *sh_degree > 3 || lengths != [n; 3] || sh.len() != n * num_sh * 3 {
        return Err(IoError::invalid(
            path,
            format!(
                "{n} means with {lengths:?} quaternions, scales, opacities and {} SH numbers of \
                 degree {sh_degree} are no Gaussians",
                sh.len()
            ),
        ));
    }
    let names = property_names(*sh_degree);
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {n}\n");
    for name in &names {
        header.push_str(&format!("property float {name}\n"));
    }
    header.push_str("end_header\n");
    write_atomic(path, |out| {
        out.write_all(header.as_bytes())?;
        let mut row: Vec<f32> = Vec::with_capacity(names.len());
        for i in 0..n {
            let sh = &sh[i * num_sh * 3..(i + 1) * num_sh * 3];
            row.clear();
            row.extend(means[i]);
            row.extend([0.0; 3]);
            row.extend(&sh[..3]);
            for channel in 0..3 {
                row.extend((1..num_sh).map(|k| sh[k * 3 + channel]));
            }
            row.push(opacity_logits[i]);
            row.extend(log_scales[i]);
            row.extend(quats[i]);
            for value in &row {
                out.write_all(&value.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

/// The 3DGS property names, in the order that its own writer has.
fn property_names(sh_degree: usize) -> Vec<String> {
    let num_rest = 3 * ((sh_degree + 1) * (sh_degree + 1) - 1);
    let plain = |names: &[&str]| names.iter().map(|n| (*n).to_string()).collect::<Vec<_>>();
    let counted =
        |name: &str, count: usize| (0..count).map(move |i| format!("{name}_{i}")).collect();
    let parts: [Vec<String>; 6] = [
        plain(&["x", "y", "z", "nx", "ny", "nz"]),
        counted("f_dc", 3),
        counted("f_rest", num_rest),
        plain(&["opacity"]),
        counted("scale", 3),
        counted("rot", 4),
    ];
    parts.concat()
}

/// Reads a 3DGS PLY, ASCII or binary, of SH degree 0 to 3; other properties are ignored.
///
/// # Errors
/// [`IoError::Truncated`], [`IoError::Malformed`] (also a property that is missing),
/// [`IoError::NotANumber`], [`IoError::Access`].
pub fn read_ply(path: &Path) -> Result<Gaussians, IoError> {
    let columns = Columns::<f32>::read(path)?;
    let num_rest = columns
        .names
        .iter()
        .filter(|n| n.starts_with("f_rest_"))
        .count();
    let Some(sh_degree) = (0..=3).find(|d| 3 * ((d + 1) * (d + 1) - 1) == num_rest) else {
        return Err(IoError::malformed(
            path,
            format!("{num_rest} f_rest properties are no SH degree from 0 to 3"),
        ));
    };
    let wanted: Vec<_> = property_names(sh_degree)
        .into_iter()
        .filter(|n| !n.starts_with('n'))
        .collect();
    let mut found = Vec::with_capacity(wanted.len());
    for name in &wanted {
        let values = columns.get(name)?;
        if let Some(row) = values.iter().position(|v| !v.is_finite()) {
            return Err(IoError::not_a_number(
                path,
                format!("{name} of vertex {row}"),
            ));
        }
        found.push(values);
    }
    let (n, num_sh) = (found[0].len(), (sh_degree + 1) * (sh_degree + 1));
    let (opacity, scale, rot) = (6 + num_rest, 7 + num_rest, 10 + num_rest);
    let mut gaussians = Gaussians {
        sh_degree,
        ..Gaussians::default()
    };
    for i in 0..n {
        gaussians.means.push([0, 1, 2].map(|c| found[c][i]));
        gaussians.sh.extend([3, 4, 5].map(|c| found[c][i]));
        for k in 1..num_sh {
            // Channel-major in the file.
            let rest = [0, 1, 2].map(|c| found[6 + c * (num_sh - 1) + k - 1][i]);
            gaussians.sh.extend(rest);
        }
        gaussians.opacity_logits.push(found[opacity][i]);
        gaussians
            .log_scales
            .push([0, 1, 2].map(|c| found[scale + c][i]));
        gaussians
            .quats
            .push([0, 1, 2, 3].map(|c| found[rot + c][i]));
    }
    Ok(gaussians)
}

/// Reads a point cloud: x, y, z and, where they are there, 8-bit red, green, blue (else grey).
pub(crate) fn read_points(path: &Path) -> Result<Vec<SparsePoint>, IoError> {
    let columns = Columns::<f64>::read(path)?;
    let (x, y, z) = (columns.get("x")?, columns.get("y")?, columns.get("z")?);
    let colors = ["red", "green", "blue"].map(|name| columns.get(name).ok());
    let mut points = Vec::with_capacity(x.len());
    for i in 0..x.len() {
        let position = DVec3::new(x[i], y[i], z[i]);
        if !position.is_finite() {
            return Err(IoError::not_a_number(path, format!("vertex {i}")));
        }
        let color = colors.map(|c| c.map_or(0.5, |values| (values[i] / 255.0) as f32));
        points.push(SparsePoint { position, color });
    }
    Ok(points)
}

/// The vertices' properties, one vector each.
struct Columns<'a, T> {
    names: Vec<String>,
    values: Vec<Vec<T>>,
    path: &'a Path,
}

impl<'a, T: for<'de> Deserialize<'de>> Columns<'a, T> {
    fn read(path: &'a Path) -> Result<Self, IoError> {
        let data = read_file(path)?;
        let mut reader = PlyReader::from_reader(data.as_slice())
            .map_err(|e| IoError::malformed(path, format!("not a PLY file: {e}")))?;
        let format = reader.header().format;
        let Some(vertex) = reader.current_element().filter(|e| e.name == "vertex") else {
            return Err(IoError::malformed(path, "the first element is not vertex"));
        };
        let (mut names, mut row_bytes) = (Vec::new(), 0);
        for property in &vertex.properties {
            let PropertyType::Scalar(kind) = property.property_type else {
                let what = format!("vertex property {} is a list", property.name);
                return Err(IoError::malformed(path, what));
            };
            names.push(property.name.clone());
            row_bytes += match (format, kind) {
                // A digit and a separator.
                (PlyFormat::Ascii, _) | (_, ScalarType::I16 | ScalarType::U16) => 2,
                (_, ScalarType::I8 | ScalarType::U8) => 1,
                (_, ScalarType::I32 | ScalarType::U32 | ScalarType::F32) => 4,
                (_, ScalarType::F64) => 8,
            };
        }
        let needed = vertex.count.checked_mul(row_bytes);
        if names.is_empty() || needed.is_none_or(|needed| needed > data.len()) {
            return Err(IoError::truncated(
                path,
                format!("promises {} vertices in {} bytes", vertex.count, data.len()),
            ));
        }
        let (count, num_columns) = (vertex.count, names.len());
        let rows: Rows<T> = reader.next_element().map_err(|e| match e.0.kind() {
            std::io::ErrorKind::UnexpectedEof => {
                IoError::truncated(path, format!("promises {count} vertices"))
            }
            _ => IoError::malformed(path, format!("broken vertex: {e}")),
        })?;
        let mut values: Vec<Vec<T>> = (0..num_columns).map(|_| Vec::new()).collect();
        for (at, value) in rows.0.into_iter().enumerate() {
            values[at % num_columns].push(value);
        }
        Ok(Self {
            names,
            values,
            path,
        })
    }
}

impl<T> Columns<'_, T> {
    fn get(&self, name: &str) -> Result<&[T], IoError> {
        match self.names.iter().position(|n| n == name) {
            Some(at) => Ok(&self.values[at]),
            None => Err(IoError::malformed(
                self.path,
                format!("the vertices have no property {name}"),
            )),
        }
    }
}

/// All values of all rows, row by row. It grows with what is really there.
struct Rows<T>(Vec<T>);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for Rows<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(RowsVisitor(Vec::new()))
    }
}

struct RowsVisitor<T>(Vec<T>);

impl<'de, T: Deserialize<'de>> Visitor<'de> for RowsVisitor<T> {
    type Value = Rows<T>;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("vertices of numbers")
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut rows: A) -> Result<Rows<T>, A::Error> {
        while rows.next_element_seed(RowSeed(&mut self.0))?.is_some() {}
        Ok(Rows(self.0))
    }
}

/// Appends one row's values.
struct RowSeed<'a, T>(&'a mut Vec<T>);

impl<'de, T: Deserialize<'de>> serde::de::DeserializeSeed<'de> for RowSeed<'_, T> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de, T: Deserialize<'de>> Visitor<'de> for RowSeed<'_, T> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a vertex of numbers")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut row: A) -> Result<(), A::Error> {
        // Properties come in the header's order, so their names need not be looked at again.
        while row.next_key::<IgnoredAny>()?.is_some() {
            self.0.push(row.next_value()?);
        }
        Ok(())
    }
}
