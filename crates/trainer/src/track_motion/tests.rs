//! Still and moving things before a wall, filmed by a handheld camera; all that is given of them is off.

use super::*;
use glam::{DMat3, DQuat};
use io::{Image, TrackSample, Tracks, View};
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const FRAMES: usize = 24;
const WIDTH: usize = 256;
const HEIGHT: usize = 144;
/// The wall is at z = 4 + 0.3 x.
const SLOPE: f64 = 0.3;
/// No point is nearer than this.
const NEAREST: f64 = 0.4;

/// What of the inputs is off.
#[derive(Clone, Copy)]
struct Errors {
    /// Tracks, standard deviation, px.
    noise: f64,
    /// Share of positions that are anywhere, and of those that are said to be hidden and are not, or the other way round.
    wrong: f64,
    /// Poses, standard deviation of a turn, px.
    pose: f64,
    /// Poses, standard deviation of a turn that changes slowly, px.
    drift: f64,
    /// Depth, as a share.
    depth: f64,
}

const SOME: Errors = Errors {
    noise: 0.6,
    wrong: 0.03,
    pose: 0.5,
    drift: 0.0,
    depth: 0.08,
};

/// From -1 to 1.
fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Of a standard deviation of 1.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| uniform(rng)).sum::<f64>() / 2.0
}

/// Where a handheld camera is.
fn place(t: usize) -> DVec3 {
    let t = t as f64;
    DVec3::new(0.06 * t, 0.03 * (1.3 * t).sin(), 0.02 * (0.7 * t).cos())
}

/// The wall, filmed by a camera at `place`, and tracks on a grid in a mask, of points that `moved` has moved by then.
fn scene(
    seed: u64,
    errors: Errors,
    place: fn(usize) -> DVec3,
    moved: impl Fn(DVec3, usize) -> DVec3,
) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let camera = Camera::pinhole([WIDTH, HEIGHT], [213.0; 2], [128.0, 72.0]);
    let turn = |t: usize| DMat3::from_rotation_y(0.01 * (0.9 * t as f64).sin());
    let cam_from_world =
        |t: usize| DAffine3::from_mat3(turn(t)) * DAffine3::from_translation(-place(t));
    // The wall's point that a pixel sees, in the world.
    let wall = |at: DVec2, t: usize| {
        let (from, ray) = (place(t), turn(t).transpose() * camera.unproject(at, 1.0));
        let along = (4.0 + SLOPE * from.x - from.z) / (ray.z - SLOPE * ray.x);
        from + along * ray
    };
    let frames = (0..FRAMES).map(|t| {
        let pixels = (0..WIDTH * HEIGHT).map(|i| {
            let (x, y) = ((i % WIDTH) as f64 + 0.5, (i / WIDTH) as f64 + 0.5);
            let z = cam_from_world(t)
                .transform_point3(wall(DVec2::new(x, y), t))
                .z;
            let wave = (0.05 * x + 2.3 * t as f64).sin() * (0.04 * y - 1.1 * t as f64).cos();
            (z * (1.0 + errors.depth * wave)) as f32
        });
        let masked = |i: usize| is_masked(DVec2::new((i % WIDTH) as f64, (i / WIDTH) as f64));
        let mask = (0..WIDTH * HEIGHT).map(|i| f32::from(u8::from(masked(i))));
        let map = |values| Map {
            width: WIDTH,
            height: HEIGHT,
            values,
        };
        let off = errors.pose / 213.0;
        let slow = std::f64::consts::SQRT_2 * errors.drift / 213.0;
        let (sin, cos) = (0.3 * t as f64 + seed as f64).sin_cos();
        let turned = DQuat::from_rotation_y(off * normal(&mut rng) + slow * sin)
            * DQuat::from_rotation_x(off * normal(&mut rng) + slow * cos);
        Frame {
            view: View {
                name: format!("{t}"),
                camera: camera.clone(),
                cam_from_world: DAffine3::from_quat(turned) * cam_from_world(t),
                time: t as f32,
                image: Image {
                    width: WIDTH,
                    height: HEIGHT,
                    pixels: Vec::new(),
                },
            },
            depth: Some(map(pixels.collect())),
            mask: Some(map(mask.collect())),
        }
    });
    let frames: Vec<Frame> = frames.collect();
    let mut sample = |at: DVec2| {
        let mut at = at + errors.noise * DVec2::new(normal(&mut rng), normal(&mut rng));
        if uniform(&mut rng).abs() < errors.wrong {
            at += 30.0 * DVec2::new(uniform(&mut rng), uniform(&mut rng));
        }
        let hidden = uniform(&mut rng).abs() < errors.wrong;
        TrackSample {
            x: at.x as f32,
            y: at.y as f32,
            occlusion: if hidden { 5.0 } else { -5.0 },
            expected_distance: -5.0,
        }
    };
    let queries = (0..FRAMES).map(|query| {
        let grid = (0..HEIGHT / 8).flat_map(|y| (0..WIDTH / 8).map(move |x| (x, y)));
        let starts = grid.map(|(x, y)| 8.0 * DVec2::new(x as f64, y as f64) + 4.0);
        let starts = starts.filter(|at| is_masked(*at));
        let samples = starts.flat_map(|start| {
            let point = wall(start, query);
            let seen = (0..FRAMES).map(|t| {
                let now = point + moved(point, t) - moved(point, query);
                camera.project(cam_from_world(t).transform_point3(now))
            });
            seen.collect::<Vec<DVec2>>()
        });
        QueryTracks {
            frame: query,
            samples: samples.map(&mut sample).collect(),
        }
    });
    Scene {
        tracks: Some(Tracks {
            num_frames: FRAMES,
            queries: queries.collect(),
        }),
        ..Scene::of_frames(frames)
    }
}

