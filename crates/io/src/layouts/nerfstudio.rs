//! nerfstudio's `transforms.json` (<https://docs.nerf.studio/quickstart/data_conventions.html>).
//!
//! - Poses are camera-to-world with OpenGL axes (x right, y up, z back); they become OpenCV's.
//! - Intrinsics stand at the top or on a frame, where they win.
//! - `depth_file_path`: a 16-bit PNG or an array, in units of `depth_unit_scale_factor` (0.001).
//! - `mask_path`: in this format black pixels are to be left out. What has to be left out of a static
//!   reconstruction is what moves, so **black is dynamic** and everything else is static.
//! - The split is `split` on each frame, or `train_filenames` and `test_filenames`.
//! - The format has no tracks; those of the other layout are read where they are there, under the
//!   frames' file stems.
//! - Training frames are ordered by `time`, without it by file name. A training frame's time is its
//!   index. A test view's is interpolated between the training frames' `time`; without it, a test view
//!   has the time of the training frame of the same file name, else it lies half-way between its
//!   neighbours in the order of names.

mod transforms;

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::path::Path;

use transforms::{Entry, Transforms};

use crate::error::list_names;
use crate::folder::{natural_order, stem_of};
use crate::plan::{DepthFile, Layout, MaskFile, Plan, PlannedFrame, time_between};
use crate::ply::read_points;
use crate::scene::TruthFolders;
use crate::tracks::TrackFiles;
use crate::{IoError, LoadOptions};

pub(super) const LAYOUT: Layout = Layout {
    name: "nerfstudio",
    looks_for: &["transforms.json"],
    plan,
};

fn plan(root: &Path, options: &LoadOptions) -> Result<Plan, IoError> {
    let transforms = Transforms::read(root.join("transforms.json"))?;
    let path = &transforms.path;
    let scale = transforms.depth_unit_scale_factor.unwrap_or(1e-3);
    if !scale.is_finite() || scale <= 0.0 {
        let what = format!("depth_unit_scale_factor is {scale}");
        return Err(IoError::malformed(path, what));
    }

    let mut notes = Vec::new();
    let (mut training, mut test) = split(&transforms, &mut notes)?;
    let by_name = |a: &&Entry, b: &&Entry| natural_order(&a.file_path, &b.file_path);
    training.sort_by(by_name);
    test.sort_by(by_name);
    let test_times = order_by_time(&mut training, &test, path)?;
    if training.iter().any(|e| e.mask_path.is_some()) && !options.static_scene {
        notes.push("mask_path, as in nerfstudio: black pixels are what moves".into());
    }

    let mut frames = Vec::with_capacity(training.len());
    for (i, (entry, name)) in training.iter().zip(names(&training, path)?).enumerate() {
        let depth = entry.depth_file_path.as_ref().map(|file| root.join(file));
        frames.push(PlannedFrame {
            view: transforms.view(root, entry, name, i as f32)?,
            depth: depth.map(|path| DepthFile::Depth { path, scale }),
            mask: entry
                .mask_path
                .as_ref()
                .map(|file| MaskFile::File(root.join(file))),
        });
    }
    let mut views = Vec::with_capacity(test.len());
    for ((entry, name), time) in test.iter().zip(names(&test, path)?).zip(test_times) {
        views.push(transforms.view(root, entry, name, time)?);
    }
    let points = match &transforms.ply_file_path {
        Some(file) => read_points(&root.join(file))?,
        None => Vec::new(),
    };
    Ok(Plan {
        truth: TruthFolders::of(root),
        frames,
        test: views,
        points,
        depth_at: path.clone(),
        masks_at: path.clone(),
        inverted_masks: true,
        tracks: TrackFiles::new(&root.join("flow3d_preprocessed")),
        notes,
    })
}

/// File stems; whole paths where a stem is there twice.
fn names(entries: &[&Entry], path: &Path) -> Result<Vec<String>, IoError> {
    let are_unique = |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let stems: Vec<_> = entries
        .iter()
        .map(|e| stem_of(&e.file_path).to_string())
        .collect();
    if are_unique(&stems) {
        return Ok(stems);
    }
    let whole = |e: &&Entry| {
        let path = e.file_path.trim_start_matches("./");
        let without = path.rsplit_once('.').map_or(path, |(front, _)| front);
        without.replace(['/', '\\'], "_")
    };
    let names: Vec<_> = entries.iter().map(whole).collect();
    if !are_unique(&names) {
        let what = "two frames have the same file_path but for its ending or its separators";
        return Err(IoError::names(path, what));
    }
    Ok(names)
}

