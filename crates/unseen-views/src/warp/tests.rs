use super::*;
use arbtest::arbitrary::{Result, Unstructured};
use glam::{DQuat, DVec3};
use property::property;

const KEEP_EDGES: WarpOptions = WarpOptions {
    sharpness: 50.0,
    edge_jump: f64::INFINITY,
};

/// A picture that owns its buffers.
struct Picture {
    camera: Camera,
    cam_from_world: DAffine3,
    color: Vec<f32>,
    depth: Vec<f32>,
    mask: Vec<f32>,
}

impl Picture {
    /// A picture at the world's origin; `pixel(x, y)` gives grey value and depth.
    fn new(camera: Camera, pixel: impl Fn(usize, usize) -> (f32, f32)) -> Self {
        let values: Vec<(f32, f32)> = (0..camera.num_pixels())
            .map(|p| pixel(p % camera.width, p / camera.width))
            .collect();
        Self {
            camera,
            cam_from_world: DAffine3::IDENTITY,
            color: values
                .iter()
                .flat_map(|&(grey, _)| [grey, 0.5 * grey, 1.0 - grey])
                .collect(),
            depth: values.iter().map(|&(_, depth)| depth).collect(),
            mask: values.iter().map(|&(grey, _)| 0.25 * grey).collect(),
        }
    }

    fn source(&self) -> Source<'_> {
        Source {
            camera: &self.camera,
            cam_from_world: &self.cam_from_world,
            color: &self.color,
            depth: &self.depth,
            mask: Some(&self.mask),
        }
    }

    fn to(&self, cam_from_world: &DAffine3, options: &WarpOptions) -> Warped {
        warp(&self.source(), &self.camera, cam_from_world, options).expect("good input")
    }
}

/// A camera with its principal point off the middle.
fn camera(width: usize, height: usize) -> Camera {
    Camera::pinhole(
        [width, height],
        [8.0, 8.5],
        [0.45 * width as f64, 0.6 * height as f64],
    )
}

/// The pose of a camera that looks along +z from `center`.
fn from(center: DVec3) -> DAffine3 {
    DAffine3::from_translation(-center)
}

fn grey(x: usize, y: usize) -> f32 {
    ((x * 37 + y * 61) % 101) as f32 / 101.0
}

fn number(u: &mut Unstructured<'_>, limit: f64) -> Result<f64> {
    Ok(f64::from(u.int_in_range(-1_000..=1_000)?) * 1e-3 * limit)
}

fn pose(u: &mut Unstructured<'_>, turn: f64, shift: f64) -> Result<DAffine3> {
    let mut vector = |limit| {
        Ok(DVec3::new(
            number(u, limit)?,
            number(u, limit)?,
            number(u, limit)?,
        ))
    };
    Ok(DAffine3::from_rotation_translation(
        DQuat::from_scaled_axis(vector(turn)?),
        vector(shift)?,
    ))
}

/// Any picture up to 9x9: depths from 0.5 to 20 with holes, no smoothness.
fn picture(u: &mut Unstructured<'_>) -> Result<Picture> {
    let camera = camera(u.int_in_range(1..=9)?, u.int_in_range(1..=9)?);
    let values = (0..camera.num_pixels())
        .map(|_| {
            let depth = if u.ratio(1, 8)? {
                *u.choose(&[0.0, f32::INFINITY])?
            } else {
                0.5 + 19.5 * f32::from(u.arbitrary::<u8>()?) / 255.0
            };
            Ok((f32::from(u.arbitrary::<u8>()?) / 255.0, depth))
        })
        .collect::<Result<Vec<(f32, f32)>>>()?;
    let width = camera.width;
    let mut picture = Picture::new(camera, |x, y| values[y * width + x]);
    picture.cam_from_world = pose(u, 3.0, 10.0)?;
    Ok(picture)
}

