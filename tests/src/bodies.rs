//! Scenes made by the rasteriser itself: bodies that move before a textured wall, each by itself, with the masks, depth and tracks
//! that a user would have of them.

use crate::{noise, tensor, values, wall};
use burn::tensor::{DType, Device, Tensor};
use glam::{DAffine3, DQuat, DVec2, DVec3};
use io::{Frame, Image, Map, QueryTracks, Scene, TrackSample, Tracks, View};
use splat_core::{Camera, Extra, Rendered, Splats, Viewpoint, pose_rows, render};

/// Number of training frames.
pub const FRAMES: usize = 14;
const SIZE: [usize; 2] = [96, 64];
const FOCAL: f64 = 90.0;
/// Nearer than everything that stands still.
const DEPTH: f64 = 1.9;
/// Of a ball, and of the rod's round; scene units.
const RADII: [f64; 2] = [0.28, 0.12];
/// Of a frame with blur.
const MOMENTS: usize = 9;
/// Light is averaged; this is near enough to the curve of sRGB.
const GAMMA: f64 = 2.2;
/// Time for which the shutter is open, in units of frames.
const SHUTTER: f64 = 0.9;

/// What is before the wall.
#[derive(Clone, Copy, Debug)]
pub enum Bodies {
    /// So many balls, up to three, each of which goes and turns its own way.
    Balls(usize),
    /// A rod that bends to and fro.
    Rod,
    /// Three balls that stand still, though masks show them.
    Still,
}

/// A point on a body, and which way its surface faces there.
struct Point {
    place: DVec3,
    normal: DVec3,
    body: usize,
}

impl Bodies {
    fn points(self) -> Vec<Point> {
        match self {
            Self::Balls(count) => balls(count),
            Self::Still => balls(3),
            Self::Rod => {
                let of = |k: usize| {
                    let (along, round) = ((k / 48) as f64, (k % 48) as f64);
                    let normal = DQuat::from_rotation_x(0.13 * (round + 0.5 * along)) * DVec3::Y;
                    let axis = DVec3::new(-0.7 + 0.0175 * along, 0.0, DEPTH);
                    Point {
                        place: axis + RADII[1] * normal,
                        normal,
                        body: 0,
                    }
                };
                (0..81 * 48).map(of).collect()
            }
        }
    }

    /// How a point's surroundings are moved at a time, from where they are at rest.
    fn motion(self, point: &Point, time: f64) -> DAffine3 {
        let (center, turn, way) = match self {
            Self::Still => return DAffine3::IDENTITY,
            Self::Balls(_) => {
                let axis = [DVec3::Y, DVec3::X, DVec3::Z][point.body];
                let way = [DVec3::new(0.6, -0.8, 0.0), -DVec3::X, DVec3::Z][point.body];
                let turn = DQuat::from_axis_angle(axis, 0.09 * (time - 0.5 * FRAMES as f64));
                (CENTERS[point.body], turn, 0.025 * way * time)
            }
            Self::Rod => {
                let angle = 1.2 * point.place.x * (0.5 * time).sin();
                (DVec3::Z * DEPTH, DQuat::from_rotation_z(angle), DVec3::ZERO)
            }
        };
        let there = DAffine3::from_translation(center + way);
        there * DAffine3::from_quat(turn) * DAffine3::from_translation(-center)
    }
}

const CENTERS: [DVec3; 3] = [
    DVec3::new(-0.55, -0.2, DEPTH),
    DVec3::new(0.55, 0.25, DEPTH),
    DVec3::new(0.0, -0.15, DEPTH),
];

/// Points all over the balls (a Fibonacci lattice).
fn balls(count: usize) -> Vec<Point> {
    let each = 1600;
    let of = |k: usize| {
        let (body, k) = (k / each, (k % each) as f64);
        let height = 1.0 - 2.0 * (k + 0.5) / each as f64;
        let round = capture::GOLDEN_ANGLE * k;
        let flat = (1.0 - height * height).sqrt();
        let normal = DVec3::new(flat * round.cos(), height, flat * round.sin());
        Point {
            place: CENTERS[body] + RADII[0] * normal,
            normal,
            body,
        }
    };
    (0..count * each).map(of).collect()
}

