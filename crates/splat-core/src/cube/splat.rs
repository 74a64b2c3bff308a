//! Items as projection leaves them.

use cubecl::prelude::*;

/// Numbers of a projected item: mean 2, l11, l21, l22, opacity (0 for one that cannot be seen), depth, colour 3, where alpha
/// ends (sigma), half the size of its box 2, radius.
pub(crate) const SPLAT: usize = 14;
pub(crate) const OPACITY: usize = 5;
pub(crate) const DEPTH: usize = 6;
pub(crate) const COLOR: usize = 7;
pub(super) const SIGMA_MAX: usize = 10;
pub(super) const HALF: usize = 11;
pub(super) const RADIUS: usize = 13;

/// Pixels or tiles [from, to).
#[derive(CubeType, CubeTypeMut, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Span {
    pub(super) from: u32,
    pub(super) to: u32,
}

/// The pixels of a line of `count` whose centres lie in [low, high]; none where one is not a number.
#[cube]
pub(super) fn pixel_range(low: f32, high: f32, count: u32) -> Span {
    let limit = count as f32;
    let first = (low - 0.5).max(0.0);
    let last = (high + 0.5).min(limit);
    let some = low < limit + 1.0 && high + 1.0 > 0.0 && first < limit && last > 0.0;
    Span {
        from: select(some, first.ceil(), 0.0f32) as u32,
        to: select(some, last.floor(), 0.0f32) as u32,
    }
}