#[test]
fn at_the_same_pose_the_picture_comes_back() {
    property("at_the_same_pose_the_picture_comes_back", 500, |u| {
        let picture = picture(u)?;
        let warped = picture.to(&picture.cam_from_world, &KEEP_EDGES);
        let mask = warped.mask.as_ref().expect("a mask went in");
        for pixel in 0..picture.camera.num_pixels() {
            let depth = picture.depth[pixel];
            let valid = has_depth(depth);
            assert_eq!(warped.valid[pixel], valid, "validity of pixel {pixel}");
            let expected = |v: f32| if valid { v } else { 0.0 };
            for c in 0..3 {
                let (is, was) = (warped.color[3 * pixel + c], picture.color[3 * pixel + c]);
                assert_eq!(is, expected(was), "colour of pixel {pixel}");
            }
            assert_eq!(mask[pixel], expected(picture.mask[pixel]), "mask");
            let error = (warped.depth[pixel] - expected(depth)).abs();
            assert!(error <= 1e-6 * depth, "depth of pixel {pixel}: {error}");
        }
        Ok(())
    });
}

#[test]
fn pixels_on_a_depth_edge_leave_a_gap_and_their_neighbours_stay() {
    // Jumps of 4 % are kept, of 6 % are not: both sides of the jump go.
    let picture = Picture::new(camera(7, 3), |x, y| {
        (grey(x, y), [1.0, 1.04, 1.04, 1.11, 1.11, 0.0, 5.0][x])
    });
    let warped = picture.to(&picture.cam_from_world, &WarpOptions::default());
    for (x, valid) in [true, true, false, false, true, false, true]
        .into_iter()
        .enumerate()
    {
        for y in 0..3 {
            assert_eq!(warped.valid[7 * y + x], valid, "pixel ({x}, {y})");
        }
    }
    assert!(
        (warped.valid_fraction() - 4.0 / 7.0).abs() < 1e-12,
        "valid fraction {}",
        warped.valid_fraction()
    );
}

#[test]
fn a_plane_moves_by_its_disparity() {
    let (width, height, depth) = (16, 4, 2.0);
    for disparity in [0.0, 3.0, 2.25, -1.5] {
        let picture = Picture::new(camera(width, height), |x, y| (grey(x, y), depth as f32));
        // A camera that moves right sees the world move left.
        let shift = disparity * depth / picture.camera.fx;
        let warped = picture.to(&from(DVec3::new(shift, 0.0, 0.0)), &WarpOptions::default());
        let whole = disparity.floor();
        let part = disparity - whole;
        for y in 0..height {
            for x in 0..width {
                // Between these two source pixels; outside the picture there is nothing.
                let at = |step: f64| {
                    let from = x as f64 + whole + step;
                    (from >= 0.0 && from < width as f64).then(|| f64::from(grey(from as usize, y)))
                };
                let parts = [(at(0.0), 1.0 - part), (at(1.0), part)];
                let (mut sum, mut weight) = (0.0, 0.0);
                for (value, share) in parts {
                    if let (Some(value), true) = (value, share > 0.0) {
                        sum += share * value;
                        weight += share;
                    }
                }
                let pixel = y * width + x;
                assert_eq!(
                    warped.valid[pixel],
                    weight > 0.0,
                    "({x}, {y}) by {disparity}"
                );
                if weight > 0.0 {
                    let error = (f64::from(warped.color[3 * pixel]) - sum / weight).abs();
                    assert!(error < 1e-6, "({x}, {y}) by {disparity} is off by {error}");
                    assert_eq!(warped.depth[pixel], 2.0, "depth at ({x}, {y})");
                }
            }
        }
    }
}

/// A near plane (white, z = 2) over the columns `near` in front of a far one (black, z = 8).
fn two_planes(width: usize, near: std::ops::Range<usize>) -> Picture {
    Picture::new(camera(width, 3), |x, _| {
        if near.contains(&x) {
            (1.0, 2.0)
        } else {
            (0.0, 8.0)
        }
    })
}