/// World to camera at a time, of a camera that goes slowly to the right and turns by up to `shake` rad in a frame.
fn pose(frame: usize, moment: f64, shake: f64) -> DAffine3 {
    let time = frame as f64 + moment;
    // Some frames are sharper than others, as in every shaken video.
    let turn = shake * (0.4 + 0.3 * (frame % 3) as f64) * moment;
    let center = DVec3::new(0.03 * time - 0.2, 0.01 * (0.8 * time).sin(), 0.0);
    DAffine3::from_rotation_y(turn) * DAffine3::from_translation(-center)
}

/// How far and which way a point at a depth in the middle of the picture goes on it from when the shutter opens until it closes, px.
#[must_use]
pub fn streak(frame: usize, shake: f64, depth: f64) -> DVec2 {
    let world_from_cam = pose(frame, 0.0, shake).inverse();
    let at = |moment: f64| {
        let there = pose(frame, moment, shake) * world_from_cam;
        let seen = there.transform_point3(DVec3::Z * depth);
        FOCAL * seen.truncate() / seen.z
    };
    at(0.5 * SHUTTER) - at(-0.5 * SHUTTER)
}

/// The camera of all views.
fn camera() -> Camera {
    Camera::pinhole(
        SIZE,
        [FOCAL; 2],
        [0.5 * SIZE[0] as f64, 0.5 * SIZE[1] as f64],
    )
}

/// What a camera sees of a scene at a time.
fn seen(
    still: &Splats,
    (bodies, points): (Bodies, &[Point]),
    cam_from_world: &DAffine3,
    time: f64,
    device: &Device,
) -> Rendered {
    let view = Viewpoint {
        camera: camera(),
        cam_from_world: tensor(&pose_rows(cam_from_world), [3, 4], device, DType::F32),
        sh_degree: 0,
    };
    let world = with_bodies(still, bodies, points, time, device);
    render(world, &view, Extra::default()).expect("a render")
}

fn image(color: Tensor<3>) -> Image {
    Image {
        width: SIZE[0],
        height: SIZE[1],
        pixels: values(color).iter().map(|v| *v as f32).collect(),
    }
}

/// Sharp views from so far to the right of each frame, in scene units, to score by.
#[must_use]
pub fn views_beside(bodies: Bodies, shake: f64, aside: f64, device: &Device) -> Vec<View> {
    let (still, points) = (wall::splats(device), bodies.points());
    let beside = DAffine3::from_translation(-aside * DVec3::X);
    let view = |frame: usize| {
        let time = frame as f64;
        let cam_from_world = beside * pose(frame, 0.0, shake);
        let shown = seen(&still, (bodies, &points), &cam_from_world, time, device);
        View {
            name: format!("{frame:05}"),
            camera: camera(),
            cam_from_world,
            time: time as f32,
            image: image(shown.color().clamp(0.0, 1.0)),
        }
    };
    (0..FRAMES).map(view).collect()
}