fn is_masked(at: DVec2) -> bool {
    (40.0..216.0).contains(&at.x) && (24.0..120.0).contains(&at.y)
}

fn told(scene: &Scene) -> TrackMotion {
    track_motion(scene, NEAREST).expect("tracks enough")
}

#[test]
fn what_stands_still_is_told_whatever_is_a_bit_off() {
    let none = Errors {
        noise: 0.0,
        wrong: 0.0,
        pose: 0.0,
        drift: 0.0,
        depth: 0.0,
    };
    let coarse = Errors { pose: 1.2, ..SOME };
    let drifts = Errors { drift: 0.8, ..SOME };
    let lost = Errors {
        wrong: 0.06,
        ..SOME
    };
    for (k, errors) in [none, SOME, coarse, drifts, lost].into_iter().enumerate() {
        for seed in 0..3 {
            let found = told(&scene(seed, errors, place, |_, _| DVec3::ZERO));
            assert!(found.stands_still() && !found.moves(), "{k}: {found:?}");
            assert!(found.leaving < 0.05, "{k}: {found:?}");
        }
    }
}

#[test]
fn what_moves_across_or_along_its_epipolar_lines_is_told() {
    let across = |_: DVec3, t: usize| DVec3::new(0.0, 0.03 * t as f64, 0.0);
    // As far as most of what the camera goes: it stays on its epipolar lines, and is seen where what is far away would be.
    let along = |_: DVec3, t: usize| 0.8 * place(t);
    for seed in 0..3 {
        let found = told(&scene(seed, SOME, place, across));
        assert!(found.moves() && found.leaving > 0.9, "across: {found:?}");
        let mut scene = scene(seed, SOME, place, along);
        let found = told(&scene);
        assert!(found.moves() && found.leaving > 0.9, "along: {found:?}");
        // Which depth alone can tell.
        scene.frames.iter_mut().for_each(|f| f.depth = None);
        assert!(!told(&scene).moves(), "{:?}", told(&scene));
    }
}

#[test]
fn a_camera_that_only_turns_tells_what_moves_too() {
    let here = |_: usize| DVec3::ZERO;
    assert!(told(&scene(1, SOME, here, |_, _| DVec3::ZERO)).stands_still());
    let sways = |_: DVec3, t: usize| DVec3::new(0.3 * (0.6 * t as f64).sin(), 0.0, 0.0);
    assert!(told(&scene(1, SOME, here, sways)).moves());
}

/// A car that drives off at the end of a video, or one that comes to rest early.
#[test]
fn what_rests_for_most_of_the_video_is_told() {
    let last = |_: DVec3, t: usize| DVec3::new(0.0, 0.08 * t.saturating_sub(18) as f64, 0.0);
    let first = |_: DVec3, t: usize| DVec3::new(0.0, -0.08 * 6_usize.saturating_sub(t) as f64, 0.0);
    for seed in 0..3 {
        for moved in [last, first] {
            let found = told(&scene(seed, SOME, place, moved));
            assert!(found.moves() && found.leaving > 0.5, "{found:?}");
        }
    }
}

#[test]
fn a_small_mover_among_what_stands_still_is_told() {
    // A disc of about a fiftieth of what is masked, which rises.
    let disc = |point: DVec3, t: usize| {
        let near = (point.x - 0.3).powi(2) + point.y.powi(2) < 0.04;
        DVec3::new(0.0, if near { 0.05 * t as f64 } else { 0.0 }, 0.0)
    };
    for seed in 0..3 {
        let found = told(&scene(seed, SOME, place, disc));
        assert!(found.moves() && found.leaving < 0.1, "{found:?}");
    }
}

#[test]
fn too_few_tracks_tell_nothing_and_those_of_a_part_do_not_speak_for_all() {
    let still = |_: DVec3, _: usize| DVec3::ZERO;
    let whole = scene(1, SOME, place, still);
    let queries = |scene: &mut Scene, change: &dyn Fn(&mut QueryTracks)| {
        let tracks = scene.tracks.as_mut().expect("tracks");
        tracks.queries.iter_mut().for_each(change);
    };
    let mut few = whole.clone();
    queries(&mut few, &|q: &mut QueryTracks| {
        q.samples.truncate(4 * FRAMES);
    });
    assert_eq!(track_motion(&few, NEAREST), None);
    let mut short = whole.clone();
    queries(&mut short, &|q: &mut QueryTracks| {
        let rows = q.samples.chunks_exact_mut(FRAMES);
        rows.for_each(|row| row[4..].iter_mut().for_each(|s| s.occlusion = 5.0));
    });
    assert_eq!(track_motion(&short, NEAREST), None);
    let mut without = whole.clone();
    without.tracks = None;
    assert_eq!(track_motion(&without, NEAREST), None);
    // The upper third of the mask alone has tracks.
    let mut part = whole.clone();
    queries(&mut part, &|q: &mut QueryTracks| {
        q.samples.truncate(q.samples.len() / 3);
    });
    let found = told(&part);
    assert!(!found.stands_still() && !found.moves(), "{found:?}");
    assert!(told(&whole).covered > 0.95);
}
