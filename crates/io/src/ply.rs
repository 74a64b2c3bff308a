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
    gaussians
        .check()
        .map_err(|error| IoError::invalid(path, error.to_string()))?;
    let (n, num_sh) = (means.len(), (sh_degree + 1) * (sh_degree + 1));
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

/// Writes points as binary little-endian PLY, atomically: x, y, z and 8-bit red, green, blue, as nerfstudio reads them.
///
/// # Errors
/// [`IoError::NotANumber`], [`IoError::Access`].
pub fn write_points_ply(path: &Path, points: &[SparsePoint]) -> Result<(), IoError> {
    if let Some(at) = points.iter().position(|p| !p.position.is_finite()) {
        return Err(IoError::not_a_number(
            path,
            format!("point {at}"),
            "leave it out",
        ));
    }
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n",
        points.len()
    );
    for axis in ["x", "y", "z"] {
        header.push_str(&format!("property float {axis}\n"));
    }
    for channel in ["red", "green", "blue"] {
        header.push_str(&format!("property uchar {channel}\n"));
    }
    header.push_str("end_header\n");
    write_atomic(path, |out| {
        out.write_all(header.as_bytes())?;
        for point in points {
            for v in point.position.as_vec3().to_array() {
                out.write_all(&v.to_le_bytes())?;
            }
            out.write_all(&point.color_bytes())?;
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
                "leave the vertex out",
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
            let (what, advice) = (format!("vertex {i}"), "leave the vertex out");
            return Err(IoError::not_a_number(path, what, advice));
        }
        let color = colors.map(|c| c.map_or(0.5, |values| (values[i] / 255.0) as f32));
        if !color.iter().all(|c| (0.0..=1.0).contains(c)) {
            let what = format!("the colour of vertex {i} is not from 0 to 255");
            return Err(IoError::malformed(path, what));
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussians(sh_degree: usize, n: usize) -> Gaussians {
        let num_sh = (sh_degree + 1) * (sh_degree + 1);
        let mut next = 0.0;
        let mut number = || {
            next += 0.25;
            next
        };
        Gaussians {
            means: (0..n).map(|_| [number(), number(), number()]).collect(),
            quats: (0..n)
                .map(|_| [number(), number(), number(), number()])
                .collect(),
            log_scales: (0..n).map(|_| [number(), number(), number()]).collect(),
            opacity_logits: (0..n).map(|_| number()).collect(),
            sh: (0..n * num_sh * 3).map(|_| number()).collect(),
            sh_degree,
        }
    }

    #[test]
    fn round_trip_at_every_degree() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ply");
        for (degree, n) in [(0, 3), (1, 1), (2, 2), (3, 5), (3, 0)] {
            let written = gaussians(degree, n);
            write_ply(&path, &written).unwrap();
            assert_eq!(read_ply(&path).unwrap(), written, "degree {degree}");
        }
    }

    #[test]
    fn layout_by_hand() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ply");
        let mut one = gaussians(1, 1);
        // Coefficient k of channel c is 10 k + c.
        one.sh = (0..4)
            .flat_map(|k| [0, 1, 2].map(|c| (10 * k + c) as f32))
            .collect();
        write_ply(&path, &one).unwrap();
        let data = std::fs::read(&path).unwrap();
        let end = b"end_header\n";
        let start = data.windows(end.len()).position(|w| w == end).unwrap() + end.len();
        let header = std::str::from_utf8(&data[..start]).unwrap();
        assert!(
            header.contains("property float f_rest_8\nproperty float opacity\n"),
            "{header}"
        );
        let row: Vec<f32> = data[start..]
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
            .collect();
        assert_eq!(row.len(), 6 + 3 + 9 + 1 + 3 + 4);
        assert_eq!(row[..3], one.means[0]);
        assert_eq!(row[6..9], [0.0, 1.0, 2.0]);
        // All of red first.
        assert_eq!(
            row[9..18],
            [10.0, 20.0, 30.0, 11.0, 21.0, 31.0, 12.0, 22.0, 32.0]
        );
        assert_eq!(row[18], one.opacity_logits[0]);
        assert_eq!(row[22..], one.quats[0]);
    }

    #[test]
    fn broken_files_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.ply");
        write_ply(&path, &gaussians(3, 4)).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let check = |data: &[u8], why: &str| {
            std::fs::write(&path, data).unwrap();
            let text = read_ply(&path).expect_err(why).to_string();
            assert!(text.ends_with("scene.ply"), "{why}: {text}");
        };
        for length in (0..whole.len()).step_by(37).chain([whole.len() - 1]) {
            check(&whole[..length], &format!("cut at {length}"));
        }
        let replace = |from: &str, to: &str| {
            let at = whole
                .windows(from.len())
                .position(|w| w == from.as_bytes())
                .unwrap();
            [&whole[..at], to.as_bytes(), &whole[at + from.len()..]].concat()
        };
        for count in [
            "1099511627776",
            "18446744073709551615",
            "99999999999999999999",
            "-1",
        ] {
            check(&replace("vertex 4", &format!("vertex {count}")), count);
        }
        check(
            &replace("element vertex", "element corner"),
            "another element",
        );
        check(&replace("property float opacity\n", ""), "no opacity");
        check(
            &replace("float f_rest_44", "float of_rest_4"),
            "44 coefficients",
        );
        check(&replace("float x", "list uchar float x"), "a list");
        let mut nan = whole.clone();
        let end = nan.len();
        nan[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
        check(&nan, "not a number");
        check(
            b"ply\nformat ascii 1.0\nelement vertex 9000000000000000000\nend_header\n",
            "no properties",
        );

        let mut uneven = gaussians(1, 2);
        uneven.quats.pop();
        assert!(matches!(
            write_ply(&path, &uneven),
            Err(IoError::Invalid { .. })
        ));
    }
}
