//! Poses and warp together, against a scene whose every view is known in closed form.

use glam::{DAffine3, DQuat, DVec2, DVec3};
use io::{LoadOptions, Scene};
use limpid_tests::largest;
use splat_core::{Camera, camera_center};
use std::path::Path;
use unseen_views::{
    Source, WarpOptions, Warped, depth_edges, parallel_pose, perpendicular_pose, warp,
};

/// A smoothly textured, slanted wall with a ball in front of it.
const WALL: (DVec3, f64) = (DVec3::new(0.1, -0.05, -1.0), -5.0);
const BALL: (DVec3, f64) = (DVec3::new(0.2, 0.1, 3.0), 0.6);

/// Where a ray first hits the scene, as a multiple of its direction, and whether that is the ball.
fn hit(origin: DVec3, direction: DVec3) -> (f64, bool) {
    let (center, radius) = BALL;
    let to_center = center - origin;
    let along = to_center.dot(direction) / direction.length_squared();
    let aside = (to_center - direction * along).length_squared();
    if aside < radius * radius {
        let half = ((radius * radius - aside) / direction.length_squared()).sqrt();
        return (along - half, true);
    }
    let (normal, offset) = WALL;
    ((offset - normal.dot(origin)) / normal.dot(direction), false)
}

/// A texture that varies slowly against a pixel, so that bilinear shares cost little.
fn texture(p: DVec3, ball: bool) -> DVec3 {
    let phase = if ball { 2.0 } else { 0.0 };
    DVec3::new(
        (3.0 * p.x + 2.0 * p.y + phase).sin(),
        (2.5 * p.y - 1.5 * p.x + phase).cos(),
        (2.0 * p.x + 2.0 * p.z - phase).sin(),
    ) * 0.5
        + 0.5
}

struct View {
    color: Vec<f32>,
    depth: Vec<f32>,
    ball: Vec<f32>,
}

fn camera() -> Camera {
    Camera::pinhole([96, 64], [80.0, 82.0], [47.0, 33.5])
}

fn look(camera: &Camera, cam_from_world: &DAffine3) -> View {
    let world_from_cam = cam_from_world.inverse();
    let mut view = View {
        color: Vec::new(),
        depth: Vec::new(),
        ball: Vec::new(),
    };
    for pixel in 0..camera.num_pixels() {
        let (x, y) = (pixel % camera.width, pixel / camera.width);
        let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        let ray = world_from_cam.transform_vector3(camera.unproject(at, 1.0));
        let origin = world_from_cam.translation;
        let (depth, ball) = hit(origin, ray);
        let color = texture(origin + ray * depth, ball);
        view.color.extend(color.as_vec3().to_array());
        view.depth.push(depth as f32);
        view.ball.push(if ball { 1.0 } else { 0.0 });
    }
    view
}

fn path(step: f64) -> DAffine3 {
    let center = DVec3::new(0.15 * step, 0.02 * step, 0.03 * step);
    DAffine3::from_rotation_translation(DQuat::from_rotation_y(-0.02 * step), center).inverse()
}

fn warp_from(camera: &Camera, from: &DAffine3, to: &DAffine3) -> Warped {
    let view = look(camera, from);
    let source = Source {
        camera,
        cam_from_world: from,
        color: &view.color,
        depth: &view.depth,
        mask: Some(&view.ball),
    };
    warp(&source, camera, to, &WarpOptions::default()).expect("good input")
}

