use super::*;
use arbtest::arbitrary::{Result, Unstructured};
use glam::DVec2;
use property::{property, uniform};
use splat_core::Camera;

/// A picture's disparity, 0 where missing.
#[derive(Clone, Debug)]
struct Picture {
    width: usize,
    height: usize,
    disparity: Vec<f64>,
}

impl Picture {
    fn new(width: usize, height: usize, disparity: impl Fn(usize, usize) -> f64) -> Self {
        let pixels = 0..width * height;
        Self {
            width,
            height,
            disparity: pixels.map(|i| disparity(i % width, i / width)).collect(),
        }
    }

    fn depth(&self) -> Vec<f32> {
        self.disparity
            .iter()
            .map(|&d| if d > 0.0 { d.recip() as f32 } else { 0.0 })
            .collect()
    }

    fn edges(&self, edge: f64) -> Vec<bool> {
        depth_edges(&self.depth(), self.width, edge)
    }

    /// Both pixels of each pair of direct neighbours whose depths differ by more than `edge`, relatively.
    fn steps(&self, edge: f64) -> Vec<bool> {
        let (w, h) = (self.width, self.height);
        let depth = self.depth();
        let mut on_edge = vec![false; w * h];
        for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
            for (p, q) in [(x + 1, y), (x, y + 1)] {
                if p < w && q < h {
                    let (i, j) = (y * w + x, q * w + p);
                    let (a, b) = (f64::from(depth[i]), f64::from(depth[j]));
                    if a > 0.0 && b > 0.0 && (a - b).abs() > edge * a.min(b) {
                        on_edge[i] = true;
                        on_edge[j] = true;
                    }
                }
            }
        }
        on_edge
    }
}

fn count(on_edge: &[bool]) -> usize {
    on_edge.iter().filter(|&&on_edge| on_edge).count()
}

/// A plane seen by a pinhole of any focal length, slanted up to where its horizon touches a corner.
fn plane(u: &mut Unstructured<'_>) -> Result<Picture> {
    let (width, height) = (u.int_in_range(6..=40)?, u.int_in_range(6..=40)?);
    let size = DVec2::new(width as f64, height as f64);
    let focal = size.x * uniform(u, 0.2, 4.0)?;
    let middle = size * DVec2::new(uniform(u, 0.0, 1.0)?, uniform(u, 0.0, 1.0)?);
    let camera = Camera::pinhole([width, height], [focal, 1.1 * focal], [middle.x, middle.y]);
    let ray =
        |x: usize, y: usize| camera.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5), 1.0);
    let tilt = DVec2::from_angle(uniform(u, 0.0, std::f64::consts::TAU)?);
    let corners = [
        (0, 0),
        (width - 1, 0),
        (0, height - 1),
        (width - 1, height - 1),
    ];
    let along = |(x, y): (usize, usize)| tilt.dot(ray(x, y).truncate());
    let lowest = corners.map(along).into_iter().fold(0.0, f64::min);
    let horizon = if lowest < 0.0 { -lowest.recip() } else { 100.0 };
    let slant = horizon * (1.0 - uniform(u, 0.03, 1.0)?.powi(2));
    let (normal, distance) = ((slant * tilt).extend(1.0), uniform(u, 0.1, 100.0)?);
    // normal · point = distance, point = z · ray.
    Ok(Picture::new(width, height, |x, y| {
        normal.dot(ray(x, y)) / distance
    }))
}

/// Any picture up to 12x12, with holes, no smoothness.
fn any(u: &mut Unstructured<'_>) -> Result<Picture> {
    let (width, height) = (u.int_in_range(1..=12)?, u.int_in_range(1..=12)?);
    values(u, width, height)
}

fn values(u: &mut Unstructured<'_>, width: usize, height: usize) -> Result<Picture> {
    let mut values = Vec::new();
    for _ in 0..width * height {
        let missing = u.ratio(1, 8)?;
        values.push(if missing { 0.0 } else { uniform(u, 0.1, 0.5)? });
    }
    Ok(Picture::new(width, height, |x, y| values[y * width + x]))
}

/// A picture whose pixels are the mean disparity of blocks of another, as a loader shrinks depth.
fn shrunk(width: usize, height: usize, size: usize, full: impl Fn(usize, usize) -> f64) -> Picture {
    Picture::new(width, height, |x, y| {
        let block = (0..size * size).map(|i| full(x * size + i % size, y * size + i / size));
        block.sum::<f64>() / (size * size) as f64
    })
}

