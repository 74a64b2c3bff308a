//! From gradients of pictures to gradients of Gaussians and poses.

use burn::backend::ops::FloatTensorOps as _;
use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::CubeCount;
use host::cube::{cubes, empty, full, units, zeros};

use super::blend::{Blend, curve};
use super::tables::{Scene, Tables};
use crate::cpu::{GEOMETRIC, Transfer};
use crate::cube::color::colors_backward_kernel;
use crate::cube::exposure::{finite_kernel, pixel_gradients_kernel, sample_gradients_kernel};
use crate::cube::project_backward::{
    SCREEN, TEAM, V_MOVED, V_SHAPE, poses_kernel, project_backward_kernel,
};
use crate::cube::raster::STATE;
use crate::cube::raster_backward::{self, pixel_width, raster_backward_kernel, slot_sums_kernel};

/// What comes in: a gradient for every pixel of every sample, and whether all of them are numbers.
pub(super) struct PixelGradients {
    table: CubeTensor,
    flags: CubeTensor,
}

/// Whether all values are finite, as 1 or 0 in f32.
fn all_finite(values: &CubeTensor) -> CubeTensor {
    let flags = full(values, [1], 1.0_f32.to_bits());
    let (number, dim) = units(&values.client, values.meta.num_elements());
    finite_kernel::launch(
        &values.client,
        number,
        dim,
        values.clone().into_buffer_arg(),
        flags.clone().into_buffer_arg(),
    );
    flags
}

/// Of a render with so many channels beside alpha, from its gradient [H, W, 1 + C].
pub(super) fn render_gradients(
    tables: &Tables,
    state: &CubeTensor,
    gradient: CubeTensor,
    channels: usize,
) -> PixelGradients {
    let client = tables.scene.client();
    let pixels = state.meta.num_elements() / STATE;
    let table = empty(state, [pixels * pixel_width(channels)], DType::F32);
    let flags = all_finite(&gradient);
    let (number, dim) = units(client, pixels);
    pixel_gradients_kernel::launch(
        client,
        number,
        dim,
        gradient.into_buffer_arg(),
        state.clone().into_buffer_arg(),
        table.clone().into_buffer_arg(),
        channels,
    );
    PixelGradients { table, flags }
}

/// Of an exposure's samples, from the gradient of its picture [H, W, 3].
pub(super) fn exposure_gradients(
    tables: &Tables,
    blend: &Blend,
    picture: &CubeTensor,
    gradient: CubeTensor,
    transfer: Transfer,
) -> PixelGradients {
    let client = tables.scene.client();
    let pixels = blend.state.meta.num_elements() / STATE;
    let table = empty(picture, [pixels * pixel_width(3)], DType::F32);
    let flags = all_finite(&gradient);
    let (number, dim) = units(client, pixels);
    let (curve, gamma) = curve(transfer);
    sample_gradients_kernel::launch(
        client,
        number,
        dim,
        blend.output.clone().into_buffer_arg(),
        picture.clone().into_buffer_arg(),
        gradient.into_buffer_arg(),
        blend.state.clone().into_buffer_arg(),
        table.clone().into_buffer_arg(),
        1.0 / tables.scene.samples as f32,
        gamma,
        curve,
    );
    PixelGradients { table, flags }
}

/// Gradients as the kernels leave them.
pub(super) struct Unblended {
    rows: usize,
    moving: usize,
    samples: usize,
    /// [N, 15].
    shapes: CubeTensor,
    sh: CubeTensor,
    /// [n, moving, 12].
    moved: CubeTensor,
    /// [n, 12], without what comes through the colours, and that, [12]; zeros where poses are not wanted.
    poses: CubeTensor,
    color_pose: CubeTensor,
    /// [items, 6 + C + 1].
    sums: CubeTensor,
    channels: usize,
}

/// Back through blending, projection and colours. `features` [N, F] come behind colour and depth. `separate`: the means of what
/// moves are an input by themselves.
pub(super) fn unblend(
    tables: &Tables,
    features: &CubeTensor,
    pixels: PixelGradients,
    channels: usize,
    wants_poses: bool,
    separate: bool,
) -> Unblended {
    let scene = &tables.scene;
    let client = scene.client();
    let sums = item_sums(tables, features, &pixels, channels);
    let v_shapes = empty(&sums, [scene.rows * V_SHAPE], DType::F32);
    let length = (scene.samples * scene.moving * V_MOVED).max(1);
    let v_moved = empty(&sums, [length], DType::F32);
    let (number, dim) = units(client, scene.rows);
    let of_cubes = count(&number);
    let parts = empty(&sums, [scene.samples * of_cubes * 12], DType::F32);
    project_backward_kernel::launch(
        client,
        number.clone(),
        dim,
        scene.lens(),
        scene.shapes.clone().into_buffer_arg(),
        scene.moved.clone().into_buffer_arg(),
        scene.poses.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        v_shapes.clone().into_buffer_arg(),
        v_moved.clone().into_buffer_arg(),
        parts.clone().into_buffer_arg(),
        scene.moving,
        scene.samples,
        channels,
        wants_poses,
        separate,
    );
    let poses = match wants_poses {
        true => pose_sums(scene, &parts, &pixels.flags, scene.samples),
        false => zeros(&sums, [scene.samples * 12]),
    };
    let v_sh = empty(&sums, scene.sh.meta.shape().clone(), DType::F32);
    let parts = empty(&sums, [of_cubes * 12], DType::F32);
    colors_backward_kernel::launch(
        client,
        number,
        dim,
        scene.shapes.clone().into_buffer_arg(),
        scene.sh.clone().into_buffer_arg(),
        scene.pose.clone().into_buffer_arg(),
        v_shapes.clone().into_buffer_arg(),
        v_sh.clone().into_buffer_arg(),
        parts.clone().into_buffer_arg(),
        pixels.flags.clone().into_buffer_arg(),
        scene.sh_degree,
        scene.stored,
    );
    Unblended {
        rows: scene.rows,
        moving: scene.moving,
        samples: scene.samples,
        shapes: v_shapes,
        sh: v_sh,
        moved: v_moved,
        poses,
        color_pose: pose_sums(scene, &parts, &pixels.flags, 1),
        sums,
        channels,
    }
}

