//! What the report says beside its pictures: cameras, scores, curves, and how the run came about.

use crate::config::Config;
use crate::log::Line;
use crate::shell::quoted;
use serde::Serialize;
use serde_json::Value;
use std::path::Path;
use trainer::glam::DAffine3;
use trainer::schedule::Schedule;
use trainer::{CameraView, Change, Run, Settings, differences};

/// Everything that the page is told, as JSON.
#[derive(Debug, Serialize)]
pub(crate) struct Facts<'a> {
    /// The scene's.
    name: &'a str,
    version: &'static str,
    backend: &'static str,
    iterations: usize,
    seconds: f64,
    /// Scene size S, scene units.
    scene_size: f64,
    gaussians: usize,
    movers: usize,
    /// Name of the file beside the page that holds the splats, where the page does not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) side_file: Option<&'static str>,
    /// Only while the run is trained.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) live: Option<Live>,
    train: Vec<Place>,
    test: Vec<Place>,
    curves: Curves,
    moments: Vec<Moment>,
    /// What `metrics.json` holds; null for a run that was not scored.
    metrics: &'a Value,
    notes: Vec<String>,
    changes: &'a [Change],
    /// Settings that are not the default.
    others: Vec<Other>,
    settings: &'a Settings,
    command: String,
}

/// A run that goes on.
#[derive(Debug, Serialize)]
pub(crate) struct Live {
    /// Number of the snapshot.
    pub(crate) snapshot: usize,
    /// Where the run ends.
    pub(crate) iterations: usize,
}

/// From where and when a view was taken.
#[derive(Debug, Serialize)]
struct Place {
    name: String,
    time: f32,
    width: usize,
    height: usize,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    near: f64,
    /// Rows of [R | t], camera from world, OpenCV axes.
    pose: [f64; 12],
}

/// The course of training, a number of each for every line of the log, as far as the page draws it.
#[derive(Debug, Serialize)]
struct Curves {
    iteration: Vec<usize>,
    loss: Vec<Option<f32>>,
    psnr: Vec<Option<f32>>,
    gaussians: Vec<usize>,
    seconds: Vec<f32>,
}

impl Curves {
    fn of(lines: &[Line]) -> Self {
        let short = |value: Option<f64>| value.map(|v| v as f32);
        Self {
            iteration: lines.iter().map(|line| line.iteration).collect(),
            loss: lines.iter().map(|line| short(line.loss)).collect(),
            psnr: lines.iter().map(|line| short(line.psnr)).collect(),
            gaussians: lines.iter().map(|line| line.gaussians).collect(),
            seconds: lines.iter().map(|line| line.seconds as f32).collect(),
        }
    }
}

/// Something that happens in the course of a run.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Moment {
    iteration: usize,
    what: &'static str,
}

#[derive(Debug, Serialize)]
struct Other {
    setting: String,
    value: Value,
    default: Value,
}