#[test]
fn a_plane_has_no_edge_however_slanted() {
    let mut steep = 0;
    property("a_plane_has_no_edge_however_slanted", 500, |u| {
        let plane = plane(u)?;
        steep += count(&plane.steps(0.05));
        assert_eq!(count(&plane.edges(0.001)), 0, "{plane:?}");
        Ok(())
    });
    assert!(steep > 10_000, "the ratio alone marks {steep} pixels");
}

#[test]
fn where_two_planes_meet_is_no_edge() {
    let mut steep = 0;
    property("where_two_planes_meet_is_no_edge", 500, |u| {
        // A ridge or a valley between rows, from which each plane is seen for five pixels or more.
        let (width, height) = (u.int_in_range(6..=9)?, u.int_in_range(12..=30)?);
        let meet = uniform(u, 4.0, height as f64 - 5.0)?;
        let (above, below) = (uniform(u, -1.0, 1.0)?, uniform(u, -1.0, 1.0)?);
        let across = uniform(u, -0.1, 0.1)?;
        let roof = |x: usize, y: usize| {
            let past = y as f64 - meet;
            across * x as f64 + past * if past < 0.0 { above } else { below }
        };
        let roof = Picture::new(width, height, roof);
        let farthest = roof.disparity.iter().copied().fold(0.0, f64::min);
        let shift = uniform(u, 0.01, 1.0)? - farthest;
        let roof = Picture::new(width, height, |x, y| shift + roof.disparity[y * width + x]);
        steep += count(&roof.steps(0.05));
        assert_eq!(count(&roof.edges(0.001)), 0, "{roof:?}");
        Ok(())
    });
    assert!(steep > 10_000, "the ratio alone marks {steep} pixels");
}

#[test]
fn between_surfaces_that_face_the_camera_the_ratio_of_depths_decides() {
    let mut marked = 0;
    property(
        "between_surfaces_that_face_the_camera_the_ratio_of_depths_decides",
        500,
        |u| {
            // Patches of two pixels or more, some of them without depth.
            let (columns, rows) = (u.int_in_range(1..=5)?, u.int_in_range(1..=5)?);
            let patches = values(u, columns, rows)?;
            let size = u.int_in_range(2..=5)?;
            let picture = Picture::new(columns * size, rows * size, |x, y| {
                patches.disparity[y / size * columns + x / size]
            });
            let edge = uniform(u, 0.0, 2.0)?;
            let on_edge = picture.edges(edge);
            assert_eq!(on_edge, picture.steps(edge), "{edge} in {picture:?}");
            marked += count(&on_edge);
            Ok(())
        },
    );
    assert!(marked > 1000, "{marked} pixels were on an edge");
}

#[test]
fn an_edge_smeared_over_some_pixels_stays_one() {
    property("an_edge_smeared_over_some_pixels_stays_one", 500, |u| {
        // Each of its steps is one of 6 % or more; the surfaces beside it are as small as can be.
        let between = u.int_in_range(0..=2)?;
        let mut profile = vec![uniform(u, 0.01, 1.0)?; 2];
        for _ in 0..=between {
            profile.push(profile[profile.len() - 1] * uniform(u, 1.06, 2.0)?);
        }
        profile.push(profile[profile.len() - 1]);
        let end = profile.len() - 1;
        for length in [profile.len(), profile.len() + 5] {
            let row = Picture::new(length, 1, |x, _| profile[x.min(end)]);
            // Two pixels, one mixed pixel alone, or two mixed ones and their neighbours.
            let expected = [1..3, 2..3, 1..5][between].clone();
            let expected: Vec<bool> = (0..length).map(|x| expected.contains(&x)).collect();
            assert_eq!(row.edges(0.05), expected, "{row:?}");
        }
        Ok(())
    });
}

#[test]
fn every_mixed_pixel_of_a_shrunk_edge_is_on_it() {
    let (mut marked, mut differing) = (0, 0);
    property("every_mixed_pixel_of_a_shrunk_edge_is_on_it", 500, |u| {
        // A half-plane of any direction in front of a wall, at a fraction of its size.
        let (width, height, size) = (16, 12, u.int_in_range(2..=6)?);
        let (far, near) = (0.2, 0.2 * uniform(u, 1.5, 5.0)?);
        let normal = DVec2::from_angle(uniform(u, 0.0, std::f64::consts::TAU)?);
        let middle = DVec2::new(width as f64, height as f64) * 0.5 * size as f64;
        let full = |x: usize, y: usize| {
            let at = DVec2::new(x as f64, y as f64) + 0.5;
            if normal.dot(at - middle) > 0.0 {
                near
            } else {
                far
            }
        };
        let picture = shrunk(width, height, size, full);
        let on_edge = picture.edges(0.05);
        for (i, (&d, &is)) in picture.disparity.iter().zip(&on_edge).enumerate() {
            // Mixed by so much that both surfaces are more than 5 % off.
            let mixed = d > 1.051 * far && near > 1.051 * d;
            assert!(is || !mixed, "pixel {i} of {picture:?} is mixed");
        }
        marked += count(&on_edge);
        differing += count(&picture.steps(0.05));
        Ok(())
    });
    // Their neighbours are mostly not.
    assert!(4 * marked < 3 * differing, "{marked} of {differing}");
}

