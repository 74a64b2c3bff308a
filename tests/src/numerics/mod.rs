//! What f32 costs: every op in f32 against f64, on ordinary input and at the extremes.
//!
//! Both get the same inputs, numbers that f32 can hold. What is promised of a case: everything is finite, and the f32 result lies
//! within 8 times the spread of the f64 result over inputs moved by one unit in the last place of f32, plus a millionth.
//! (No arithmetic can beat the spread: f32 input does not know more.) `cargo xtask numerics` writes the figures to
//! docs/NUMERICS.md, and a test fails where one gets worse than that table.

mod blur;
mod case;
mod losses;
mod motion;
mod report;
mod splat;
mod splat_tensors;
mod stability;

pub use case::{Arrays, Case, Figures, Place, Results, Row, measure};
pub use report::{read_table, report};
pub use stability::{Measure, measures};

/// All cases of all ops.
#[must_use]
pub fn cases() -> Vec<Case> {
    let mut all = splat::cases();
    all.extend(motion::cases());
    all.extend(blur::cases());
    all.extend(losses::cases());
    all
}
