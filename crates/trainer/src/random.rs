//! Random numbers keyed by (seed, purpose, index): no generator state to store in a checkpoint.

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

/// What a generator is for; each purpose has a stream of its own.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    /// Choice of pixels for static Gaussians; indexed by frame.
    Placement = 1,
    /// Choice of tracks; indexed by query frame.
    Tracks = 2,
    /// Order of the training views; indexed by epoch.
    TrainOrder = 3,
    /// Order of the unseen views; indexed by epoch.
    UnseenOrder = 4,
    /// Distances of the perpendicular views; indexed by view.
    UnseenOffset = 5,
    /// Children of split Gaussians; indexed by iteration.
    Split = 6,
    /// Choice of pixels in dynamic densification; indexed by frame.
    DynamicDensification = 7,
    /// Motion bases' clustering.
    Motion = 8,
    /// Weights of the blur model.
    BlurModel = 9,
    /// Pixels that are held back; indexed by frame.
    HeldBack = 10,
}

/// The generator of a purpose at an index.
pub(crate) fn generator(seed: u64, purpose: Purpose, index: u64) -> ChaCha8Rng {
    let mut key = [0_u8; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&(purpose as u64).to_le_bytes());
    key[16..24].copy_from_slice(&index.to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

/// A seed for code that takes one number.
pub(crate) fn derived_seed(seed: u64, purpose: Purpose) -> u64 {
    rand::Rng::next_u64(&mut generator(seed, purpose, 0))
}

/// A permutation of 0..n (Fisher–Yates).
pub(crate) fn permutation(rng: &mut ChaCha8Rng, n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    for i in (1..n).rev() {
        order.swap(i, below(rng, i + 1));
    }
    order
}

/// `count` different numbers below `n`, ascending; all of them where `count >= n`.
pub(crate) fn sample(rng: &mut ChaCha8Rng, n: usize, count: usize) -> Vec<usize> {
    if count >= n {
        return (0..n).collect();
    }
    let mut order: Vec<usize> = (0..n).collect();
    for i in 0..count {
        let j = i + below(rng, n - i);
        order.swap(i, j);
    }
    order.truncate(count);
    order.sort_unstable();
    order
}

/// A uniform number below `n` (n > 0). The bias of the multiplication is under n / 2^64.
pub(crate) fn below(rng: &mut ChaCha8Rng, n: usize) -> usize {
    let wide = u128::from(rand::Rng::next_u64(rng)) * n as u128;
    usize::try_from(wide >> 64).expect("less than n")
}

/// A uniform number in [0, 1).
pub(crate) fn unit(rng: &mut ChaCha8Rng) -> f64 {
    (rand::Rng::next_u64(rng) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_gives_the_same_numbers_and_another_key_others() {
        let draw = |seed, purpose, index| unit(&mut generator(seed, purpose, index));
        assert_eq!(draw(1, Purpose::Split, 7), draw(1, Purpose::Split, 7));
        assert_ne!(draw(1, Purpose::Split, 7), draw(1, Purpose::Split, 8));
        assert_ne!(draw(1, Purpose::Split, 7), draw(2, Purpose::Split, 7));
        assert_ne!(draw(1, Purpose::Split, 7), draw(1, Purpose::Tracks, 7));
    }

    #[test]
    fn permutations_and_samples_hold_each_number_once() {
        let mut rng = generator(3, Purpose::TrainOrder, 0);
        let mut order = permutation(&mut rng, 50);
        order.sort_unstable();
        assert_eq!(order, (0..50).collect::<Vec<_>>());
        let drawn = sample(&mut rng, 1000, 100);
        assert_eq!(drawn.len(), 100);
        assert!(drawn.windows(2).all(|w| w[0] < w[1]) && drawn[99] < 1000);
        assert_eq!(sample(&mut rng, 5, 9), vec![0, 1, 2, 3, 4]);
    }
}