#[test]
fn a_step_counts_beyond_its_surface_s_slope() {
    // Disparity grows by 1 a pixel, and by 2 between two of them, where it is 10: the jump is 1 of 10,
    // though the depths differ by 2 of 10.
    let row = Picture::new(12, 1, |x, _| {
        let x = x as f64;
        5.0 + x + if x > 5.0 { 1.0 } else { 0.0 }
    });
    let pair: Vec<bool> = (0..12).map(|x| x == 5 || x == 6).collect();
    assert_eq!(row.edges(0.09), pair);
    assert_eq!(count(&row.edges(0.11)), 0);
    assert!(count(&row.steps(0.11)) > 2, "the ratio alone");
}

#[test]
fn a_pole_in_front_of_a_slanted_plane_is_an_edge() {
    property("a_pole_in_front_of_a_slanted_plane_is_an_edge", 500, |u| {
        let mut picture = plane(u)?;
        let nearest = picture.disparity.iter().copied().fold(0.0, f64::max);
        let near = nearest * uniform(u, 1.5, 5.0)?;
        let (w, h) = (picture.width, picture.height);
        let column = u.int_in_range(1..=w - 2)?;
        for y in 0..h {
            picture.disparity[y * w + column] = near;
        }
        let on_edge = picture.edges(0.05);
        for i in 0..w * h {
            let expected = (i % w).abs_diff(column) <= 1;
            // A plane cut off less than five pixels before the picture's border has no slope of its own.
            let cut_off = (i % w < column && column < 5) || (i % w > column && column + 5 >= w);
            assert!(
                on_edge[i] == expected || cut_off && on_edge[i],
                "pixel {i} of {picture:?}"
            );
        }
        Ok(())
    });
}

#[test]
fn one_percent_of_noise_marks_hardly_a_pixel_of_a_plane() {
    let (mut marked, mut pixels) = (0, 0);
    property(
        "one_percent_of_noise_marks_hardly_a_pixel_of_a_plane",
        500,
        |u| {
            let mut picture = plane(u)?;
            if count(&picture.steps(0.25)) > 0 {
                // So near its horizon, neighbours' noise is no percent of the farther one's disparity.
                return Ok(());
            }
            for disparity in &mut picture.disparity {
                // Nearly normal, of deviation 1: a sum of four uniform numbers.
                let mut noise = 0.0;
                for _ in 0..4 {
                    noise += 3.0_f64.sqrt() * (f64::from(u.arbitrary::<u8>()?) / 255.0 - 0.5);
                }
                *disparity *= 1.0 + 0.01 * noise;
            }
            marked += count(&picture.edges(0.05));
            pixels += picture.disparity.len();
            Ok(())
        },
    );
    let share = marked as f64 / pixels as f64;
    assert!(pixels > 10_000 && share < 0.01, "{share} of {pixels}");
}

#[test]
fn neither_unit_nor_mirror_nor_turn_matters_and_less_is_marked_than_by_the_ratio() {
    property(
        "neither_unit_nor_mirror_nor_turn_matters_and_less_is_marked_than_by_the_ratio",
        500,
        |u| {
            let picture = any(u)?;
            let (w, h) = (picture.width, picture.height);
            let edge = uniform(u, 0.0, 1.0)?;
            let on_edge = picture.edges(edge);
            // Powers of two, and so not a bit is lost.
            for scale in [2.0_f64.powi(-20), 2.0_f64.powi(20)] {
                let scaled = Picture::new(w, h, |x, y| scale * picture.disparity[y * w + x]);
                assert_eq!(scaled.edges(edge), on_edge, "{scale} times {picture:?}");
            }
            let mirrored = Picture::new(w, h, |x, y| picture.disparity[y * w + w - 1 - x]);
            let turned = Picture::new(h, w, |x, y| picture.disparity[x * w + y]);
            let (mirrored, turned) = (mirrored.edges(edge), turned.edges(edge));
            let ratio = picture.steps(edge);
            for (i, &is) in on_edge.iter().enumerate() {
                let (x, y) = (i % w, i / w);
                assert_eq!(
                    mirrored[y * w + w - 1 - x],
                    is,
                    "mirror, {i} of {picture:?}"
                );
                assert_eq!(turned[x * h + y], is, "turn, {i} of {picture:?}");
                assert!(!is || ratio[i], "the ratio, {i} of {picture:?}");
            }
            Ok(())
        },
    );
}

