//! What holds for any input: threads, extremes, emptiness, errors.

use super::*;
use crate::SplatError;

fn with_threads<R: Send>(threads: usize, run: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .unwrap()
        .install(run)
}

#[test]
fn same_bits_with_one_and_two_threads() {
    let mut case = random_case(50, 3000, 3, 1, 700).cast::<f32>();
    case.log_scales.iter_mut().for_each(|s| *s -= 1.5);
    case.camera = Camera::pinhole([150, 90], [120.0, 110.0], [70.0, 50.0]);
    let v_output: Vec<f32> = Random(8)
        .fill(150 * 90 * 6, -1.0, 1.0)
        .into_iter()
        .map(|v| v as f32)
        .collect();
    let run = || {
        let g = case.backward(&v_output);
        let mut all = case.render().output;
        for part in [
            &g.means,
            &g.quats,
            &g.left_rotations,
            &g.log_scales,
            &g.opacity_logits,
            &g.sh,
            &g.features,
            &g.screen,
            &g.cam_from_world.to_vec(),
        ] {
            all.extend_from_slice(part);
        }
        all.into_iter().map(f32::to_bits).collect::<Vec<_>>()
    };
    let one = with_threads(1, run);
    for threads in [2, 3] {
        assert!(one == with_threads(threads, run), "{threads} threads");
    }
}

#[test]
fn extremes_stay_finite() {
    // Scales 1e-8 to 1e4 in every mixture, opacity logits of ±40, a zero and a huge quaternion, means
    // on the camera plane, at the near plane, behind and 1e6 away, a mean at the camera's centre.
    let camera = Camera::pinhole([20, 18], [30.0, 30.0], [10.0, 9.0]);
    let far = [
        [0.0, 0.0, 2.0],
        [0.3, -0.2, 0.0],
        [0.0, 0.0, 0.010_001],
        [5.0, 5.0, 0.010_1],
        [0.0, 0.0, -3.0],
        [1e6, 0.0, 1e6],
        [0.0, 0.0, 1e6],
        [1e6, 1e6, 1.0],
        [0.0, 0.0, 0.0],
        [0.1, 0.1, 1.0],
    ];
    let scales = [1e-8_f64, 1e-3, 1.0, 1e4];
    let quats = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0; 4],
        [1e15, -1e15, 1e15, 2e15],
        [1e-20, 2e-20, -1e-20, 0.0],
        [0.3, 0.5, -0.2, 0.7],
    ];
    let logits = [-40.0, 0.0, 40.0];
    let mut case = Case {
        means: vec![],
        quats: vec![],
        left: vec![],
        log_scales: vec![],
        logits: vec![],
        sh: vec![],
        features: vec![],
        pose: pose_of(DQuat::IDENTITY, DVec3::ZERO),
        num_features: 1,
        degree: 1,
        camera,
    };
    for mean in far {
        for a in scales {
            for b in scales {
                for quat in quats {
                    for logit in logits {
                        case.means.extend(mean);
                        case.quats.extend(quat);
                        case.log_scales.extend([a.ln(), b.ln(), a.ln()]);
                        case.logits.push(logit);
                        case.sh.extend([0.4; 12]);
                        case.features.push(1.0);
                    }
                }
            }
        }
    }
    let single = case.cast::<f32>();
    // All together, and each by itself so that none hides behind another.
    let rows: Vec<Vec<usize>> = std::iter::once((0..single.len()).collect())
        .chain((0..single.len()).map(|k| vec![k]))
        .collect();
    for rows in rows {
        let case = single.permuted(&rows);
        let output = case.render().output;
        assert!(output.iter().all(|v| v.is_finite()), "image of {rows:?}");
        let g = case.backward(&vec![1.0; output.len()]);
        for (name, part) in [
            ("means", &g.means),
            ("quats", &g.quats),
            ("log_scales", &g.log_scales),
            ("opacity_logits", &g.opacity_logits),
            ("sh", &g.sh),
            ("screen", &g.screen),
            ("pose", &g.cam_from_world.to_vec()),
        ] {
            assert!(
                part.iter().all(|v| v.is_finite()),
                "{name} of {rows:?}: mean {:?}, quat {:?}, scale {:?}, logit {:?}: {part:?}",
                &case.means[..3],
                &case.quats[..4],
                &case.log_scales[..3],
                case.logits[0],
            );
        }
    }
}

