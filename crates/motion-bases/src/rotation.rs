//! From six numbers to a rotation: Gram–Schmidt on two vectors (Zhou et al. 2019).
//!
//! `x = a1 / |a1|`, `z = (x × a2) / |x × a2|`, `y = z × x`, which is the usual
//! `y = (a2 - (a2·x) x) / |…|`, `z = x × y` in another order. The columns of the rotation are x, y, z.
//!
//! For nearly parallel vectors the cross product loses digits, and with them its right angle to x:
//! what it has along x is taken off once more, and the result is a rotation to rounding at any angle.
//! How well it follows the input has a limit that lies in the input: a rounding of a1 or a2 turns it
//! by that rounding over the sine between them.
//!
//! Averaged 6D vectors can cancel out or become parallel. There the vector at fault is replaced by a
//! fixed axis, so that the result is always a rotation and every gradient finite.

use burn::tensor::Tensor;

/// A vector under this length has no direction. Gradients grow as one over length and sine: with
/// these limits they stay under 1e18, and their squares, which an optimiser may form, fit into f32.
pub(crate) const MIN_NORM: f64 = 1e-12;
/// Two vectors with a smaller sine between them count as parallel. (In f32 the sine is known to 2e-7.)
pub(crate) const MIN_SINE: f64 = 1e-6;
/// An x axis whose y component has a larger square lies near the y axis.
pub(crate) const NEAR_Y_AXIS: f64 = 0.8;
/// Larger entries are clamped, so that squares of squares fit into f32.
pub(crate) const MAX_ENTRY: f64 = 1e9;

/// A vector per element: three tensors of one shape.
type Components = [Tensor<2>; 3];

/// Rotations [F, 3, 3] from 6D vectors [F, 6]; columns are x, y, z.
///
/// - Where |a1| (the first three numbers) is under 1e-12, a1 is taken as (1, 0, 0).
/// - Where the part of a2 across a1 is under 1e-6 |a2|, or under 1e-18, a2 is taken as (0, 1, 0), or as
///   (0, 0, 1) where x lies within 26° of the y axis.
///
/// The gradient of a vector that was replaced is zero. Entries beyond ±1e9 are clamped.
#[must_use]
pub fn gram_schmidt(six: Tensor<2>) -> Tensor<3> {
    let [rows, _] = six.dims();
    let six = six.clamp(-MAX_ENTRY, MAX_ENTRY).transpose(); // [6, F]
    let row = |c: usize| six.clone().slice_dim(0, c..c + 1); // [1, F]
    let [x, y, z] = orthonormal_columns([row(0), row(1), row(2)], [row(3), row(4), row(5)]);
    let ([x0, x1, x2], [y0, y1, y2], [z0, z1, z2]) = (x, y, z);
    Tensor::cat(vec![x0, y0, z0, x1, y1, z1, x2, y2, z2], 0)
        .transpose()
        .reshape([rows, 3, 3])
}

/// Gram–Schmidt element by element, on vectors whose components are tensors of one shape with
/// entries within ±[`MAX_ENTRY`]. Returns the columns x, y, z.
fn orthonormal_columns(a1: Components, a2: Components) -> [Components; 3] {
    let no_direction = square_norm(&detached(&a1)).lower_elem(MIN_NORM * MIN_NORM);
    let [ax, ay, az] = a1;
    let a1 = [
        ax.mask_fill(no_direction.clone(), 1.0),
        ay.mask_fill(no_direction.clone(), 0.0),
        az.mask_fill(no_direction, 0.0),
    ];
    let x = normalized(a1);

    // Only a2's direction counts, so that its length is a constant to the gradient.
    let length = square_norm(&detached(&a2))
        .clamp_min(MIN_NORM * MIN_NORM)
        .sqrt();
    let a2 = scaled(a2, &length.recip());
    let x_fixed = detached(&x);
    let parallel = square_norm(&cross(&x_fixed, &detached(&a2))).lower_elem(MIN_SINE * MIN_SINE);
    let x_near_y_axis = x_fixed[1].clone().square().greater_elem(NEAR_Y_AXIS);
    let z_axis = x_fixed[1].zeros_like().mask_fill(x_near_y_axis, 1.0);
    let y_axis = z_axis.clone().neg() + 1.0;
    let [ax, ay, az] = a2;
    let a2 = [
        ax.mask_fill(parallel.clone(), 0.0),
        ay.mask_where(parallel.clone(), y_axis),
        az.mask_where(parallel, z_axis),
    ];

    let [cx, cy, cz] = cross(&x, &a2);
    let along = cx.clone() * x[0].clone() + cy.clone() * x[1].clone() + cz.clone() * x[2].clone();
    let [rx, ry, rz] = scaled(x.clone(), &along);
    let z = normalized([cx - rx, cy - ry, cz - rz]);
    let y = cross(&z, &x);
    [x, y, z]
}

fn detached(v: &Components) -> Components {
    [
        v[0].clone().detach(),
        v[1].clone().detach(),
        v[2].clone().detach(),
    ]
}

/// Squared length of each vector.
fn square_norm(v: &Components) -> Tensor<2> {
    v[0].clone().square() + v[1].clone().square() + v[2].clone().square()
}

fn normalized(v: Components) -> Components {
    let inverse = square_norm(&v).sqrt().recip();
    scaled(v, &inverse)
}

fn scaled([x, y, z]: Components, factor: &Tensor<2>) -> Components {
    [x * factor.clone(), y * factor.clone(), z * factor.clone()]
}

fn cross(a: &Components, b: &Components) -> Components {
    let c = |i: usize, j: usize| a[i].clone() * b[j].clone() - a[j].clone() * b[i].clone();
    [c(1, 2), c(2, 0), c(0, 1)]
}
