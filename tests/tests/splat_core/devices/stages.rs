//! The stages of a render one by one: projection with culling, and the tiles' lists, which a prefix sum, two sorts and the
//! tiles' ranges make on a GPU.

use std::collections::BTreeSet;

use burn::tensor::{DType, Device};
use limpid_tests::{devices, largest};
use splat_core::{InImage, Stages, prepare};

use super::case::{CASES, Case, Inputs};

/// What a scene is besides generated.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Generated,
    /// All at one depth: the lower row is nearer.
    Flat,
    /// Each one is in the lists of all tiles, or nearly all.
    Huge,
    /// None is in any list.
    Behind,
}

/// A kind of scene with so many Gaussians: below, at and above what a group of a sort or of a prefix sum takes, 1,024.
fn scenes() -> Vec<(Kind, Case)> {
    let of_rows = |rows| Case {
        rows,
        moving: 0,
        samples: 1,
        width: 70,
        height: 45,
        sh_degree: 1,
        features: 0,
    };
    let mut scenes: Vec<(Kind, Case)> = CASES.map(|case| (Kind::Generated, case)).into();
    for rows in [1023, 1024, 1025, 4097] {
        scenes.push((Kind::Generated, of_rows(rows)));
        scenes.push((Kind::Flat, of_rows(rows)));
    }
    scenes.extend([1, 128, 1024].map(|rows| (Kind::Huge, of_rows(rows))));
    scenes.extend([1, 1025].map(|rows| (Kind::Behind, of_rows(rows))));
    scenes
}

fn inputs(kind: Kind, case: &Case) -> Inputs {
    let mut inputs = case.inputs();
    for (name, _, values) in &mut inputs {
        let shifted = |z: f64| {
            let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
            identity.into_iter().chain([z]).collect::<Vec<f64>>()
        };
        match (kind, *name) {
            (Kind::Flat, "means") => values.iter_mut().skip(2).step_by(3).for_each(|z| *z = 4.0),
            (Kind::Flat, "cam_from_world") => *values = shifted(0.0),
            (Kind::Huge, "log_scales") => values.iter_mut().for_each(|v| *v = 1.5),
            (Kind::Behind, "cam_from_world") => *values = shifted(-20.0),
            _ => {}
        }
    }
    inputs
}

fn stages(kind: Kind, case: &Case, device: &Device, dtype: DType) -> Stages {
    let (splats, view) = case.scene(&inputs(kind, case), device, dtype);
    let prepared = prepare(&splats, &view).expect("a view");
    prepared.stages().expect("its stages")
}

/// Largest difference of what was projected, as a share of what it is from: of means in the whole image.
fn off(found: &InImage, exact: &InImage, case: &Case) -> f64 {
    let side = case.width.max(case.height) as f64;
    let size = |values: &[f64]| values.iter().map(|v| v * v).sum::<f64>().sqrt();
    let pairs: [(&[f64], &[f64], f64); 5] = [
        (&found.mean, &exact.mean, side + size(&exact.mean)),
        (&found.falloff, &exact.falloff, size(&exact.falloff)),
        (&[found.opacity], &[exact.opacity], exact.opacity),
        (&[found.depth], &[exact.depth], exact.depth),
        (&found.color, &exact.color, 1.0 + size(&exact.color)),
    ];
    let errors = pairs.map(|(found, exact, of)| {
        let differences: Vec<f64> = found.iter().zip(exact).map(|(f, e)| f - e).collect();
        size(&differences) / of
    });
    largest(errors)
}

/// Tiles and rows that are listed together.
fn pairs(stages: &Stages) -> BTreeSet<(usize, u32)> {
    let tiles = 0..stages.tiles[0] * stages.tiles[1];
    tiles
        .flat_map(|tile| stages.tile(tile).iter().map(move |row| (tile, *row)))
        .collect()
}

#[test]
fn projection_and_culling_on_every_device_follow_double_on_the_cpu() {
    for (kind, case) in scenes() {
        let exact = stages(kind, &case, &Device::flex().autodiff(), DType::F64);
        for (name, device) in devices() {
            let found = stages(kind, &case, &device.autodiff(), DType::F32);
            assert_eq!(found.projected.len(), case.rows, "{name}, {kind:?}");
            let pairs = found.projected.iter().zip(&exact.projected).enumerate();
            let worst = largest(pairs.map(|(row, pair)| match pair {
                (Some(found), Some(exact)) => off(found, exact, &case),
                (None, None) => 0.0,
                _ => panic!("{name}, {kind:?}, {case:?}: row {row}, {pair:?}"),
            }));
            assert!(worst < 1e-5, "{name}, {kind:?}, {case:?}: off by {worst:e}");
        }
    }
}

#[test]
fn the_lists_of_tiles_on_every_device_are_those_of_the_cpu_nearest_first() {
    for (kind, case) in scenes() {
        let exact = pairs(&stages(kind, &case, &Device::flex().autodiff(), DType::F64));
        for (name, device) in devices() {
            let found = stages(kind, &case, &device.autodiff(), DType::F32);
            let at = format!("{name}, {kind:?}, {case:?}");
            let tiles = found.tiles[0] * found.tiles[1];
            assert_eq!(found.tile_starts.len(), tiles + 1, "{at}");
            assert_eq!(found.tile_starts[tiles], found.listed.len(), "{at}");
            for tile in 0..tiles {
                let order: Vec<(f64, u32)> = found
                    .tile(tile)
                    .iter()
                    .map(|row| {
                        let seen = found.projected[*row as usize];
                        (seen.expect("what is listed is seen").depth, *row)
                    })
                    .collect();
                // At equal depth the lower row is nearer, and no row stands in a list twice.
                let sorted = order.is_sorted_by(|a, b| a < b);
                assert!(sorted, "{at}: tile {tile} has {order:?}");
            }
            let found = pairs(&found);
            let other = found.symmetric_difference(&exact).count();
            assert_eq!(other, 0, "{at}: of {} pairs", exact.len());
            match kind {
                Kind::Behind => assert!(exact.is_empty(), "{at}"),
                Kind::Huge => assert!(2 * exact.len() > tiles * case.rows, "{at}"),
                Kind::Generated | Kind::Flat => {}
            }
        }
    }
}