/// Training frames and test views.
fn split<'a>(
    transforms: &'a Transforms,
    notes: &mut Vec<String>,
) -> Result<(Vec<&'a Entry>, Vec<&'a Entry>), IoError> {
    let (entries, path) = (&transforms.frames, &transforms.path);
    let known: BTreeSet<_> = entries.iter().map(|e| e.file_path.as_str()).collect();
    if known.len() != entries.len() {
        let what = "two frames have the same file_path";
        return Err(IoError::malformed(path, what));
    }
    let (to_train, to_test) = (&transforms.train_filenames, &transforms.test_filenames);
    let listed = |list: &Option<Vec<String>>| -> Result<BTreeSet<String>, IoError> {
        let names: BTreeSet<_> = list.iter().flatten().cloned().collect();
        match names.iter().find(|n| !known.contains(n.as_str())) {
            Some(name) => Err(IoError::names(
                path,
                format!("{name} is in train_filenames or test_filenames, and no frame has it"),
            )),
            None => Ok(names),
        }
    };
    let (in_train, in_test) = (listed(to_train)?, listed(to_test)?);
    if let Some(both) = in_train.intersection(&in_test).next() {
        let what = format!("{both} is in train_filenames and in test_filenames");
        return Err(IoError::names(path, what));
    }

    let (mut training, mut test, mut skipped) = (Vec::new(), Vec::new(), 0);
    for entry in entries {
        let name = &entry.file_path;
        let by_list = match (in_train.contains(name), in_test.contains(name)) {
            (true, _) => Some("train"),
            (_, true) => Some("test"),
            // With one list, the rest is the other part; with two, it is neither.
            _ if to_train.is_some() && to_test.is_some() => Some("neither"),
            _ if to_train.is_some() => Some("test"),
            _ if to_test.is_some() => Some("train"),
            _ => None,
        };
        let by_frame = entry.split.as_deref();
        if let (Some(a), Some(b)) = (by_frame, by_list)
            && a != b
        {
            let what = format!("{name} has split {a}, and by the lists of files it is {b}");
            return Err(IoError::names(path, what));
        }
        match by_frame.or(by_list).unwrap_or("train") {
            "train" => training.push(entry),
            "test" => test.push(entry),
            "val" | "neither" => skipped += 1,
            other => {
                let what = format!("{name} has split {other}; train, test or val is expected");
                return Err(IoError::malformed(path, what));
            }
        }
    }
    if skipped > 0 {
        notes.push(format!(
            "{skipped} frames are neither for training nor for testing: skipped"
        ));
    }
    if training.is_empty() {
        let advice = "give some frames the split train";
        return Err(IoError::missing(path, "training frames", advice));
    }
    Ok((training, test))
}

/// Sorts the training frames by `time` where there is one, and gives the test views' times.
fn order_by_time(
    training: &mut [&Entry],
    test: &[&Entry],
    path: &Path,
) -> Result<Vec<f32>, IoError> {
    let without = || training.iter().chain(test).filter(|e| e.time.is_none());
    let total = training.len() + test.len();
    if without().count() != 0 && without().count() != total {
        let names: Vec<_> = without().map(|e| e.file_path.as_str()).collect();
        let what = format!("time of {}", list_names(&names));
        let advice = "give it to every frame or to none";
        return Err(IoError::missing(path, what, advice));
    }
    let far = |e: &&&Entry| e.time.is_some_and(|t| t.abs() > f64::from(f32::MAX));
    if let Some(entry) = training.iter().chain(test).find(far) {
        let what = format!(
            "{} has time {:e}",
            entry.file_path,
            entry.time.unwrap_or_default()
        );
        return Err(IoError::malformed(path, what));
    }
    let times: Vec<f64> = training.iter().filter_map(|e| e.time).collect();
    let all_the_same = times.iter().all(|t| *t == times[0]);
    if times.is_empty() || (all_the_same && training.len() > 1) {
        return Ok(test.iter().map(|e| time_by_name(e, training)).collect());
    }

    // JSON has no NaN, so the order is total.
    training.sort_by(|a, b| a.time.partial_cmp(&b.time).unwrap_or(Ordering::Equal));
    if let Some(pair) = training.windows(2).find(|p| p[0].time == p[1].time) {
        let (a, b) = (&pair[0].file_path, &pair[1].file_path);
        let what = format!("{a} and {b} have the same time; one camera's video is expected");
        return Err(IoError::malformed(path, what));
    }
    let times: Vec<f64> = training.iter().filter_map(|e| e.time).collect();
    Ok(test
        .iter()
        .filter_map(|e| e.time)
        .map(|t| time_between(t, &times))
        .collect())
}

fn time_by_name(view: &Entry, training: &[&Entry]) -> f32 {
    let stem = stem_of(&view.file_path);
    let order = |e: &&Entry| natural_order(stem_of(&e.file_path), stem);
    let after = training.iter().filter(|e| order(e).is_lt()).count();
    if training.iter().any(|e| order(e).is_eq()) {
        return after as f32;
    }
    (after as f32 - 0.5).clamp(0.0, (training.len() - 1) as f32)
}
