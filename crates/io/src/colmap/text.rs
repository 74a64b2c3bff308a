//! `cameras.txt`, `images.txt`, `points3D.txt`: one record a line, `#` starts a comment line.

use std::collections::BTreeMap;
use std::path::Path;
use std::str::FromStr;

use super::model::{ModelImage, cam_from_world, lens, point};
use crate::bytes::read_file;
use crate::camera_model::Lens;
use crate::{IoError, SparsePoint};

/// The fields of one line, with its number for messages.
struct Line<'a> {
    fields: std::str::SplitWhitespace<'a>,
    number: usize,
    path: &'a Path,
}

impl Line<'_> {
    fn next<T: FromStr>(&mut self, what: &str) -> Result<T, IoError> {
        let field = self.fields.next();
        field.and_then(|f| f.parse().ok()).ok_or_else(|| {
            let found = field.map_or("the line ends".into(), |f| format!("found '{f}'"));
            IoError::malformed(
                self.path,
                format!("line {}: expected {what}, {found}", self.number),
            )
        })
    }

    fn numbers<const N: usize>(&mut self, what: &str) -> Result<[f64; N], IoError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.next(what)?;
        }
        Ok(numbers)
    }
}

fn read_text(path: &Path) -> Result<String, IoError> {
    String::from_utf8(read_file(path)?).map_err(|_| IoError::malformed(path, "not UTF-8 text"))
}

/// Lines that are no comments, empty ones too.
fn lines<'a>(text: &'a str, path: &'a Path) -> impl Iterator<Item = (&'a str, Line<'a>)> {
    text.lines()
        .enumerate()
        .filter(|(_, line)| !line.trim_start().starts_with('#'))
        .map(move |(index, line)| {
            let fields = line.split_whitespace();
            (
                line,
                Line {
                    fields,
                    number: index + 1,
                    path,
                },
            )
        })
}

fn is_blank((text, _): &(&str, Line<'_>)) -> bool {
    text.trim().is_empty()
}

pub(super) fn read_cameras(path: &Path) -> Result<BTreeMap<u32, Lens>, IoError> {
    let text = read_text(path)?;
    let mut cameras = BTreeMap::new();
    for (_, mut line) in lines(&text, path).filter(|l| !is_blank(l)) {
        let id = line.next("a camera's number")?;
        let model: String = line.next("a camera model")?;
        let size = (line.next("a width")?, line.next("a height")?);
        let mut params = Vec::new();
        while line.fields.clone().next().is_some() {
            params.push(line.next("a camera's parameter")?);
        }
        cameras.insert(id, lens(&model, size, &params, path)?);
    }
    Ok(cameras)
}

pub(super) fn read_images(path: &Path) -> Result<Vec<ModelImage>, IoError> {
    let text = read_text(path)?;
    let mut images = Vec::new();
    let mut all = lines(&text, path);
    // Two lines an image; the second, with its 2D points, may be empty and is not used.
    while let Some((_, mut line)) = all.find(|l| !is_blank(l)) {
        line.next::<u32>("an image's number")?;
        let quat = line.numbers("a quaternion")?;
        let translation = line.numbers("a translation")?;
        let camera_id = line.next("a camera's number")?;
        let mut name: String = line.next("an image's name")?;
        for more in line.fields.by_ref() {
            name.push(' ');
            name.push_str(more);
        }
        let number = line.number;
        if all.next().is_none() && !text.ends_with('\n') {
            return Err(IoError::truncated(
                path,
                format!("line {number}: the image's line of 2D points is missing"),
            ));
        }
        images.push(ModelImage {
            cam_from_world: cam_from_world(quat, translation, &name, path)?,
            name,
            camera_id,
        });
    }
    Ok(images)
}

pub(super) fn read_points(path: &Path) -> Result<Vec<SparsePoint>, IoError> {
    let text = read_text(path)?;
    let mut points = Vec::new();
    for (_, mut line) in lines(&text, path).filter(|l| !is_blank(l)) {
        line.next::<u64>("a point's number")?;
        let position = line.numbers("a point's position")?;
        let rgb = [line.next("red")?, line.next("green")?, line.next("blue")?];
        line.next::<f64>("a point's error")?;
        points.push(point(position, rgb, path)?);
    }
    Ok(points)
}