#[test]
fn the_nearer_plane_hides_the_farther_and_uncovers_what_no_one_saw() {
    // A step of 1 to the right: near moves left by 4 px, far by 1 px.
    let picture = two_planes(24, 10..16);
    let warped = picture.to(&from(DVec3::X), &KEEP_EDGES);
    for x in 0..24 {
        let (grey, valid) = (warped.color[3 * x], warped.valid[x]);
        match x {
            0..=5 => assert!(valid && grey == 0.0, "far at column {x}: {grey}"),
            // Far columns 7 to 9 land here too.
            6..=11 => assert!(valid && grey > 0.9999, "near at column {x}: {grey}"),
            12..=14 | 23 => assert!(!valid, "no one saw column {x}"),
            _ => assert!(valid && grey == 0.0, "far at column {x}: {grey}"),
        }
    }
}

#[test]
fn who_wins_depends_on_neither_order_nor_a_far_outlier() {
    // From the left the near plane comes first in row order, from the right last.
    for (step, near) in [(DVec3::X, 10..16), (DVec3::NEG_X, 4..10)] {
        let mut picture = two_planes(24, near.clone());
        picture.depth[23] = 1e6;
        let warped = picture.to(&from(step), &KEEP_EDGES);
        let moved = if step.x > 0.0 { 6..12 } else { 8..14 };
        for x in moved {
            let grey = warped.color[3 * x];
            assert!(grey > 0.999, "step {step}: column {x} is {grey}");
        }
    }
}

#[test]
fn points_behind_the_camera_are_dropped() {
    let picture = two_planes(8, 2..3);
    let about = DAffine3::from_rotation_y(std::f64::consts::PI);
    let warped = picture.to(&about, &KEEP_EDGES);
    assert_eq!(warped.valid_fraction(), 0.0, "the camera looks away");
    assert!(
        warped.color.iter().chain(&warped.depth).all(|&v| v == 0.0),
        "what is not valid is 0"
    );
    // Between the planes only the far one is in front; at the near plane's depth, too.
    for z in [5.0, 2.0, 2.0 - 0.5 * picture.camera.near] {
        let warped = picture.to(&from(DVec3::new(0.0, 0.0, z)), &KEEP_EDGES);
        assert!(warped.valid_fraction() > 0.0, "the far plane is in front");
        for (pixel, &valid) in warped.valid.iter().enumerate() {
            assert!(
                !valid || warped.color[3 * pixel] == 0.0,
                "from z = {z} pixel {pixel} sees what is behind"
            );
        }
    }
}

#[test]
fn what_comes_out_lies_between_what_went_in() {
    property("what_comes_out_lies_between_what_went_in", 500, |u| {
        let picture = picture(u)?;
        let target = camera(u.int_in_range(1..=12)?, u.int_in_range(1..=12)?);
        let pose = pose(u, 0.5, 3.0)? * picture.cam_from_world;
        let options = WarpOptions {
            sharpness: *u.choose(&[0.0, 1.0, 50.0, 1e12])?,
            edge_jump: *u.choose(&[0.0, 0.05, 1.0, f64::INFINITY])?,
        };
        let warped = warp(&picture.source(), &target, &pose, &options).expect("good input");
        let mask = warped.mask.as_ref().expect("a mask went in");
        assert_eq!(warped.color.len(), 3 * target.num_pixels(), "colour's size");
        for pixel in 0..target.num_pixels() {
            let color = &warped.color[3 * pixel..3 * pixel + 3];
            let depth = warped.depth[pixel];
            if warped.valid[pixel] {
                assert!(color.iter().all(|v| (0.0..=1.0).contains(v)), "{color:?}");
                assert!((0.0..=0.25).contains(&mask[pixel]), "{}", mask[pixel]);
                assert!(
                    f64::from(depth) >= target.near && depth.is_finite(),
                    "{depth}"
                );
            } else {
                assert_eq!(color, [0.0; 3], "colour without a point");
                assert_eq!((depth, mask[pixel]), (0.0, 0.0), "depth and mask");
            }
        }
        Ok(())
    });
}

