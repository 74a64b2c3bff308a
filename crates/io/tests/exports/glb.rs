//! Binary glTF, by a reader after its specification.

use crate::made::{axes_differ, extreme, gaussians, refuses_what_is_no_number, sh_sign, sigmoid};
use io::{Gaussians, Glb, GlbPart, IoError, RigidMotion, write_glb};
use serde_json::Value;

/// y up, x left, z forward.
const UP: [f32; 3] = [-1.0, -1.0, 1.0];

struct File {
    json: Value,
    bytes: Vec<u8>,
}

impl File {
    /// The container of chapter 4: everything in multiples of four bytes.
    fn read(data: &[u8]) -> Self {
        let word = |at: usize| u32::from_le_bytes(data[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(&data[..4], b"glTF");
        assert_eq!((word(4), word(8)), (2, data.len()));
        let of_json = word(12);
        assert_eq!((&data[16..20], of_json % 4), (&b"JSON"[..], 0));
        let at = 20 + of_json;
        let of_bytes = word(at);
        assert_eq!((&data[at + 4..at + 8], of_bytes % 4), (&b"BIN\0"[..], 0));
        assert_eq!(at + 8 + of_bytes, data.len());
        let json: Value = serde_json::from_slice(&data[20..at]).unwrap();
        assert_eq!(json["buffers"][0]["byteLength"], of_bytes);
        Self {
            json,
            bytes: data[at + 8..].to_vec(),
        }
    }

    fn written(glb: &Glb) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scene.glb");
        write_glb(&path, glb).unwrap();
        Self::read(&std::fs::read(path).unwrap())
    }

    /// The floats of an accessor, by rows.
    fn floats<const N: usize>(&self, accessor: &Value) -> Vec<[f32; N]> {
        let accessor = &self.json["accessors"][accessor.as_u64().unwrap() as usize];
        assert_eq!(accessor["componentType"], 5126);
        assert_eq!(accessor["type"], ["SCALAR", "", "VEC3", "VEC4"][N - 1]);
        let view = &self.json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let [at, length] =
            ["byteOffset", "byteLength"].map(|key| view[key].as_u64().unwrap() as usize);
        let count = accessor["count"].as_u64().unwrap() as usize;
        assert_eq!((at % 4, length), (0, 4 * N * count));
        let bytes = &self.bytes[at..at + length];
        let floats: Vec<f32> = bytes
            .as_chunks::<4>()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect();
        assert!(floats.iter().all(|v| v.is_finite()));
        floats.as_chunks::<N>().0.to_vec()
    }

    fn attribute<const N: usize>(&self, mesh: usize, name: &str) -> Vec<[f32; N]> {
        let primitive = &self.json["meshes"][mesh]["primitives"][0];
        assert_eq!(primitive["mode"], 0, "points");
        self.floats(&primitive["attributes"][name])
    }
}

fn part(gaussians: Gaussians) -> GlbPart {
    GlbPart {
        name: "a </script> \" name".to_owned(),
        gaussians,
        motion: None,
    }
}

fn still(gaussians: Gaussians) -> Glb {
    Glb {
        parts: vec![part(gaussians)],
        seconds: Vec::new(),
    }
}

#[test]
fn every_number_is_there_in_gltf_s_units_and_axes() {
    for (n, degree) in [(1, 0), (40, 1), (40, 2), (300, 3)] {
        let all = gaussians(n, degree);
        let file = File::written(&still(all.clone()));
        assert_eq!(file.json["extensionsUsed"][0], "KHR_gaussian_splatting");
        let extension =
            &file.json["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"];
        assert_eq!(
            (&extension["kernel"], &extension["colorSpace"]),
            (&"ellipse".into(), &"srgb_rec709_display".into())
        );
        let own = |name: &str| format!("KHR_gaussian_splatting:{name}");
        let positions = file.attribute::<3>(0, "POSITION");
        let rotations = file.attribute::<4>(0, &own("ROTATION"));
        let scales = file.attribute::<3>(0, &own("SCALE"));
        let opacities = file.attribute::<1>(0, &own("OPACITY"));
        let width = 3 * (degree + 1).pow(2);
        for i in 0..n {
            let [x, y, z] = all.means[i];
            assert_eq!(positions[i], [-x, -y, z]);
            let [qx, qy, qz, qw] = rotations[i];
            let length: f32 = rotations[i].iter().map(|v| v * v).sum();
            assert!((length - 1.0).abs() < 1e-6);
            assert!(axes_differ([qw, qx, qy, qz], all.quats[i], UP) < 1e-6);
            for c in 0..3 {
                assert!((scales[i][c] / all.log_scales[i][c].exp() - 1.0).abs() < 1e-6);
            }
            assert!((opacities[i][0] - sigmoid(all.opacity_logits[i])).abs() < 1e-6);
        }
        for l in 0..=degree {
            for m in 0..=2 * l {
                let k = l * l + m;
                let found = file.attribute::<3>(0, &own(&format!("SH_DEGREE_{l}_COEF_{m}")));
                for i in 0..n {
                    let expected =
                        [0, 1, 2].map(|c| sh_sign(k, UP) * all.sh[i * width + 3 * k + c]);
                    assert_eq!(found[i], expected, "degree {l}, {m}");
                }
            }
        }
        let more = own(&format!("SH_DEGREE_{}_COEF_0", degree + 1));
        assert!(file.json["meshes"][0]["primitives"][0]["attributes"][more].is_null());
        // The range of positions is told as the numbers are.
        let accessor = &file.json["accessors"][file.json["meshes"][0]["primitives"][0]["attributes"]
            ["POSITION"]
            .as_u64()
            .unwrap() as usize];
        for c in 0..3 {
            let of = |key: &str| accessor[key][c].as_f64().unwrap() as f32;
            let column = positions.iter().map(|p| p[c]);
            assert_eq!(of("min"), column.clone().fold(f32::INFINITY, f32::min));
            assert_eq!(of("max"), column.fold(f32::NEG_INFINITY, f32::max));
        }
    }
}

/// What a reader does: the node's pose on the part's own positions, against ours in the axes of PLY.
#[test]
fn a_part_that_moves_is_where_it_should_be() {
    let moved = gaussians(20, 1);
    let angles = [0.0_f32, 0.4, 2.0, 3.5];
    let motion = RigidMotion {
        // About (1, 2, 2) / 3; one as the other quaternion of the same rotation.
        rotations: angles
            .iter()
            .enumerate()
            .map(|(i, angle)| {
                let (s, c) = (0.5 * angle).sin_cos();
                let sign = if i == 2 { -1.0 } else { 1.0 };
                [c, s / 3.0, 2.0 * s / 3.0, 2.0 * s / 3.0].map(|v| sign * v)
            })
            .collect(),
        translations: (0..4).map(|i| [i as f32, -0.5, 0.25 * i as f32]).collect(),
    };
    let seconds = vec![0.0, 0.5, 0.75, 2.0];
    let parts = vec![
        part(gaussians(5, 1)),
        part(Gaussians {
            sh_degree: 1,
            ..Gaussians::default()
        }),
        GlbPart {
            motion: Some(motion.clone()),
            ..part(moved.clone())
        },
    ];
    let file = File::written(&Glb {
        parts,
        seconds: seconds.clone(),
    });
    assert_eq!(
        file.json["nodes"].as_array().unwrap().len(),
        2,
        "empty parts are left out"
    );
    let animation = &file.json["animations"][0];
    let output = |path: &str| {
        let channels = animation["channels"].as_array().unwrap();
        let channel = channels
            .iter()
            .find(|c| c["target"]["path"] == path)
            .unwrap();
        assert_eq!(channel["target"]["node"], 1);
        let sampler = &animation["samplers"][channel["sampler"].as_u64().unwrap() as usize];
        let input = file.floats::<1>(&sampler["input"]);
        assert_eq!(input.as_flattened(), seconds);
        sampler["output"].clone()
    };
    let rotations = file.floats::<4>(&output("rotation"));
    let translations = file.floats::<3>(&output("translation"));
    for pair in rotations.windows(2) {
        let cosine: f32 = pair[0].iter().zip(&pair[1]).map(|(a, b)| a * b).sum();
        assert!(cosine >= 0.0, "the short way round");
    }
    let apply = |[w, x, y, z]: [f32; 4], t: [f32; 3], p: [f32; 3]| {
        let r = crate::made::rotation([w, x, y, z]);
        [0, 1, 2].map(|i| r[i][0] * p[0] + r[i][1] * p[1] + r[i][2] * p[2] + t[i])
    };
    let positions = file.attribute::<3>(1, "POSITION");
    for t in 0..4 {
        let [x, y, z, w] = rotations[t];
        for i in 0..20 {
            let found = apply([w, x, y, z], translations[t], positions[i]);
            let [ex, ey, ez] = apply(motion.rotations[t], motion.translations[t], moved.means[i]);
            for (found, expected) in found.into_iter().zip([-ex, -ey, ez]) {
                assert!((found - expected).abs() < 1e-4, "{found} {expected}");
            }
        }
    }
}

#[test]
fn the_ends_of_numbers_are_finite_and_in_range() {
    let file = File::written(&still(extreme()));
    let opacities = file.attribute::<1>(0, "KHR_gaussian_splatting:OPACITY");
    assert_eq!((opacities[0], opacities[1]), ([1.0], [0.0]));
    let scales = file.attribute::<3>(0, "KHR_gaussian_splatting:SCALE");
    assert_eq!((scales[2], scales[3]), ([f32::MAX; 3], [0.0; 3]));
    let rotations = file.attribute::<4>(0, "KHR_gaussian_splatting:ROTATION");
    assert_eq!(rotations[4], [0.0, 0.0, 0.0, 1.0]);
    assert!(
        rotations
            .iter()
            .all(|q| (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5)
    );
}

#[test]
fn what_it_cannot_hold_is_refused() {
    refuses_what_is_no_number(|path, gaussians| write_glb(path, &still(gaussians.clone())));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    let one = gaussians(1, 0);
    let pose = |count: usize| RigidMotion {
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        translations: vec![[0.0; 3]; count],
    };
    let moving = |count: usize, seconds: &[f32]| Glb {
        parts: vec![GlbPart {
            motion: Some(pose(count)),
            ..part(one.clone())
        }],
        seconds: seconds.to_vec(),
    };
    for (why, glb) in [
        ("no Gaussian", Glb::default()),
        ("no Gaussian", still(Gaussians::default())),
        ("later", moving(2, &[0.0, 0.0])),
        ("later", moving(2, &[1.0, 0.5])),
        ("later", moving(2, &[-1.0, 0.5])),
        ("later", moving(2, &[0.0, f32::NAN])),
        ("for 3 times", moving(2, &[0.0, 1.0, 2.0])),
        ("for 0 times", moving(0, &[])),
    ] {
        let error = write_glb(&path, &glb).unwrap_err();
        assert!(matches!(error, IoError::Invalid { .. }), "{error}");
        assert!(error.to_string().contains(why), "{why}: {error}");
    }
    let mut lost = pose(1);
    lost.translations[0][1] = f32::NAN;
    let glb = Glb {
        parts: vec![GlbPart {
            motion: Some(lost),
            ..part(one)
        }],
        seconds: vec![0.0],
    };
    assert!(matches!(
        write_glb(&path, &glb),
        Err(IoError::NotANumber { .. })
    ));
    assert!(!path.exists());
}
