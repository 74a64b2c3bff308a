//! `limpid render --path`: pictures along a path of the camera, and a video of them.

use crate::failure::{Failure, refuse_idle};
use crate::moments::{Moments, within};
use crate::numbered::Numbered;
use crate::say::say;
use crate::video;
use io::{KeyFrame, Map};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use trainer::{CameraView, Layers, Orbit, PoseSpline, Run};

/// Options of a path.
#[derive(Debug, clap::Args)]
pub(crate) struct ClipArguments {
    /// Take pictures along a path instead of those of the views: `cameras` is where the camera was, `ellipse` and `spiral` go round
    /// there, and a JSON file holds key frames (docs/EXPORT.md).
    #[arg(long, value_name = "cameras|ellipse|spiral|FILE", conflicts_with_all = ["at", "scene"])]
    pub(crate) path: Option<PathBuf>,
    #[command(flatten)]
    moments: Moments,
    /// With --path: time stands still at this moment, and the camera alone moves.
    #[arg(
        long,
        value_name = "TIME",
        requires = "path",
        allow_negative_numbers = true
    )]
    freeze: Option<f32>,
    /// With --path ellipse or spiral: go so many times as far out as the camera did [default: 1].
    #[arg(
        long,
        value_name = "TIMES",
        requires = "path",
        allow_negative_numbers = true
    )]
    reach: Option<f64>,
    /// With --path: what pictures show; several with commas between them.
    #[arg(
        long,
        value_name = "WHAT",
        requires = "path",
        value_delimiter = ',',
        default_value = "color"
    )]
    what: Vec<What>,
    /// With --path: make a video too, with the ffmpeg on this machine.
    #[arg(long, requires = "path")]
    video: bool,
    /// With --path: pictures in a second of the video, and of key frames [default: 24].
    #[arg(
        long,
        value_name = "FPS",
        requires = "path",
        allow_negative_numbers = true
    )]
    fps: Option<f64>,
}

/// What a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// The scene.
    Color,
    /// Depth z as grey S / (S + z), S being the scene's size: near is white, S is half grey, and nothing is black.
    Depth,
    /// The movers' share of each pixel: white where only movers are seen.
    Movers,
}

impl What {
    fn name(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Depth => "depth",
            Self::Movers => "movers",
        }
    }
}

impl ClipArguments {
    /// An error for moments that no path asks for.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        if self.path.is_none() && self.moments.are_given() {
            return Err("--from, --to and --step go with --path".into());
        }
        Ok(())
    }
}

/// Pictures in a second, where nothing is said.
const FPS: f64 = 24.0;
/// Most pictures of a clip.
const MOST: f64 = 100_000.0;

/// Writes the pictures of a path into `OUT/PATH/WHAT/`, and their videos.
pub(crate) fn render(
    run: &Run,
    path: &Path,
    arguments: &ClipArguments,
    out: &Path,
) -> Result<(), Failure> {
    let ClipArguments { what, video, .. } = arguments;
    let fps = arguments.fps.unwrap_or(FPS);
    if !(fps.is_finite() && fps > 0.0) {
        return Err(format!("--fps {fps}: a number over 0 is expected").into());
    }
    if what.contains(&What::Movers) && run.model().num_dynamic() == 0 {
        return Err("--what movers: nothing moves in this scene".into());
    }
    let (name, shots) = shots(run, path, arguments)?;
    let out = out.join(name);
    let folders = what.iter().map(|what| {
        let names = Numbered::new(out.join(what.name()), ("", "png"), (5, shots.len()));
        names.clear().map(|()| (*what, names))
    });
    let folders = folders.collect::<Result<Vec<_>, _>>()?;
    for (index, shot) in shots.iter().enumerate() {
        let layers = run.render_layers(shot)?;
        for (what, names) in &folders {
            write(*what, &layers, run.survey().scene_size, &names.path(index))?;
        }
    }
    for (what, names) in &folders {
        let folder = out.join(what.name());
        let size = run.survey().scene_size;
        let grey = match what {
            What::Depth => format!("; grey is S / (S + z), S = {size:.4} scene units"),
            What::Color | What::Movers => String::new(),
        };
        say!("{}: {} pictures{grey}", folder.display(), shots.len());
        if *video {
            video::write(names, shots.len(), fps, &folder.with_extension("mp4"))?;
        }
    }
    Ok(())
}

fn write(what: What, layers: &Layers, size: f64, path: &Path) -> Result<(), Failure> {
    match what {
        What::Color => io::write_png(path, &layers.color)?,
        What::Depth => {
            let grey = |z: &f32| {
                if *z > 0.0 {
                    size as f32 / (size as f32 + z)
                } else {
                    0.0
                }
            };
            let values = layers.depth.values.iter().map(grey).collect();
            io::write_map_png(
                path,
                &Map {
                    values,
                    ..layers.depth
                },
            )?;
        }
        What::Movers => {
            let movers = layers
                .movers
                .as_ref()
                .ok_or("nothing moves in this scene")?;
            io::write_map_png(path, movers)?;
        }
    }
    Ok(())
}

