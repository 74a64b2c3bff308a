//! What a convolution has beside its products ([`super::product`]).

use cubecl::prelude::*;

/// The gradient where ReLU let through.
#[cube(launch)]
pub(crate) fn relu_backward_kernel(gradient: &[f32], output: &[f32], masked: &mut [f32]) {
    let at = ABSOLUTE_POS;
    if at < masked.len() {
        masked[at] = select(output[at] > 0.0, gradient[at], 0.0);
    }
}
