//! Gaussians as glTF and SPZ want them.

use std::path::Path;

use splat_core::Gaussians;

use crate::IoError;

/// Axes with y up, as signs of this project's (x right, y down, z forward): half a turn about one of them.
pub(super) type Axes = [f32; 3];
/// OpenGL's, where x is right and z is back.
pub(super) const OPENGL: Axes = [1.0, -1.0, -1.0];
/// glTF's, where x is left and z is forward.
pub(super) const GLTF: Axes = [-1.0, -1.0, 1.0];

/// In which coordinates each spherical harmonic is odd, in the order of 3DGS.
const SH_ODD: [&str; 16] = [
    "", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x",
];

/// An error for arrays that do not fit each other, and for a number that is none, with its row.
pub(super) fn check(gaussians: &Gaussians, path: &Path) -> Result<(), IoError> {
    gaussians
        .check()
        .map_err(|error| IoError::invalid(path, error.to_string()))?;
    let Gaussians {
        means,
        quats,
        log_scales,
        opacity_logits,
        sh,
        sh_degree,
    } = gaussians;
    let arrays = [
        ("mean", means.as_flattened(), 3),
        ("rotation", quats.as_flattened(), 4),
        ("scale", log_scales.as_flattened(), 3),
        ("opacity", opacity_logits, 1),
        ("colour", sh, 3 * (sh_degree + 1).pow(2)),
    ];
    for (name, values, width) in arrays {
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            let what = format!("the {name} of Gaussian {}", at / width);
            return Err(IoError::not_a_number(path, what, "leave the Gaussian out"));
        }
    }
    Ok(())
}

/// Gaussians in other axes, view-dependent colours too.
pub(super) fn turned(gaussians: &Gaussians, axes: Axes) -> Gaussians {
    let mut turned = gaussians.clone();
    for mean in &mut turned.means {
        *mean = turned_point(*mean, axes);
    }
    for quat in &mut turned.quats {
        *quat = turned_quat(*quat, axes);
    }
    let odd = |letters: &str| {
        let signs = ["x", "y", "z"].iter().zip(axes);
        let odd = signs.filter(|(letter, _)| letters.contains(**letter));
        odd.map(|(_, sign)| sign).product::<f32>()
    };
    let signs = SH_ODD.map(odd);
    let width = 3 * (turned.sh_degree + 1).pow(2);
    for (at, value) in turned.sh.iter_mut().enumerate() {
        *value *= signs[at % width / 3];
    }
    turned
}

/// A point or a translation in other axes.
pub(super) fn turned_point(point: [f32; 3], axes: Axes) -> [f32; 3] {
    [0, 1, 2].map(|c| point[c] * axes[c])
}

/// A rotation (w, x, y, z) in other axes: half a turn before and behind. (The one before turns an ellipsoid into itself.)
pub(super) fn turned_quat([w, x, y, z]: [f32; 4], axes: Axes) -> [f32; 4] {
    [w, x * axes[0], y * axes[1], z * axes[2]]
}

/// Unit quaternion of one of any length; without a length, no rotation.
pub(super) fn unit_quat(quat: [f32; 4]) -> [f32; 4] {
    let quat = quat.map(f64::from);
    let length = quat.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        quat.map(|v| (v / length) as f32)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

/// From 0 to 1.
pub(super) fn opacity(logit: f32) -> f32 {
    (1.0 / (1.0 + (-f64::from(logit)).exp())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DMat3, DVec3};
    use splat_core::Camera;
    use splat_core::cpu::{View, project, rasterize};

    /// Half a turn of scene and camera together changes no pixel, with colours of any degree.
    #[test]
    fn a_turned_scene_looks_the_same_to_a_turned_camera() {
        let mut seed = 0.3_f32;
        let mut number = || {
            seed = (seed * 97.31 + 0.17).fract();
            seed - 0.5
        };
        let n = 12;
        let gaussians = Gaussians {
            means: (0..n).map(|_| [number(), number(), number()]).collect(),
            quats: (0..n)
                .map(|_| [number(), number(), number(), number()])
                .collect(),
            log_scales: (0..n)
                .map(|_| [number() - 2.0, number() - 2.0, number() - 3.0])
                .collect(),
            opacity_logits: (0..n).map(|_| number()).collect(),
            sh: (0..n * 48).map(|_| number()).collect(),
            sh_degree: 3,
        };
        let camera = Camera::pinhole([40, 30], [40.0, 40.0], [20.0, 15.0]);
        let pose = DAffine3::from_translation(DVec3::new(0.1, -0.2, 2.0));
        let picture = |gaussians: &Gaussians, pose: &DAffine3| -> Vec<f32> {
            let view = View::new(&camera, pose, 3);
            let projected = project(&gaussians.slices(), &view).unwrap();
            let raster = rasterize(&projected, &[], 0).unwrap();
            raster.color().flatten().collect()
        };
        let before = picture(&gaussians, &pose);
        assert!(before.iter().any(|v| *v > 0.1), "something is seen");
        for axes in [OPENGL, GLTF] {
            let half_turn = DMat3::from_diagonal(DVec3::from_array(axes.map(f64::from)));
            let turned_pose = pose * DAffine3::from_mat3(half_turn);
            let after = picture(&turned(&gaussians, axes), &turned_pose);
            let difference = before.iter().zip(&after).map(|(a, b)| (a - b).abs());
            assert!(difference.fold(0.0, f32::max) < 1e-4);
        }
    }
}