/// The path's name, and where and when its pictures are taken.
fn shots(
    run: &Run,
    path: &Path,
    arguments: &ClipArguments,
) -> Result<(String, Vec<CameraView>), Failure> {
    let ClipArguments {
        moments,
        freeze,
        reach,
        fps,
        video,
        ..
    } = arguments;
    if let Some(time) = freeze {
        within(run, "--freeze", *time)?;
    }
    let named = path
        .to_str()
        .filter(|name| ["cameras", "ellipse", "spiral"].contains(name));
    let Some(name) = named else {
        if moments.are_given() || reach.is_some() {
            return Err("--from, --to, --step and --reach go with the paths by name: key frames have their own times and places".into());
        }
        let name = path.file_stem().and_then(OsStr::to_str).unwrap_or("path");
        return Ok((
            name.to_owned(),
            key_frames(run, path, *freeze, fps.unwrap_or(FPS))?,
        ));
    };
    refuse_idle([
        (
            ("--reach", reach.is_some()),
            (name != "cameras", "--path ellipse and spiral"),
        ),
        (("--fps", fps.is_some()), (*video, "--video and key frames")),
    ])?;
    let reach = reach.unwrap_or(1.0);
    if !(reach.is_finite() && reach > 0.0) {
        return Err(format!("--reach {reach}: a number over 0 is expected").into());
    }
    let moments = moments.of(run)?;
    let seen_at = |time: f32| freeze.unwrap_or(time);
    if name == "cameras" {
        let mut shots = run.views_at(&moments);
        for shot in &mut shots {
            shot.time = seen_at(shot.time);
        }
        return Ok((name.to_owned(), shots));
    }
    let cameras: Vec<_> = run
        .views()
        .train
        .iter()
        .map(|view| view.cam_from_world)
        .collect();
    let orbit = Orbit::around(&cameras, run.survey().scene_size, reach).ok_or_else(|| {
        format!(
            "--path {name}: the cameras look in opposite directions, and have no middle to go round"
        )
    })?;
    let first = &run.views().train[0];
    let shots = moments.iter().enumerate().map(|(k, time)| {
        let share = k as f64 / moments.len() as f64;
        CameraView {
            name: name.to_owned(),
            camera: first.camera.clone(),
            cam_from_world: if name == "ellipse" {
                orbit.ellipse(share)
            } else {
                orbit.spiral(share)
            },
            time: seen_at(*time),
        }
    });
    Ok((name.to_owned(), shots.collect()))
}

/// The pictures of a file with key frames: a smooth path through its poses, and evenly from each to the next in time and, by its
/// logarithm, in focal length.
fn key_frames(
    run: &Run,
    path: &Path,
    freeze: Option<f32>,
    fps: f64,
) -> Result<Vec<CameraView>, Failure> {
    if !path.exists() {
        return Err(format!(
            "--path {}: there is no such file, and the paths by name are cameras, ellipse and spiral",
            path.display()
        )
        .into());
    }
    let keys = io::read_key_frames(path)?;
    for (index, key) in keys.iter().enumerate() {
        within(run, "time", key.time as f32)
            .map_err(|error| format!("key frame {index}: {error}: {}", path.display()))?;
    }
    let camera = &run.views().train[0].camera;
    let focal = |key: &KeyFrame| match key.fov {
        Some(fov) => 0.5 * camera.height as f64 / (0.5 * fov.to_radians()).tan(),
        None => camera.fy,
    };
    let spline = PoseSpline::new(keys.iter().map(|key| (key.second, key.cam_from_world)))
        .ok_or_else(|| format!("the key frames make no path: {}", path.display()))?;
    let [first, last] = [keys[0].second, keys[keys.len() - 1].second];
    let pictures = ((last - first) * fps + 1e-6).floor();
    if pictures >= MOST {
        return Err(format!("--fps {fps}: that would be {pictures} pictures").into());
    }
    let shot = |k: usize| {
        let second = (first + k as f64 / fps).min(last);
        let next = keys.partition_point(|key| key.second <= second);
        let (a, b) = (
            &keys[next.saturating_sub(1)],
            &keys[next.min(keys.len() - 1)],
        );
        let length = b.second - a.second;
        let share = if length > 0.0 {
            (second - a.second) / length
        } else {
            0.0
        };
        let time = a.time + (b.time - a.time) * share;
        let zoom = focal(a).powf(1.0 - share) * focal(b).powf(share) / camera.fy;
        let mut camera = camera.clone();
        (camera.fx, camera.fy) = (camera.fx * zoom, camera.fy * zoom);
        CameraView {
            name: format!("at {second} s"),
            camera,
            cam_from_world: spline.pose(second),
            time: freeze.unwrap_or(time as f32),
        }
    };
    Ok((0..=pictures as usize).map(shot).collect())
}