/// Checks a warped view against the truth, over valid pixels of which all neighbours agree on what
/// they show; beside a silhouette a bilinear share may reach over it.
///
/// A pixel at the rim of a hole is a source pixel up to one pixel aside, which is 0.12 of colour here.
/// On average a shift by half a pixel would cost 0.03.
fn compare(camera: &Camera, warped: &Warped, to: &DAffine3) {
    let truth = look(camera, to);
    let mask = warped.mask.as_ref().expect("a mask went in");
    let (mut color_errors, mut depth_errors) = (Vec::new(), Vec::new());
    for y in 1..camera.height - 1 {
        for x in 1..camera.width - 1 {
            let pixel = y * camera.width + x;
            let around = (0..9).map(|k| pixel + (k / 3) * camera.width + k % 3 - camera.width - 1);
            let mut around = around.map(|p| truth.ball[p]);
            if !warped.valid[pixel] || around.any(|ball| ball != truth.ball[pixel]) {
                continue;
            }
            assert!(
                (mask[pixel] - truth.ball[pixel]).abs() < 1e-3,
                "mask at ({x}, {y}) is {}",
                mask[pixel]
            );
            for c in 0..3 {
                let error = (warped.color[3 * pixel + c] - truth.color[3 * pixel + c]).abs();
                color_errors.push(f64::from(error));
            }
            let relative = warped.depth[pixel] / truth.depth[pixel] - 1.0;
            depth_errors.push(f64::from(relative));
        }
    }
    // Nothing but silhouettes, holes and the border is left out.
    let compared = depth_errors.len() as f64 / warped.valid.len() as f64;
    assert!(compared > 0.4, "{compared} of all pixels");
    let mean = color_errors.iter().sum::<f64>() / color_errors.len() as f64;
    let (color_error, depth_error) = (largest(color_errors), largest(depth_errors));
    assert!(
        mean < 0.005 && color_error < 0.12 && depth_error < 0.03,
        "colour is off by {mean} (mean) and {color_error} (most), depth by {depth_error}"
    );
}

#[test]
fn a_view_half_way_between_two_frames_is_what_a_camera_there_would_see() {
    let camera = camera();
    let (a, b) = (path(0.0), path(1.0));
    let middle = parallel_pose(&a, &b).expect("neighbours have a middle");
    for from in [a, b] {
        let warped = warp_from(&camera, &from, &middle);
        assert!(
            warped.valid_fraction() > 0.85,
            "only {} valid",
            warped.valid_fraction()
        );
        compare(&camera, &warped, &middle);
    }
}

#[test]
fn a_view_beside_the_path_is_what_a_camera_there_would_see() {
    let camera = camera();
    let (a, b) = (path(2.0), path(3.0));
    // 5 % of the scene's depth of about 5, both ways.
    for offset in [0.25, -0.25] {
        let beside = perpendicular_pose(&a, &b, offset);
        let step = camera_center(&beside) - camera_center(&a);
        assert!(step.y * offset > 0.0, "moved by {step}");
        let warped = warp_from(&camera, &a, &beside);
        assert!(
            warped.valid_fraction() > 0.6,
            "only {} valid",
            warped.valid_fraction()
        );
        compare(&camera, &warped, &beside);
    }
}

/// At a quarter of the demo's size, the floor's depth changes by more than 5 % from each row to the next.
#[test]
fn the_demo_keeps_its_floor_at_every_size() {
    let demo = Path::new(env!("CARGO_MANIFEST_DIR")).join("../demo");
    for downscale in [1, 2, 4] {
        let options = LoadOptions {
            downscale,
            ..LoadOptions::default()
        };
        let scene = Scene::open_with(&demo, &options).expect("the demo");
        let (mut floor, mut on_edge) = (0, 0);
        for pair in scene.frames.windows(2) {
            let [a, b] = [&pair[0].view, &pair[1].view];
            let depth = pair[0].depth.as_ref().expect("depth");
            let mask = pair[0].mask.as_ref().expect("a mask");
            let edges = depth_edges(&depth.values, depth.width, 0.05);
            // The lowest rows show nothing but the floor and movers.
            for i in depth.width * (depth.height * 7 / 8)..edges.len() {
                floor += u32::from(mask.values[i] == 0.0);
                on_edge += u32::from(mask.values[i] == 0.0 && edges[i]);
            }
            let source = Source {
                camera: &a.camera,
                cam_from_world: &a.cam_from_world,
                color: &a.image.pixels,
                depth: &depth.values,
                mask: None,
            };
            let middle = parallel_pose(&a.cam_from_world, &b.cam_from_world).expect("a middle");
            let warped = warp(&source, &a.camera, &middle, &WarpOptions::default());
            let valid = warped.expect("good input").valid_fraction();
            assert!(valid > 0.75, "1/{downscale}, {}: {valid} valid", a.name);
        }
        // Between a mover and the picture's border the floor is too narrow to show its slope.
        assert!(
            5 * on_edge < floor,
            "1/{downscale}: {on_edge} of {floor} pixels of the floor are on an edge"
        );
    }
}
