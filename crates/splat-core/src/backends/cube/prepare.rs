//! From Gaussians to lists of what every tile sees.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{full, units};

use super::sort::{before, sorted};
use super::tables::{Scene, Tables, read};
use crate::cube::body::{MOVED, SHAPE};
use crate::cube::color::colors_kernel;
use crate::cube::project::{Rows, faults_kernel, project_kernel, radii_kernel};
use crate::cube::splat::SPLAT;
use crate::cube::tiles::{count_kernel, emit_kernel, ranges_kernel, total_kernel};
use crate::error::SplatError;

/// Where [`faults_kernel`] notes what is not finite: means, quats, log_scales, opacity_logits; means and left rotations of what
/// moves; SH; the pose of the middle and those of the samples; features. Behind them come the number of slots and whether it is
/// right.
const FAULTS: usize = 10;
const MOVING: usize = 4;
const SH: usize = 6;
const POSE: usize = 7;
const POSES: usize = 8;
const FEATURES: usize = 9;

/// Projects, culls, sorts by depth and lists by tile. There is a Gaussian; `features` are looked at, where they are known.
pub(super) fn prepare(scene: Scene, features: Option<&CubeTensor>) -> Result<Tables, SplatError> {
    scene.camera.check()?;
    let client = scene.client().clone();
    let (items, rows) = (scene.items(), scene.rows);
    let faults = full(&scene.shapes, [FAULTS + 2], u32::MAX);
    look_for_faults(&scene, features, &faults);
    let colors = scene.table("colours", rows * 3, DType::F32)?;
    let (number, dim) = units(&client, rows);
    colors_kernel::launch(
        &client,
        number,
        dim,
        scene.shapes.clone().into_buffer_arg(),
        scene.sh.clone().into_buffer_arg(),
        scene.pose.clone().into_buffer_arg(),
        colors.clone().into_buffer_arg(),
        scene.sh_degree,
        scene.stored,
    );
    let splats = scene.table("projected Gaussians", items * SPLAT, DType::F32)?;
    let keys = scene.table("depths", items, DType::U32)?;
    let (number, dim) = units(&client, items);
    project_kernel::launch(
        &client,
        number.clone(),
        dim,
        scene.lens(),
        scene.shapes.clone().into_buffer_arg(),
        scene.moved.clone().into_buffer_arg(),
        scene.poses.clone().into_buffer_arg(),
        colors.into_buffer_arg(),
        splats.clone().into_buffer_arg(),
        keys.clone().into_buffer_arg(),
        scene.moving,
    );
    let [_, order] = sorted(keys, u32::BITS);
    let counts = scene.table("numbers of tiles", items, DType::U32)?;
    count_kernel::launch(
        &client,
        number.clone(),
        dim,
        scene.lens(),
        splats.clone().into_buffer_arg(),
        order.clone().into_buffer_arg(),
        counts.clone().into_buffer_arg(),
    );
    let starts = before(&counts);
    total_kernel::launch(
        &client,
        number.clone(),
        dim,
        counts.clone().into_buffer_arg(),
        starts.clone().into_buffer_arg(),
        faults.clone().into_buffer_arg(),
        FAULTS,
    );
    // The one time that the device is waited for: buffers are made for the number of slots.
    let found = read(&faults)?;
    name_fault(&found)?;
    if found[FAULTS + 1] == 0 {
        return Err(SplatError::TooManyTiles { count: 1 << 32 });
    }
    let num_slots = found[FAULTS] as usize;
    let slot_table = |name| scene.table(name, num_slots, DType::U32);
    let (tiles_of, items_of) = (slot_table("tiles' lists")?, slot_table("tiles' lists")?);
    let lists = scene.table("Gaussians' lists", 2 * items, DType::U32)?;
    emit_kernel::launch(
        &client,
        number,
        dim,
        scene.lens(),
        splats.clone().into_buffer_arg(),
        order.into_buffer_arg(),
        counts.into_buffer_arg(),
        starts.into_buffer_arg(),
        tiles_of.clone().into_buffer_arg(),
        items_of.clone().into_buffer_arg(),
        lists.clone().into_buffer_arg(),
        rows,
    );
    let ranges = full(&scene.shapes, [2 * scene.tiles()], 0);
    let list = slot_table("tiles' lists")?;
    let mut slots = list.clone();
    if num_slots > 0 {
        // One more than the tiles: what a compiler's rounding left over.
        let bits = usize::BITS - scene.tiles().leading_zeros();
        let [tiles_of, sorted_slots] = sorted(tiles_of, bits);
        let (number, dim) = units(&client, num_slots);
        ranges_kernel::launch(
            &client,
            number,
            dim,
            tiles_of.into_buffer_arg(),
            sorted_slots.clone().into_buffer_arg(),
            items_of.into_buffer_arg(),
            ranges.clone().into_buffer_arg(),
            list.clone().into_buffer_arg(),
        );
        slots = sorted_slots;
    }
    let radii = scene.table("radii", rows, DType::F32)?;
    let (number, dim) = units(&client, rows);
    radii_kernel::launch(
        &client,
        number,
        dim,
        splats.clone().into_buffer_arg(),
        lists.clone().into_buffer_arg(),
        radii.clone().into_buffer_arg(),
    );
    Ok(Tables {
        scene,
        splats,
        lists,
        ranges,
        list,
        slots,
        num_slots,
        features_checked: features.is_some(),
        radii,
    })
}

/// Notes the first row of every input that is not finite.
fn look_for_faults(scene: &Scene, features: Option<&CubeTensor>, faults: &CubeTensor) {
    let mut tables = vec![
        (&scene.shapes, SHAPE, 0, Rows::Shapes),
        (&scene.sh, 3 * scene.stored, SH, Rows::Plain),
        (&scene.pose, 4, POSE, Rows::Plain),
        (&scene.poses, 4, POSES, Rows::Plain),
    ];
    if scene.moving > 0 {
        tables.push((&scene.moved, MOVED, MOVING, Rows::Moved));
    }
    if let Some(features) = features {
        tables.push((features, features.meta.shape()[1], FEATURES, Rows::Plain));
    }
    for (table, width, first, of) in tables {
        let (number, dim) = units(scene.client(), table.meta.num_elements());
        faults_kernel::launch(
            scene.client(),
            number,
            dim,
            table.clone().into_buffer_arg(),
            faults.clone().into_buffer_arg(),
            width,
            first,
            of,
        );
    }
}

/// The error for the first input that is not finite.
fn name_fault(found: &[u32]) -> Result<(), SplatError> {
    for (entry, tensor) in [
        (POSE, "cam_from_world"),
        (0, "means"),
        (1, "quats"),
        (2, "log_scales"),
        (3, "opacity_logits"),
        (SH, "sh"),
        (MOVING, "moving_means"),
        (MOVING + 1, "left_rotations"),
        (POSES, "cam_from_world"),
        (FEATURES, "features"),
    ] {
        if found[entry] != u32::MAX {
            let row = found[entry] as usize;
            let row = if entry == POSES { row % 3 } else { row };
            return Err(SplatError::NotFinite { tensor, row });
        }
    }
    Ok(())
}
