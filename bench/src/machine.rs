//! What the machine can do at most: arithmetic in registers, and copies of memory.

use std::time::Instant;

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;
use serde::Serialize;

/// Measured peaks of all threads together.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Machine {
    /// Threads of the pool.
    pub threads: usize,
    /// f32 additions and multiplications, in fused pairs on registers, GFLOP/s.
    pub gflops: f64,
    /// Bytes read and written by a large copy, GB/s.
    pub gigabytes: f64,
}

impl Machine {
    /// Measures the peaks; takes about a second.
    #[must_use]
    pub fn measure() -> Self {
        Self {
            threads: rayon::current_num_threads(),
            gflops: best_of(5, arithmetic),
            gigabytes: best_of(5, copy),
        }
    }

    /// The least time in ms that so many operations and bytes take.
    #[must_use]
    pub fn floor_ms(&self, operations: f64, bytes: f64) -> f64 {
        (operations / self.gflops).max(bytes / self.gigabytes) * 1e-6
    }
}

fn best_of(count: usize, measure: impl Fn() -> f64) -> f64 {
    (0..count).map(|_| measure()).fold(0.0, f64::max)
}

/// Chains of fused multiply-adds that run side by side: enough to hide their latency.
const CHAINS: usize = 12;
const ROUNDS: usize = 4_000_000;

struct Chains;

impl WithSimd for Chains {
    /// A number that depends on all results, and the lanes of a vector.
    type Output = (f32, usize);

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> (f32, usize) {
        let (a, b) = (simd.splat_f32s(0.999), simd.splat_f32s(0.001));
        let mut chains = [simd.splat_f32s(0.5); CHAINS];
        for _ in 0..ROUNDS {
            for chain in &mut chains {
                *chain = simd.mul_add_e_f32s(*chain, a, b);
            }
        }
        let total = chains.iter().map(|c| simd.reduce_sum_f32s(*c)).sum();
        (total, S::F32_LANES)
    }
}

fn arithmetic() -> f64 {
    let start = Instant::now();
    let operations: usize = (0..rayon::current_num_threads())
        .into_par_iter()
        .with_max_len(1)
        .map(|_| {
            let (total, lanes) = std::hint::black_box(Arch::new().dispatch(Chains));
            assert!(total.is_finite(), "each chain tends to 1");
            2 * ROUNDS * CHAINS * lanes
        })
        .sum();
    operations as f64 / start.elapsed().as_secs_f64() * 1e-9
}

fn copy() -> f64 {
    const PIECE: usize = 1 << 20;
    let source = vec![1_u64; 32 * PIECE];
    let mut target = vec![2_u64; source.len()];
    let start = Instant::now();
    target
        .par_chunks_mut(PIECE)
        .zip(source.par_chunks(PIECE))
        .for_each(|(target, source)| target.copy_from_slice(source));
    let seconds = start.elapsed().as_secs_f64();
    assert_eq!(
        std::hint::black_box(&target)[PIECE],
        1,
        "the copy is not optimised away"
    );
    2.0 * size_of_val(source.as_slice()) as f64 / seconds * 1e-9
}
