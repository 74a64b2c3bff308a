//! Rigid motions from six numbers each.

use burn::tensor::Tensor;
use host::product;

/// Numbers of a rigid motion: a turn (about rad, see [`moved`]) and a translation (scene sizes), in the camera's axes.
pub const RIGID: usize = 6;

/// A pose [3, 4] behind rigid motions [n, 6], in the camera's axes: turns and translations in units of `size`. Returns
/// [n, 3, 4].
///
/// A turn is an axis times twice the tangent of half the angle (Cayley): in rad, but for a twelfth of its third power.
#[must_use]
#[expect(
    clippy::disallowed_methods,
    reason = "of the pose only what a small turn changes is multiplied"
)]
pub fn moved(motions: Tensor<2>, pose: &Tensor<2>, size: f64) -> Tensor<3> {
    let [n, _] = motions.dims();
    let pose = pose.clone().reshape([1, 3, 4]);
    let change = turns_away(motions.clone().narrow(1, 0, 3)).matmul(pose.clone().expand([n, 3, 4]));
    let turned = pose + change;
    let shift = (motions.narrow(1, 3, 3) * size).reshape([n, 3, 1]);
    Tensor::cat(
        vec![
            turned.clone().narrow(2, 0, 3),
            turned.narrow(2, 3, 1) + shift,
        ],
        2,
    )
}

/// How far a rigid motion of a camera shifts what is ahead at the depth S in the image, focal lengths (x, y).
#[must_use]
pub fn shift_of(motion: [f64; RIGID]) -> [f64; 2] {
    // A turn of (x, y) shifts it by (y, -x), a translation of one S by one.
    [motion[1] + motion[3], motion[4] - motion[0]]
}

/// The turn of a camera that shifts all that is ahead by so much, focal lengths (x, y).
#[must_use]
pub fn turn_of([x, y]: [f64; 2]) -> [f64; RIGID] {
    [-y, x, 0.0, 0.0, 0.0, 0.0]
}

/// [`shift_of`] of rigid motions [n, 6]: [n, 2].
#[must_use]
pub fn shift_in_image(motions: Tensor<2>) -> Tensor<2> {
    let options = (&motions.device(), motions.dtype());
    let rows: [[f64; 2]; RIGID] = std::array::from_fn(|number| {
        let mut one = [0.0; RIGID];
        one[number] = 1.0;
        shift_of(one)
    });
    product(motions, Tensor::from_data(rows, options))
}

/// [`turn_of`] of shifts [n, 2]: rigid motions [n, 6].
#[must_use]
pub fn turns(shifts: Tensor<2>) -> Tensor<2> {
    let options = (&shifts.device(), shifts.dtype());
    let rows = [[1.0, 0.0], [0.0, 1.0]].map(turn_of);
    product(shifts, Tensor::from_data(rows, options))
}

/// Rotations [n, 3, 3] of turns [n, 3], less the identity: (1 + W/2) (1 - W/2)⁻¹ - 1 for W = [w]x, which is
/// (W + W²/2) / (1 + |w|²/4).
///
/// Without a sine: that of a GPU may be off by 2⁻¹¹, which is all of a turn of a hand that shakes. So may its products of matrices,
/// which are off by as much of what a turn changes.
#[expect(
    clippy::disallowed_methods,
    reason = "turns are small, and what a GPU rounds is a share of them"
)]
fn turns_away(vectors: Tensor<2>) -> Tensor<3> {
    let [n, _] = vectors.dims();
    let options = (&vectors.device(), vectors.dtype());
    // w -> [w]x, row-major.
    let generators = [
        [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    ];
    let cross = vectors
        .clone()
        .matmul(Tensor::from_data(generators, options))
        .reshape([n, 3, 3]);
    let squared = cross.clone().matmul(cross.clone());
    let divisor = vectors.square().sum_dim(1) * 0.25 + 1.0;
    (cross + squared * 0.5) / divisor.reshape([n, 1, 1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{DType, Device, TensorData};

    fn of(vectors: Vec<f64>, dtype: DType) -> Vec<f64> {
        let (n, options) = (vectors.len() / 3, (&Device::flex(), dtype));
        let turns = Tensor::<2>::from_data(TensorData::new(vectors, [n, 3]), options);
        let motions = Tensor::cat(vec![turns, Tensor::zeros([n, 3], options)], 1);
        let pose = [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ];
        let rotations = moved(motions, &Tensor::from_data(pose, options), 1.0).narrow(2, 0, 3);
        rotations.try_into_vec_as::<f64>().expect("f64")
    }

    #[test]
    fn they_are_rotations_by_the_angle_around_the_axis() {
        for angle in [0.0, 1e-9, 1e-4, 0.3, 3.0] {
            let axis = [0.48, -0.6, 0.64];
            let turn = axis.map(|a| a * 2.0 * f64::tan(angle / 2.0)).to_vec();
            let r = of(turn.clone(), DType::F64);
            for i in 0..3 {
                for j in 0..3 {
                    let dot: f64 = (0..3).map(|k| r[3 * i + k] * r[3 * j + k]).sum();
                    let expected = f64::from(u8::from(i == j));
                    assert!((dot - expected).abs() < 1e-14, "{angle}: rows {i} {j}");
                }
                let turned: f64 = (0..3).map(|k| r[3 * i + k] * axis[k]).sum();
                assert!((turned - axis[i]).abs() < 1e-14, "{angle}: the axis stays");
            }
            assert!(
                (r[0] + r[4] + r[8] - 1.0 - 2.0 * f64::cos(angle)).abs() < 1e-14,
                "{angle}"
            );
            let single = of(turn, DType::F32);
            let errors = r.iter().zip(&single).map(|(a, b)| (a - b).abs());
            // NaN is the largest of all.
            let error = errors.max_by(f64::total_cmp).expect("nine entries");
            assert!(error < 3e-7, "f32, {angle}: {error:e}");
        }
    }
}