/// The scene; with a `shake` frames are blurred by a shutter that is open for 0.9 frames, without one they are sharp.
#[must_use]
pub fn scene(bodies: Bodies, shake: f64, device: &Device) -> Scene {
    let points = bodies.points();
    let camera = camera();
    let still = wall::splats(device);
    let frames = (0..FRAMES).map(|frame| {
        let taken = |moment: f64| {
            let cam_from_world = pose(frame, moment, shake);
            let time = frame as f64 + moment;
            seen(&still, (bodies, &points), &cam_from_world, time, device)
        };
        let middle = taken(0.0);
        let depth = values::<2>(middle.depth() / middle.alpha().clamp_min(0.5));
        let shown = depth.iter().zip(values::<2>(middle.alpha()));
        // Nothing else is so near, but what shows through gaps of the wall has no depth to go by.
        let mask = shown.map(|(depth, alpha)| alpha > 0.9 && *depth < DEPTH + 0.45);
        let mask = mask.map(|shows| f64::from(u8::from(shows)));
        let map = |values: &mut dyn Iterator<Item = f64>| Map {
            width: SIZE[0],
            height: SIZE[1],
            values: values.map(|v| v as f32).collect(),
        };
        let color = if shake == 0.0 {
            middle.color()
        } else {
            let moments = (0..MOMENTS).map(|k| SHUTTER * ((k as f64 + 0.5) / MOMENTS as f64 - 0.5));
            let sum =
                moments.map(|moment| taken(moment).color().clamp(0.0, 1.0).powf_scalar(GAMMA));
            let sum = sum.reduce(|a, b| a + b).expect("moments");
            (sum / MOMENTS as f64).powf_scalar(1.0 / GAMMA)
        };
        Frame {
            view: View {
                name: format!("{frame:05}"),
                camera: camera.clone(),
                cam_from_world: pose(frame, 0.0, shake),
                time: frame as f32,
                image: image(color),
            },
            mask: Some(map(&mut mask.into_iter())),
            depth: Some(map(&mut depth.iter().copied())),
        }
    });
    Scene {
        tracks: Some(tracks(bodies, &points, &camera)),
        ..Scene::of_frames(frames.collect())
    }
}

/// What stands still, and the bodies as they are at a time.
fn with_bodies(
    still: &Splats,
    bodies: Bodies,
    points: &[Point],
    time: f64,
    device: &Device,
) -> Splats {
    let count = points.len();
    let places = points.iter().flat_map(|point| {
        bodies
            .motion(point, time)
            .transform_point3(point.place)
            .to_array()
    });
    let f32s = |values: &[f64], shape| tensor(values, shape, device, DType::F32);
    let sh: Vec<f64> = noise(3 * count, 7).iter().map(|v| 1.6 * v).collect();
    let join = |still: &Tensor<2>, own: Tensor<2>| Tensor::cat(vec![still.clone(), own], 0);
    Splats {
        means: join(&still.means, f32s(&places.collect::<Vec<_>>(), [count, 3])),
        quats: join(
            &still.quats,
            f32s(&[1.0, 0.0, 0.0, 0.0].repeat(count), [count, 4]),
        ),
        left_rotations: None,
        log_scales: join(
            &still.log_scales,
            f32s(&vec![0.018_f64.ln(); 3 * count], [count, 3]),
        ),
        opacity_logits: join(&still.opacity_logits, f32s(&vec![6.0; count], [count, 1])),
        sh: join(&still.sh, f32s(&sh, [count, 3])),
    }
}

/// Of some of the points on the bodies, from every third frame, off by up to 0.3 px; a tracker loses a surface that is seen at a low
/// angle.
fn tracks(bodies: Bodies, points: &[Point], camera: &Camera) -> Tracks {
    let queries = (0..FRAMES).map(|query| {
        let seen_in = |frame: usize, point: &Point| {
            let motion = bodies.motion(point, frame as f64);
            let pose = pose(frame, 0.0, 0.0);
            let place = pose.transform_point3(motion.transform_point3(point.place));
            let faces = pose.transform_vector3(motion.transform_vector3(point.normal));
            (
                camera.project(place),
                faces.dot(place) < -0.45 * place.length(),
            )
        };
        let asked = points.iter().step_by(5);
        let asked = asked.filter(|point| query % 3 == 0 && seen_in(query, point).1);
        let mut samples = Vec::new();
        for point in asked {
            for frame in 0..FRAMES {
                let (at, is_seen) = seen_in(frame, point);
                let occlusion = if is_seen { -5.0 } else { 5.0 };
                samples.push(TrackSample {
                    x: at.x as f32,
                    y: at.y as f32,
                    occlusion,
                    expected_distance: occlusion,
                });
            }
        }
        let off = noise(2 * samples.len(), query as u64 + 1);
        for (sample, off) in samples.iter_mut().zip(off.chunks_exact(2)) {
            sample.x += 0.3 * off[0] as f32;
            sample.y += 0.3 * off[1] as f32;
        }
        QueryTracks {
            frame: query,
            samples,
        }
    });
    Tracks {
        num_frames: FRAMES,
        queries: queries.collect(),
    }
}