#[test]
fn what_is_not_drawn_has_no_radius_and_no_gradient() {
    let mut case = random_case(90, 6, 1, 0, 0);
    case.logits[1] = -10.0; // under alpha 1/255 everywhere
    case.logits[2] = 3.0;
    let camera_z: [f64; 3] = [case.pose[8], case.pose[9], case.pose[10]];
    for k in 0..3 {
        case.means[6 + k] -= 20.0 * camera_z[k]; // behind the camera
    }
    let projection = case.project();
    let g = case.backward(&vec![1.0; case.camera.num_pixels() * 5]);
    for row in [1, 2] {
        assert_eq!(projection.radii()[row], 0.0, "radius of row {row}");
        assert_eq!(
            g.means[3 * row..3 * row + 3],
            [0.0; 3],
            "gradient of row {row}"
        );
    }
    assert!(projection.radii()[0] > 0.0, "radius of row 0");
    assert_eq!(projection.num_visible(), 4, "visible");
}

#[test]
fn no_gaussian_gives_a_black_image() {
    let mut case = one_ahead(0.5);
    for part in [
        &mut case.means,
        &mut case.quats,
        &mut case.log_scales,
        &mut case.logits,
        &mut case.sh,
    ] {
        part.clear();
    }
    let output = case.render().output;
    assert_eq!(output, vec![0.0; 125], "the image");
    let g = case.backward(&output);
    assert!(
        g.means.is_empty() && g.cam_from_world == [0.0; 12],
        "gradients"
    );
}

#[test]
fn what_is_not_finite_is_named_with_its_row() {
    let case = random_case(95, 600, 1, 2, 5);
    type Field = fn(&mut Case<f64>) -> &mut Vec<f64>;
    let inputs: [(&str, Field, usize, usize); 7] = [
        ("means", |c| &mut c.means, 3, 599),
        ("quats", |c| &mut c.quats, 4, 513),
        ("left_rotations", |c| &mut c.left, 9, 4),
        ("log_scales", |c| &mut c.log_scales, 3, 0),
        ("opacity_logits", |c| &mut c.logits, 1, 77),
        ("sh", |c| &mut c.sh, 12, 300),
        ("cam_from_world", |c| &mut c.pose, 4, 2),
    ];
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for (tensor, field, width, row) in inputs {
            let mut bad = case.clone();
            field(&mut bad)[row * width + width - 1] = value;
            let error = project(&bad.slices(), &bad.view()).unwrap_err();
            assert_eq!(error, SplatError::NotFinite { tensor, row }, "{value}");
        }
        let mut bad = case.clone();
        bad.features[2 * 31] = value;
        let error = rasterize(&case.project(), &bad.features, 2).unwrap_err();
        let expected = SplatError::NotFinite {
            tensor: "features",
            row: 31,
        };
        assert_eq!(error, expected, "{value}");
    }
}

#[test]
fn of_several_faults_the_first_row_is_named() {
    let mut bad = random_case(97, 3000, 1, 0, 0);
    for row in [2999, 1600, 700] {
        bad.means[3 * row] = f64::NAN;
    }
    bad.sh[12 * 1200] = f64::NAN;
    let first = SplatError::NotFinite {
        tensor: "means",
        row: 700,
    };
    for _ in 0..20 {
        let error = project(&bad.slices(), &bad.view()).unwrap_err();
        assert_eq!(error, first, "a render");
        let error = expose(&Exposure {
            splats: bad.slices(),
            middle: &bad.view(),
            poses: &bad.pose,
            moving_means: &[],
            left_rotations: &[],
            transfer: Transfer::Linear,
        });
        assert_eq!(error.unwrap_err(), first, "an exposure");
    }
}

#[test]
fn wrong_lengths_degrees_and_cameras_are_errors() {
    let case = random_case(96, 5, 1, 0, 0);
    let fails = |case: &Case<f64>| {
        project(&case.slices(), &case.view())
            .unwrap_err()
            .to_string()
    };
    let mut bad = case.clone();
    bad.quats.pop();
    assert!(fails(&bad).contains("quats"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.sh.truncate(5 * 3 * 3);
    assert!(fails(&bad).contains("sh"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.degree = 2;
    assert!(fails(&bad).contains("degree 2"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.left = vec![0.0; 9 * 6];
    assert!(fails(&bad).contains("left_rotations"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.camera.width = 0;
    assert!(fails(&bad).contains("camera"), "{}", fails(&bad));
    let mut bad = case.clone();
    bad.camera.fx = f64::NAN;
    assert!(fails(&bad).contains("fx"), "{}", fails(&bad));
}