#[test]
fn the_unit_of_length_does_not_matter() {
    let (mut compared, mut other_valid) = (0, 0);
    property("the_unit_of_length_does_not_matter", 500, |u| {
        let picture = picture(u)?;
        let step = pose(u, 0.3, 1.0)?;
        let scale: f64 = *u.choose(&[0.001, 0.5, 300.0])?;
        let scaled = |pose: &DAffine3| {
            DAffine3::from_mat3_translation(pose.matrix3, pose.translation * scale)
        };
        let larger = Picture {
            camera: picture
                .camera
                .clone()
                .with_near(picture.camera.near * scale),
            cam_from_world: scaled(&picture.cam_from_world),
            color: picture.color.clone(),
            depth: picture.depth.iter().map(|&z| z * scale as f32).collect(),
            mask: picture.mask.clone(),
        };
        let target = step * picture.cam_from_world;
        let one = picture.to(&target, &KEEP_EDGES);
        let other = larger.to(&scaled(&target), &KEEP_EDGES);
        let masks = [&one, &other].map(|warped| warped.mask.as_ref().expect("a mask went in"));
        for (pixel, (&a, &b)) in one.valid.iter().zip(&other.valid).enumerate() {
            if a != b {
                other_valid += 1;
                continue;
            }
            compared += usize::from(a);
            for c in 3 * pixel..3 * pixel + 3 {
                let error = (one.color[c] - other.color[c]).abs();
                assert!(error < 1e-4, "colour {c} differs by {error}");
            }
            let error = (masks[0][pixel] - masks[1][pixel]).abs();
            assert!(error < 1e-4, "mask of pixel {pixel} differs by {error}");
            let expected = f64::from(one.depth[pixel]);
            let found = f64::from(other.depth[pixel]) / scale;
            assert!(
                (found - expected).abs() <= 1e-4 * expected,
                "depth of pixel {pixel}: {found} in the place of {expected}"
            );
        }
        Ok(())
    });
    assert!(compared > 5000, "only {compared} pixels were compared");
    // A point on the border of a share's cut-off may fall on either side.
    assert!(
        1000 * other_valid < compared,
        "of {compared} pixels and {other_valid} more it depends whether they are valid"
    );
}

#[test]
fn a_picture_of_one_pixel_and_a_target_of_another_size() {
    let one = Picture::new(Camera::pinhole([1, 1], [1.0, 1.0], [0.5, 0.5]), |_, _| {
        (0.75, 3.0)
    });
    let warped = one.to(&DAffine3::IDENTITY, &WarpOptions::default());
    assert_eq!(warped.color, one.color, "the pixel itself");
    assert_eq!(warped.valid_fraction(), 1.0, "the pixel itself");

    // Halving the target maps pixel (1, 1) of 4 by 4, centre (1.5, 1.5), to (0.75, 0.75).
    let square = |size: usize| {
        let size_px = size as f64;
        Camera::pinhole(
            [size, size],
            [size_px, size_px],
            [0.5 * size_px, 0.5 * size_px],
        )
    };
    let picture = Picture::new(square(4), |x, _| (x as f32 / 4.0, 2.0));
    let half = warp(
        &picture.source(),
        &square(2),
        &DAffine3::IDENTITY,
        &WarpOptions::default(),
    )
    .expect("good input");
    assert_eq!(half.valid_fraction(), 1.0, "every pixel is hit");
    // Column 0 gets source columns 0, 1 (3/4 each) and 2 (1/4): (0 + 3 + 2 * 1) / 7 of 1/4.
    assert!(
        (half.color[0] - 5.0 / 28.0).abs() < 1e-6,
        "column 0 is {}",
        half.color[0]
    );
}

#[test]
fn nothing_to_splat_is_no_error() {
    let picture = Picture::new(camera(3, 2), |x, y| (grey(x, y), 0.0));
    let warped = picture.to(&DAffine3::IDENTITY, &WarpOptions::default());
    assert_eq!(warped.valid, [false; 6], "no depth anywhere");
    let mut source = picture.source();
    source.mask = None;
    let warped = warp(
        &source,
        &picture.camera,
        &DAffine3::IDENTITY,
        &WarpOptions::default(),
    )
    .expect("good input");
    assert_eq!(warped.mask, None, "no mask went in");
}