impl<'a> Facts<'a> {
    /// Of a run, with its scores and the lines of its log.
    pub(crate) fn new(
        run: &'a Run,
        config: &'a Config,
        metrics: &'a Value,
        curves: &[Line],
    ) -> Self {
        let settings = run.settings();
        let (train, test) = (run.views().train.iter(), run.views().test.iter());
        let others = differences(settings, &Settings::default());
        let mut notes = run.survey().notes.clone();
        for note in run.survey().decided(settings) {
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
        notes.extend_from_slice(run.decisions());
        Self {
            name: scene_name(config),
            version: env!("CARGO_PKG_VERSION"),
            backend: config.run.backend.name(),
            iterations: run.iteration(),
            seconds: run.seconds(),
            scene_size: run.survey().scene_size,
            gaussians: run.model().num_gaussians(),
            movers: run.model().num_dynamic(),
            side_file: None,
            live: None,
            train: train
                .enumerate()
                .map(|(frame, view)| Place::of(view, &run.training_pose(frame)))
                .collect(),
            test: test
                .map(|view| Place::of(view, &view.cam_from_world))
                .collect(),
            curves: Curves::of(curves),
            moments: moments(run.schedule()),
            metrics,
            notes,
            changes: run.changes(),
            command: command(config, &others),
            others: others
                .into_iter()
                .map(|o| Other {
                    setting: o.setting,
                    value: o.here,
                    default: o.there,
                })
                .collect(),
            settings,
        }
    }
}

impl Place {
    fn of(view: &CameraView, cam_from_world: &DAffine3) -> Self {
        let camera = &view.camera;
        let (r, t) = (cam_from_world.matrix3, cam_from_world.translation);
        Self {
            name: view.name.clone(),
            time: view.time,
            width: camera.width,
            height: camera.height,
            fx: camera.fx,
            fy: camera.fy,
            cx: camera.cx,
            cy: camera.cy,
            near: camera.near,
            pose: [
                r.x_axis.x, r.y_axis.x, r.z_axis.x, t.x, //
                r.x_axis.y, r.y_axis.y, r.z_axis.y, t.y, //
                r.x_axis.z, r.y_axis.z, r.z_axis.z, t.z,
            ],
        }
    }
}

/// The name of the scene's folder.
pub(crate) fn scene_name(config: &Config) -> &str {
    let folder = config.run.scene.as_deref().and_then(Path::file_name);
    folder.and_then(|name| name.to_str()).unwrap_or("scene")
}

/// What happens when, as far as it happens.
fn moments(schedule: &Schedule) -> Vec<Moment> {
    let n = schedule.iterations;
    let controlled: Vec<usize> = (1..=n)
        .filter(|it| schedule.controls_density(*it))
        .collect();
    let mut all = Vec::new();
    let mut add = |iteration: Option<usize>, what| {
        all.extend(
            iteration
                .filter(|it| (1..=n).contains(it))
                .map(|iteration| Moment { iteration, what }),
        );
    };
    add(schedule.densify_dynamic_at, "more movers");
    add(schedule.unseen_from, "unseen views");
    add(controlled.first().copied(), "density control begins");
    add(controlled.last().copied(), "density control ends");
    for (k, moment) in schedule.blur_moments.iter().enumerate() {
        add(
            Some(*moment),
            if k == 0 {
                "blur is modelled"
            } else {
                "blur model changes"
            },
        );
    }
    for (degree, what) in [
        "colours of degree 1",
        "colours of degree 2",
        "colours of degree 3",
    ]
    .into_iter()
    .enumerate()
    {
        add((1..=n).find(|it| schedule.sh_degree_at(*it) > degree), what);
    }
    all.sort_by_key(|moment| moment.iteration);
    all
}

/// What repeats the run, in the folder that holds the scene.
fn command(config: &Config, others: &[trainer::Difference]) -> String {
    let run = &config.run;
    let mut words = vec![
        "limpid train --scene".to_owned(),
        quoted(scene_name(config)),
    ];
    if let Some(images) = &run.images {
        words.push(format!("--images {}", quoted(&images.to_string_lossy())));
    }
    if run.factor() > 1 {
        words.push(format!("--downscale {}", run.factor()));
    }
    if run.is_static {
        words.push("--static".to_owned());
    }
    if run.distortion.name() != "undistort" {
        words.push(format!("--distortion {}", run.distortion.name()));
    }
    if run.backend.name() != "flex" {
        words.push(format!("--backend {}", run.backend.name()));
    }
    for other in others {
        push(&other.setting, &other.here, &mut words);
    }
    words.join(" ")
}

/// The flags of a setting that is not the default.
fn push(setting: &str, value: &Value, words: &mut Vec<String>) {
    let value = match value {
        Value::String(text) => text.clone(),
        // Not as JSON, which --set does not read.
        Value::Object(inner) => {
            for (key, value) in inner {
                push(&format!("{setting}.{key}"), value, words);
            }
            return;
        }
        value => value.to_string(),
    };
    words.push(match setting {
        "iterations" => format!("--iterations {value}"),
        "seed" => format!("--seed {value}"),
        setting => format!("--set {}", quoted(&format!("{setting}={value}"))),
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use trainer::schedule::Modelled;

    #[test]
    fn the_command_names_what_is_not_the_default() {
        let mut config = Config::of(Settings {
            iterations: 300,
            ..Settings::default()
        });
        config.run.scene = Some("/somewhere/my scene".into());
        config.run.downscale = Some(2);
        config.run.distortion = crate::config::Distortion::Refuse;
        config.settings.blur.kernel_size = 7;
        config.settings.camera.transfer = trainer::settings::TransferKind::Power(2.2);
        let others = differences(&config.settings, &Settings::default());
        assert_eq!(
            command(&config, &others),
            "limpid train --scene 'my scene' --downscale 2 --distortion refuse --set blur.kernel_size=7 \
             --set camera.transfer.power=2.2 --iterations 300"
        );
    }

    #[test]
    fn moments_come_in_order_and_within_the_run() {
        let settings = Settings {
            iterations: 3000,
            ..Settings::default()
        };
        let modelled = Modelled {
            motion: true,
            unseen: true,
            blur_moments: vec![250, 401],
            camera_settled: Some(401),
        };
        let moments = moments(&Schedule::new(&settings, 24, modelled));
        assert!(moments.is_sorted_by_key(|m| m.iteration), "{moments:?}");
        let at = |what| moments.iter().find(|m| m.what == what).map(|m| m.iteration);
        assert_eq!(at("more movers"), Some(187));
        assert_eq!(at("blur is modelled"), Some(250));
        assert_eq!(at("blur model changes"), Some(401));
        assert_eq!(at("colours of degree 3"), Some(225));
    }
}