/// Number of cubes.
fn count(number: &CubeCount) -> usize {
    match number {
        CubeCount::Static(x, y, z) => (x * y * z) as usize,
        CubeCount::Dynamic(_) => unreachable!("counted on the host"),
    }
}

/// The partial gradients of every item, added up.
fn item_sums(
    tables: &Tables,
    features: &CubeTensor,
    pixels: &PixelGradients,
    channels: usize,
) -> CubeTensor {
    let scene = &tables.scene;
    let client = scene.client();
    let width = GEOMETRIC + channels;
    let partial = zeros(&pixels.table, [(tables.num_slots * width).max(1)]);
    let (number, dim) = cubes(client, scene.tiles(), raster_backward::TEAM);
    let features = if channels > 4 {
        features
    } else {
        // A buffer that no kernel reads, but none may be empty.
        &tables.splats
    };
    raster_backward_kernel::launch(
        client,
        number,
        dim,
        scene.lens(),
        tables.splats.clone().into_buffer_arg(),
        features.clone().into_buffer_arg(),
        tables.ranges.clone().into_buffer_arg(),
        tables.list.clone().into_buffer_arg(),
        tables.slots.clone().into_buffer_arg(),
        pixels.table.clone().into_buffer_arg(),
        partial.clone().into_buffer_arg(),
        channels,
    );
    let items = scene.items();
    let sums = empty(&pixels.table, [items * (width + 1) + 1], DType::F32);
    let (number, dim) = units(client, items + 1);
    slot_sums_kernel::launch(
        client,
        number,
        dim,
        partial.into_buffer_arg(),
        tables.lists.clone().into_buffer_arg(),
        pixels.flags.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
        width,
    );
    sums
}

/// Gradients of `poses` poses from those of each cube.
fn pose_sums(scene: &Scene, parts: &CubeTensor, flags: &CubeTensor, poses: usize) -> CubeTensor {
    let sums = empty(parts, [poses * 12], DType::F32);
    let (number, dim) = cubes(scene.client(), poses, TEAM);
    poses_kernel::launch(
        scene.client(),
        number,
        dim,
        parts.clone().into_buffer_arg(),
        flags.clone().into_buffer_arg(),
        sums.clone().into_buffer_arg(),
    );
    sums
}

impl Unblended {
    /// Columns of a table with rows of `width`.
    fn columns(
        table: &CubeTensor,
        rows: usize,
        width: usize,
        columns: std::ops::Range<usize>,
        shape: Shape,
    ) -> CubeTensor {
        let table = CubeBackend::float_reshape(table.clone(), [rows, width].into());
        let (from, to) = (columns.start as isize, columns.end as isize);
        let columns =
            CubeBackend::float_slice(table, &[(0..rows as isize).into(), (from..to).into()]);
        CubeBackend::float_reshape(columns, shape)
    }

    /// The gradient of tensor `k` of a scene but the left rotations and the pose.
    pub(super) fn scene(&self, k: usize, shape: Shape) -> CubeTensor {
        let columns = match k {
            0 => 0..3,
            1 => 3..7,
            3 => 7..10,
            4 => 10..11,
            5 => return self.sh.clone(),
            _ => unreachable!("left rotations and poses have tables of their own"),
        };
        Self::columns(&self.shapes, self.rows, V_SHAPE, columns, shape)
    }

    /// Of tensor `k` of what moves: means or left rotations.
    pub(super) fn moving(&self, k: usize, shape: Shape) -> CubeTensor {
        let rows = self.samples * self.moving;
        if rows == 0 {
            return CubeBackend::float_reshape(zeros(&self.shapes, [0]), shape);
        }
        let columns = if k == 0 { 0..3 } else { 3..V_MOVED };
        Self::columns(&self.moved, rows, V_MOVED, columns, shape)
    }

    /// Of the samples' poses.
    pub(super) fn poses(&self, shape: Shape) -> CubeTensor {
        CubeBackend::float_reshape(self.poses.clone(), shape)
    }

    /// Of the pose from which colours are seen.
    pub(super) fn color_pose(&self, shape: Shape) -> CubeTensor {
        CubeBackend::float_reshape(self.color_pose.clone(), shape)
    }

    /// The statistic of density control.
    pub(super) fn screen(&self) -> CubeTensor {
        let shape = [self.rows].into();
        Self::columns(&self.shapes, self.rows, V_SHAPE, SCREEN..SCREEN + 1, shape)
    }

    /// Of the features of a render.
    pub(super) fn features(&self, shape: Shape) -> CubeTensor {
        let width = GEOMETRIC + self.channels + 1;
        let columns = GEOMETRIC + 4..width - 1;
        let length = self.rows * width;
        let sums = CubeBackend::float_slice(self.sums.clone(), &[(0..length as isize).into()]);
        Self::columns(&sums, self.rows, width, columns, shape)
    }
}
