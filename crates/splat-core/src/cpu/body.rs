//! The shape of Gaussians in the world, several at a time: what no camera changes.

use std::ops::Range;

use pulp::Simd;

use super::matrices::mul3;
use super::packs::{Number, Pack, Where, array};
use super::real::Real;
use super::types::SplatSlices;

/// Below this a quaternion's norm counts as this much: a zero quaternion is the identity.
pub(crate) const NORM_FLOOR: f64 = 1e-12;

/// What the projection of Gaussians reads.
pub(super) struct Shapes<T: Real, S: Simd> {
    pub(super) mean: [Pack<T, S>; 3],
    quat: [Pack<T, S>; 4],
    /// Matrix multiplied from the left of the quaternion's, where one of them has it.
    pub(super) left: Option<[Pack<T, S>; 9]>,
    log_scale: [Pack<T, S>; 3],
}

/// Column `k` of a row-major table, for rows that are repeated where a vector has more.
#[inline(always)]
pub(super) fn column<T: Real, S: Simd>(
    simd: S,
    table: &[T],
    width: usize,
    rows: &Range<usize>,
    k: usize,
) -> Pack<T, S> {
    let table = &table[rows.start * width..rows.end * width];
    let last = rows.len() - 1;
    Pack::from_fn(
        simd,
        #[inline(always)]
        |l| table[l.min(last) * width + k],
    )
}

impl<T: Real, S: Simd> Shapes<T, S> {
    /// Of the Gaussians in `rows`, as many as a vector has or fewer.
    #[inline(always)]
    pub(super) fn new(simd: S, splats: &SplatSlices<'_, T>, rows: &Range<usize>) -> Self {
        let num_left = splats.num_left();
        let left = (rows.start < num_left).then(|| {
            array(
                #[inline(always)]
                |k| {
                    let identity = if k % 4 == 0 { T::ONE } else { T::ZERO };
                    Pack::from_fn(
                        simd,
                        #[inline(always)]
                        |l| {
                            let row = rows.start + l;
                            if row < num_left {
                                splats.left_rotations[9 * row + k]
                            } else {
                                identity
                            }
                        },
                    )
                },
            )
        });
        Self {
            mean: array(
                #[inline(always)]
                |k| column(simd, splats.means, 3, rows, k),
            ),
            quat: array(
                #[inline(always)]
                |k| column(simd, splats.quats, 4, rows, k),
            ),
            left,
            log_scale: array(
                #[inline(always)]
                |k| column(simd, splats.log_scales, 3, rows, k),
            ),
        }
    }
}

/// Where Gaussians are in the world: all that a projection reads.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed<T: Real, S: Simd> {
    pub(super) mean: [Pack<T, S>; 3],
    /// left * quaternion, row-major.
    pub(super) rotation: [Pack<T, S>; 9],
    pub(super) scale: [Pack<T, S>; 3],
}

/// Where Gaussians are in the world, and what led to it.
#[derive(Clone, Debug)]
pub(super) struct Body<T: Real, S: Simd> {
    /// Unit quaternion, the divisor that made it, and whether that was more than the floor.
    unit: [Pack<T, S>; 4],
    norm: Pack<T, S>,
    above_floor: Where<T, S>,
    /// Matrix of the quaternion, row-major.
    pub(super) quat_matrix: [Pack<T, S>; 9],
    pub(super) placed: Placed<T, S>,
}

impl<T: Real, S: Simd> Body<T, S> {
    #[inline(always)]
    pub(super) fn new(simd: S, shapes: &Shapes<T, S>) -> Self {
        let n = |value| Pack::splat(simd, T::of(value));
        let Shapes {
            mean,
            quat,
            left,
            log_scale,
        } = shapes;
        // Scaled by the largest entry first, so that neither large nor small entries leave the range.
        let floor = n(NORM_FLOOR);
        let largest = (quat[0].abs().max(quat[1].abs())).max(quat[2].abs().max(quat[3].abs()));
        let above_floor = floor.less(largest);
        let q: [_; 4] = array(
            #[inline(always)]
            |k| quat[k] / largest,
        );
        let length = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
        // Under the floor the vector part shrinks to nothing and the matrix to the identity.
        let unit: [_; 4] = array(
            #[inline(always)]
            |k| above_floor.select(q[k] / length, quat[k] / floor),
        );
        let norm = above_floor.select(length * largest, floor);
        let quat_matrix = quaternion_matrix(unit);
        let rotation = match left {
            Some(left) => mul3(left, &quat_matrix),
            None => quat_matrix,
        };
        let scale: [_; 3] = array(
            #[inline(always)]
            |k| log_scale[k].map(T::exp),
        );
        Self {
            unit,
            norm,
            above_floor,
            quat_matrix,
            placed: Placed {
                mean: *mean,
                rotation,
                scale,
            },
        }
    }
}

#[inline(always)]
fn quaternion_matrix<N: Number>([w, x, y, z]: [N; 4]) -> [N; 9] {
    let one = w.like(1.0);
    let two = w.like(2.0);
    [
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    ]
}

/// Gradient of unnormalised quaternions from that of their matrices.
#[inline(always)]
pub(super) fn quaternion_gradient<T: Real, S: Simd>(
    body: &Body<T, S>,
    v: &[Pack<T, S>; 9],
) -> [Pack<T, S>; 4] {
    let [w, x, y, z] = body.unit;
    let two = w.like(2.0);
    let (s01, s02, s12) = (v[1] + v[3], v[2] + v[6], v[5] + v[7]);
    let (a21, a02, a10) = (v[7] - v[5], v[2] - v[6], v[3] - v[1]);
    let unit = [
        two * (x * a21 + y * a02 + z * a10),
        two * (y * s01 + z * s02 + w * a21 - two * x * (v[4] + v[8])),
        two * (x * s01 + z * s12 + w * a02 - two * y * (v[0] + v[8])),
        two * (x * s02 + y * s12 + w * a10 - two * z * (v[0] + v[4])),
    ];
    let along = w * unit[0] + x * unit[1] + y * unit[2] + z * unit[3];
    let along = body.above_floor.select(along, w.like(0.0));
    array(
        #[inline(always)]
        |k| (unit[k] - body.unit[k] * along) / body.norm,
    )
}
