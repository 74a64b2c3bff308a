//! A scene as a folder in Shape-of-Motion's layout, as a user has it: what programs read that know no other scenes.

use io::{ExportedView, IoError, Map, Scene, TrackSample, write_colmap, write_map_png, write_png};
use npyz::WriterBuilder as _;
use std::path::Path;

/// Writes frames, masks, disparity, tracks, test views and cameras. Pictures and masks are rounded to 8 bits. Test views are one
/// for every frame, in their order, or none.
///
/// # Errors
/// A file cannot be written.
pub fn write(scene: &Scene, root: &Path) -> Result<(), IoError> {
    let preprocessed = root.join("flow3d_preprocessed");
    let disparity = preprocessed.join("aligned_depth_anything_colmap");
    let tracks = preprocessed.join("2d_tracks");
    let name = |frame: usize| format!("{frame:05}");
    let mut cameras = Vec::new();
    for (index, frame) in scene.frames.iter().enumerate() {
        let picture = format!("{}.png", name(index));
        // A stereo pair of each moment: even numbers are the frames', odd ones the test views'.
        let views = [
            (Some(&frame.view), "images", 2 * index),
            (scene.test.get(index), "images_test", 2 * index + 1),
        ];
        for (view, folder, number) in views {
            let Some(view) = view else { continue };
            write_png(&root.join(folder).join(&picture), &view.image)?;
            cameras.push(ExportedView {
                file: format!("{}.png", name(number)),
                camera: view.camera.clone(),
                cam_from_world: view.cam_from_world,
                time: view.time,
                is_test: number % 2 == 1,
            });
        }
        if let Some(mask) = &frame.mask {
            write_map_png(&root.join("masks").join(&picture), mask)?;
        }
        if let Some(depth) = &frame.depth {
            let path = disparity.join(format!("{}.npy", name(index)));
            write_npy(&path, &[depth.height, depth.width], &inverses(depth))?;
        }
    }
    if let Some(all) = &scene.tracks {
        for query in &all.queries {
            let of_points = query.samples.chunks_exact(all.num_frames);
            for target in 0..all.num_frames {
                let rows: Vec<f32> = of_points
                    .clone()
                    .flat_map(|point| row(&point[target]))
                    .collect();
                let path = tracks.join(format!("{}_{}.npy", name(query.frame), name(target)));
                write_npy(&path, &[rows.len() / 4, 4], &rows)?;
            }
        }
    }
    let model = preprocessed.join("colmap/sparse");
    write_colmap(&model, &cameras, &scene.points)
}

/// Disparity, 0 where there is no depth.
fn inverses(depth: &Map) -> Vec<f32> {
    let inverse = |z: &f32| if *z > 0.0 { 1.0 / z } else { 0.0 };
    depth.values.iter().map(inverse).collect()
}

/// The format has pixel i at coordinate i.
fn row(sample: &TrackSample) -> [f32; 4] {
    let TrackSample { x, y, .. } = sample;
    [x - 0.5, y - 0.5, sample.occlusion, sample.expected_distance]
}

/// Writes an array of NumPy's.
///
/// # Errors
/// The file cannot be written.
pub fn write_npy(path: &Path, shape: &[usize], values: &[f32]) -> Result<(), IoError> {
    let shape: Vec<u64> = shape.iter().map(|side| *side as u64).collect();
    io::write_atomic(path, |out| {
        let options = npyz::WriteOptions::new().default_dtype().shape(&shape);
        let mut array = options.writer(out).begin_nd()?;
        array.extend(values.iter().copied())?;
        array.finish()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bodies::{self, Bodies};
    use crate::largest;
    use burn::tensor::Device;
    use io::{Tracks, View};

    #[test]
    fn a_folder_holds_what_the_scene_has() {
        let device = Device::flex();
        let mut scene = bodies::scene(Bodies::Balls(1), 0.12, &device);
        scene.test = bodies::views_beside(Bodies::Balls(1), 0.12, 0.1, &device);
        let folder = tempfile::tempdir().expect("a folder");
        write(&scene, folder.path()).expect("files");
        let read = Scene::open(folder.path()).expect("a scene");
        let furthest = |a: &[f32], b: &[f32]| {
            assert_eq!(a.len(), b.len());
            largest(a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())))
        };
        let same = |a: &View, b: &View| {
            let clamped: Vec<f32> = a.image.pixels.iter().map(|v| v.clamp(0.0, 1.0)).collect();
            assert!(furthest(&clamped, &b.image.pixels) <= 0.501 / 255.0);
            assert!(a.cam_from_world.abs_diff_eq(b.cam_from_world, 1e-9));
            assert_eq!((&a.camera, a.time), (&b.camera, b.time));
        };
        assert_eq!(scene.frames.len(), read.frames.len());
        assert_eq!(scene.test.len(), read.test.len());
        for (a, b) in scene.test.iter().zip(&read.test) {
            same(a, b);
        }
        for (a, b) in scene.frames.iter().zip(&read.frames) {
            same(&a.view, &b.view);
            assert_eq!(a.mask, b.mask);
            let [a, b] = [&a.depth, &b.depth].map(|depth| depth.as_ref().expect("depth"));
            assert!(furthest(&a.values, &b.values) < 1e-5);
        }
        let samples = |tracks: &Option<Tracks>| -> Vec<f32> {
            let queries = &tracks.as_ref().expect("tracks").queries;
            let samples = queries.iter().flat_map(|query| &query.samples);
            samples
                .flat_map(|s| [s.x, s.y, s.occlusion, s.expected_distance])
                .collect()
        };
        assert!(furthest(&samples(&scene.tracks), &samples(&read.tracks)) < 1e-4);
    }
}