#[test]
fn an_extreme_pose_gives_no_number_that_is_not_finite() {
    let picture = two_planes(8, 2..5);
    for z in [-1e30, -1e60, -1e300, 1e300] {
        let warped = picture.to(&from(DVec3::new(z, z, z)), &KEEP_EDGES);
        assert!(
            warped
                .color
                .iter()
                .chain(&warped.depth)
                .all(|v| v.is_finite()),
            "from {z}"
        );
    }
}

/// The error of a warp whose inputs `spoil` has changed.
fn error_of(
    spoil: impl Fn(&mut Picture, &mut Camera, &mut DAffine3, &mut WarpOptions),
) -> WarpError {
    let mut picture = two_planes(4, 1..2);
    let (mut target, mut pose) = (camera(4, 3), DAffine3::IDENTITY);
    let mut options = WarpOptions::default();
    spoil(&mut picture, &mut target, &mut pose, &mut options);
    warp(&picture.source(), &target, &pose, &options).expect_err("spoilt input")
}

#[test]
fn a_value_that_is_not_a_number_is_named_with_its_pixel() {
    let messages = [
        error_of(|p, _, _, _| p.color[3 * 6 + 1] = f32::NAN),
        error_of(|p, _, _, _| p.color[0] = f32::INFINITY),
        error_of(|p, _, _, _| p.depth[7] = f32::NAN),
        error_of(|p, _, _, _| p.depth[7] = -1.0),
        error_of(|p, _, _, _| p.mask[11] = f32::NAN),
    ]
    .map(|error| error.to_string());
    let expected = [
        "color at pixel (2, 1) is NaN; it must be finite",
        "color at pixel (0, 0) is inf; it must be finite",
        "depth at pixel (3, 1) is NaN; it must be 0 or more, where 0 and infinity mean missing",
        "depth at pixel (3, 1) is -1; it must be 0 or more, where 0 and infinity mean missing",
        "mask at pixel (3, 2) is NaN; it must be finite",
    ];
    assert_eq!(messages, expected, "messages");
}

#[test]
fn wrong_sizes_cameras_poses_and_options_are_errors() {
    let short = error_of(|p, _, _, _| p.mask.truncate(5));
    assert_eq!(
        short.to_string(),
        "mask has 5 values, but the source camera of 4x3 pixels needs 12",
        "message"
    );
    let camera_faults: [fn(&mut Camera); 7] = [
        |c| c.width = 0,
        |c| c.height = usize::MAX,
        |c| (c.width, c.height) = (1 << 20, 1 << 20),
        |c| c.fx = 0.0,
        |c| c.fy = f64::NAN,
        |c| c.cx = f64::INFINITY,
        |c| c.near = -1.0,
    ];
    for (index, spoil) in camera_faults.into_iter().enumerate() {
        for which in ["source", "target"] {
            let error = error_of(|picture, target, _, _| {
                spoil(if which == "source" {
                    &mut picture.camera
                } else {
                    target
                });
            });
            assert!(
                matches!(error, WarpError::Camera { which: w, .. } if w == which),
                "fault {index} of the {which} camera gave: {error}"
            );
        }
    }
    for (which, error) in [
        (
            "source",
            error_of(|p, _, _, _| p.cam_from_world.translation.x = f64::NAN),
        ),
        (
            "target",
            error_of(|_, _, pose, _| pose.matrix3.x_axis.y = f64::NAN),
        ),
        (
            "target",
            error_of(|_, _, pose, _| pose.matrix3 = glam::DMat3::ZERO),
        ),
    ] {
        assert_eq!(error, WarpError::Pose { which }, "pose");
    }
    for (expected, error) in [
        ("sharpness", error_of(|_, _, _, o| o.sharpness = -1.0)),
        (
            "sharpness",
            error_of(|_, _, _, o| o.sharpness = f64::INFINITY),
        ),
        ("edge_jump", error_of(|_, _, _, o| o.edge_jump = f64::NAN)),
    ] {
        assert!(
            matches!(error, WarpError::Option { name, .. } if name == expected),
            "{expected}: {error}"
        );
    }
}
