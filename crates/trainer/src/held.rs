//! Pixels that are held back from training, to tell how well it does on what it was not shown.

use crate::random::{Purpose, generator, sample};
use crate::settings::Settings;
use io::Scene;

/// Side of a block, px of a picture 256 wide.
const SIDE: f64 = 8.0;

/// Which pixels of every frame are learned from; empty where none is held back.
pub(crate) fn learned(scene: &Scene, settings: &Settings) -> Vec<Vec<bool>> {
    let share = settings.frames.held_back;
    if share == 0.0 {
        return Vec::new();
    }
    let cameras = scene.frames.iter().map(|f| &f.view.camera).enumerate();
    cameras
        .map(|(frame, c)| learned_pixels([c.width, c.height], share, settings.seed, frame))
        .collect()
}

/// Which pixels of a frame are learned from, [H, W]: all but those in `share` of its blocks, at least one, drawn by seed and frame.
fn learned_pixels([width, height]: [usize; 2], share: f64, seed: u64, frame: usize) -> Vec<bool> {
    let side = ((SIDE * width as f64 / 256.0).round() as usize).max(2);
    let (across, down) = (width.div_ceil(side), height.div_ceil(side));
    let count = ((share * (across * down) as f64).round() as usize).max(1);
    let mut rng = generator(seed, Purpose::HeldBack, frame as u64);
    let mut learned = vec![true; width * height];
    for block in sample(&mut rng, across * down, count) {
        let (left, top) = (block % across * side, block / across * side);
        for y in top..(top + side).min(height) {
            learned[y * width + left..y * width + (left + side).min(width)].fill(false);
        }
    }
    learned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_blocks_are_held_back_and_others_in_another_frame() {
        let (width, height) = (256, 144);
        let learned = learned_pixels([width, height], 0.03, 1, 0);
        let held = learned.iter().filter(|l| !**l).count();
        assert_eq!(held, 17 * 64, "3 % of 32 x 18 blocks of 8 x 8");
        for (at, l) in learned.iter().enumerate() {
            let (x, y) = (at % width, at / width);
            let first = (y / 8 * 8) * width + x / 8 * 8;
            assert_eq!(*l, learned[first], "({x}, {y}) and its block's corner");
        }
        assert_eq!(learned, learned_pixels([width, height], 0.03, 1, 0));
        for (seed, frame) in [(1, 1), (2, 0)] {
            assert_ne!(learned, learned_pixels([width, height], 0.03, seed, frame));
        }
    }

    #[test]
    fn sizes_that_no_block_divides_keep_their_size() {
        for (width, height) in [(1, 1), (7, 3), (130, 71)] {
            let learned = learned_pixels([width, height], 0.05, 1, 0);
            assert_eq!(learned.len(), width * height);
            assert!(learned.contains(&false), "{width} x {height}");
        }
    }
}