/// What a pixel of a room shows: its disparity, and whether that is the box.
fn room(at: DVec2) -> (f64, bool) {
    // At full size: 128x96, focal length 112, horizon 32 rows from the top. The floor is 1 below the
    // camera, the wall 8 before it, the box stands 3 before it.
    let ray = (at - DVec2::new(64.0, 32.0)) / 112.0;
    let on_box = ray * 3.0;
    if on_box.x.abs() < 0.5 && (-0.3..1.0).contains(&on_box.y) {
        (1.0 / 3.0, true)
    } else {
        (ray.y.max(1.0 / 8.0), false)
    }
}

#[test]
fn a_room_has_the_same_edges_at_every_size() {
    for size in [1, 2, 4] {
        let (w, h) = (128 / size, 96 / size);
        let middle = |x: usize, y: usize| (DVec2::new(x as f64, y as f64) + 0.5) * size as f64;
        let sharp = Picture::new(w, h, |x, y| room(middle(x, y)).0);
        let is_box = |x: usize, y: usize| room(middle(x, y)).1;
        let on_edge = sharp.edges(0.05);
        for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
            let differs = |p: usize, q: usize| {
                let (a, b) = (sharp.disparity[y * w + x], sharp.disparity[q * w + p]);
                is_box(x, y) != is_box(p, q) && (a - b).abs() > 0.05 * a.min(b)
            };
            let beside = (x > 0 && differs(x - 1, y)) || (x + 1 < w && differs(x + 1, y));
            let above = (y > 0 && differs(x, y - 1)) || (y + 1 < h && differs(x, y + 1));
            let is = on_edge[y * w + x];
            assert!(is || !beside, "({x}, {y}) of {w}x{h}: the box's side");
            assert!(!is || beside || above, "({x}, {y}) of {w}x{h}: one surface");
        }
        if size > 1 {
            let shrunk = shrunk(w, h, size, |x, y| {
                room(DVec2::new(x as f64, y as f64) + 0.5).0
            });
            let on_edge = shrunk.edges(0.05);
            for (x, y) in (0..w * h).map(|i| (i % w, i / w)) {
                let beside = (x.saturating_sub(2)..(x + 3).min(w))
                    .any(|x| (y.saturating_sub(2)..(y + 3).min(h)).any(|y| is_box(x, y)));
                assert!(
                    beside || !on_edge[y * w + x],
                    "({x}, {y}) of {w}x{h}, shrunk"
                );
            }
        }
    }
}

#[test]
fn missing_depth_is_no_edge_and_ends_a_slope() {
    for missing in [0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let row = [1.0, 1.02, 1.2, missing, 1.2];
        let expected = [false, true, true, false, false];
        assert_eq!(depth_edges(&row, 5, 0.05), expected, "{missing} in a row");
        assert_eq!(
            depth_edges(&row, 1, 0.05),
            expected,
            "{missing} in a column"
        );
        // A slope of 1 in 10 goes on for four steps, and for three.
        let slope = |length: usize| {
            let mut row: Vec<f32> = (0..length).map(|x| 1.0 / (10.0 + x as f32)).collect();
            row.extend([missing, 1.0]);
            count(&depth_edges(&row, length + 2, 0.05))
        };
        assert_eq!((slope(5), slope(4)), (0, 4), "before {missing}");
    }
}

#[test]
fn pictures_of_any_size_and_numbers_of_any_size_are_taken() {
    assert!(depth_edges(&[], 0, 0.05).is_empty());
    assert!(depth_edges(&[], 7, 0.05).is_empty());
    assert_eq!(depth_edges(&[1.0], usize::MAX, 0.05), [false]);
    assert_eq!(
        depth_edges(&[1.0, 2.0], 0, 0.05),
        [true, true],
        "one column"
    );
    // The last row may be cut short.
    assert_eq!(depth_edges(&[1.0, 1.0, 2.0], 2, 0.05), [true, false, true]);
    let extremes = [f32::MIN_POSITIVE, f32::MAX, 1e-45, 1.0];
    assert_eq!(depth_edges(&extremes, 4, 0.05), [true; 4]);
    assert_eq!(depth_edges(&extremes, 4, f64::INFINITY), [false; 4]);
    assert_eq!(depth_edges(&extremes, 4, f64::NAN), [false; 4]);
}
