//! Properties on random input that is the same in every run; for tests alone.

use arbtest::arbitrary::{Error, Result, Unstructured};
use arbtest::arbtest;

/// How many times more cases a long run tries.
const LONG: u64 = 20;
/// Random bytes of a case.
const BYTES: u64 = 1 << 16;

/// Tries `property` on `cases` random inputs; 20 times as many where the environment variable
/// `LIMPID_LONG_TESTS` is set to anything but nothing. The first ones are the same then.
///
/// The inputs depend on `name` and the number of the case alone. `property` panics where it does not
/// hold, and arbtest then prints the case's seed.
pub fn property(
    name: &str,
    cases: u64,
    mut property: impl FnMut(&mut Unstructured<'_>) -> Result<()>,
) {
    let long = std::env::var_os("LIMPID_LONG_TESTS").is_some_and(|value| !value.is_empty());
    for case in 0..cases * if long { LONG } else { 1 } {
        // The upper half of arbtest's seed is random, the lower half is the number of bytes.
        let seed = hash(name, case) << 32 | BYTES;
        arbtest(&mut property).seed(seed).run();
    }
}

/// A number in [low, high].
///
/// # Errors
/// When the case has no random bytes left; arbitrary alone would go on with zeros.
pub fn uniform(u: &mut Unstructured<'_>, low: f64, high: f64) -> Result<f64> {
    if u.len() < size_of::<u32>() {
        return Err(Error::NotEnoughData);
    }
    let part = f64::from(u.arbitrary::<u32>()?) / f64::from(u32::MAX);
    Ok(low + (high - low) * part)
}

/// FNV-1a over the name's bytes and the number's.
fn hash(name: &str, number: u64) -> u64 {
    name.bytes()
        .chain(number.to_le_bytes())
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        })
}
