//! Pixels of a tile in blocks of 4 x 4, one block after the other: vectors of 16, 8 or 4 values hold
//! neighbouring pixels of a Gaussian's round footprint, where rows of a tile would be mostly empty.

use std::ops::Range;

use super::constants::TILE;
use super::real::Real;

/// Side of a block in pixels.
const SIDE: usize = 4;
/// Blocks along a side of a tile.
pub(super) const ACROSS: usize = TILE / SIDE;
/// Blocks in a tile.
pub(super) const BLOCKS: usize = ACROSS * ACROSS;
/// Pixels in a block.
pub(super) const BLOCK: usize = SIDE * SIDE;

/// One value for each pixel of a tile.
pub(super) type Pixels<T> = [[T; BLOCK]; BLOCKS];

/// Block and place in it of the pixel in row `y` and column `x` of a tile.
#[inline(always)]
pub(super) fn place(y: usize, x: usize) -> (usize, usize) {
    (y / SIDE * ACROSS + x / SIDE, y % SIDE * SIDE + x % SIDE)
}

/// Positions of the pixel centres of a tile whose corner is at (left, top), px.
pub(super) fn centers<T: Real>(left: usize, top: usize) -> [Pixels<T>; 2] {
    let mut centers = [[[T::ZERO; BLOCK]; BLOCKS]; 2];
    for (y, x) in (0..TILE).flat_map(|y| (0..TILE).map(move |x| (y, x))) {
        let (block, lane) = place(y, x);
        centers[0][block][lane] = T::of((left + x) as f64 + 0.5);
        centers[1][block][lane] = T::of((top + y) as f64 + 0.5);
    }
    centers
}

/// The blocks along one side of a tile, which begins at pixel `first`, that the pixels [from, to) meet.
#[inline(always)]
pub(super) fn blocks_under([from, to]: [u16; 2], first: usize) -> Range<usize> {
    let from = usize::from(from).saturating_sub(first) / SIDE;
    let to = usize::from(to).saturating_sub(first).div_ceil(SIDE);
    from..to.min(ACROSS)
}

/// Values per channel whose number is known at compile time where it is small: the compiler then
/// keeps them in registers.
pub(super) trait PerChannel<V> {
    fn values(&mut self) -> &mut [V];
}

impl<V, const C: usize> PerChannel<V> for [V; C] {
    #[inline(always)]
    fn values(&mut self) -> &mut [V] {
        self
    }
}

impl<V> PerChannel<V> for Vec<V> {
    #[inline(always)]
    fn values(&mut self) -> &mut [V] {
        self
    }
}
