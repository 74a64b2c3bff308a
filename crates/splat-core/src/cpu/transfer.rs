//! Between the values of a picture and light: blur is an average of light.

use pulp::Simd;

use super::packs::{Number as _, Pack};
use super::real::Real;

/// How a picture's values stand for light.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Transfer {
    /// The curve of sRGB (IEC 61966-2-1), exactly.
    #[default]
    Srgb,
    /// light = value^gamma, with sRGB's straight start, so that black has a finite slope.
    Power(f64),
    /// Values are light.
    Linear,
}

/// Where sRGB's straight start ends, in values of the picture.
pub(crate) const TOE: f64 = 0.04045;
/// Above this (white is 1) a curve goes on as its tangent: what no picture holds need not overflow.
pub(crate) const KNEE: f64 = 4.0;
/// Values above this count as this.
pub(crate) const LARGEST: f64 = 1e30;

impl Transfer {
    /// Light of a value that is not negative, and the slope there.
    #[inline(always)]
    pub(super) fn decode<T: Real, S: Simd>(self, value: Pack<T, S>) -> [Pack<T, S>; 2] {
        let n = |v| value.like(v);
        match self {
            Self::Linear => [value, n(1.0)],
            Self::Srgb => {
                let inside = value.min(n(KNEE));
                let u = (inside + n(0.055)) / n(1.055);
                let root = two_fifths(u);
                let slope = n(2.4 / 1.055) * u * root;
                let light = u * u * root + slope * (value.min(n(LARGEST)) - inside);
                let toe = value.less(n(TOE));
                [
                    toe.select(value / n(12.92), light),
                    toe.select(n(1.0 / 12.92), slope),
                ]
            }
            Self::Power(gamma) => {
                let (inside, toe) = (value.min(n(KNEE)), TOE.powf(gamma - 1.0));
                let slope = inside.max(n(TOE)).map(
                    #[inline(always)]
                    |v| T::of(gamma * v.to_f64().powf(gamma - 1.0)),
                );
                let light = inside * slope / n(gamma) + slope * (value.min(n(LARGEST)) - inside);
                let is_toe = value.less(n(TOE));
                [
                    is_toe.select(value * n(toe), light),
                    is_toe.select(n(toe), slope),
                ]
            }
        }
    }

    /// The value of a light that is not negative.
    #[inline(always)]
    pub(super) fn encode<T: Real, S: Simd>(self, light: Pack<T, S>) -> Pack<T, S> {
        let power = |v: Pack<T, S>, exponent: f64| {
            v.map(
                #[inline(always)]
                |v| (v.ln() * T::of(exponent)).exp(),
            )
        };
        let n = |v| light.like(v);
        let [knee, slope] = self.decode(n(KNEE));
        let over = (light - light.min(knee)) / slope;
        match self {
            Self::Linear => light,
            Self::Srgb => {
                let start = n(TOE / 12.92);
                let curved = power(light.min(knee).max(start), 1.0 / 2.4);
                let value = n(1.055) * curved - n(0.055) + over;
                light.less(start).select(n(12.92) * light, value)
            }
            Self::Power(gamma) => {
                let start = n(TOE.powf(gamma));
                let value = power(light.min(knee).max(start), 1.0 / gamma) + over;
                let toe = n(TOE.powf(1.0 - gamma));
                light.less(start).select(toe * light, value)
            }
        }
    }
}

/// u^(2/5) for u of 0.04 to 10, to the last places, with square roots and divisions only.
#[inline(always)]
fn two_fifths<T: Real, S: Simd>(u: Pack<T, S>) -> Pack<T, S> {
    let n = |v| u.like(v);
    let fourth = u.sqrt().sqrt();
    // u^(3/8) is within 9 %. A step of Halley's for y⁵ = u² leaves 2 e³ of a relative error e.
    let mut y = fourth * fourth.sqrt();
    let square = u * u;
    for _ in 0..if size_of::<T>() == 4 { 2 } else { 3 } {
        let y2 = y * y;
        let y5 = y2 * y2 * y;
        y = y * ((n(2.0) * y5 + n(3.0) * square) / (n(3.0) * y5 + n(2.0) * square));
    }
    y
}

#[cfg(test)]
mod tests {
    use super::super::packs::WIDEST;
    use super::*;
    use pulp::{Arch, WithSimd};

    /// Light, slope, and what the light is encoded as.
    struct Both<T>(Transfer, T);

    impl<T: Real> WithSimd for Both<T> {
        type Output = [T; 3];

        fn with_simd<S: Simd>(self, simd: S) -> [T; 3] {
            let [light, slope] = self.0.decode(Pack::load(simd, &[self.1; WIDEST]));
            [light, slope, self.0.encode(light)].map(|pack| pack.to_array()[0])
        }
    }

    fn both<T: Real>(transfer: Transfer, value: T) -> [T; 3] {
        Arch::new().dispatch(Both(transfer, value))
    }

    #[test]
    fn srgb_is_the_standards_curve() {
        for k in 0..=4000 {
            let value = f64::from(k) * 1e-3;
            let expected = if value <= 0.04045 {
                value / 12.92
            } else {
                ((value + 0.055) / 1.055).powf(2.4)
            };
            let [light, ..] = both(Transfer::Srgb, value);
            assert!((light - expected).abs() <= 4e-15 * expected, "f64, {value}");
            let [light, ..] = both(Transfer::Srgb, value as f32);
            let error = (f64::from(light) - expected).abs();
            assert!(error <= 1e-6 * expected, "f32, {value}: {error:e}");
        }
    }

    #[test]
    fn light_is_encoded_as_the_value_it_came_from_and_the_slope_is_its_derivative() {
        for transfer in [Transfer::Srgb, Transfer::Power(2.2), Transfer::Linear] {
            for value in [0.0_f64, 1e-3, 0.03, 0.1, 0.5, 1.0, 3.0, 7.0, 1e4] {
                let [_, slope, back] = both(transfer, value);
                // The standard's constants meet to eight digits.
                assert!(
                    (back - value).abs() <= 1e-7 * value,
                    "{transfer:?} {value}: {back}"
                );
                let step = 1e-6 * (1.0 + value);
                let at = |value| both(transfer, value)[0];
                let numeric = (at(value + step) - at((value - step).max(0.0)))
                    / (value + step - (value - step).max(0.0));
                let error = (numeric - slope).abs();
                assert!(
                    error < 1e-7 * slope,
                    "{transfer:?} {value}: {slope}, {numeric}"
                );
                let [_, _, back] = both(transfer, value as f32);
                assert!(
                    (f64::from(back) - value).abs() <= 1e-6 * value,
                    "f32 {value}: {back}"
                );
            }
            for value in [f32::MAX, 1e20] {
                let [light, slope, back] = both(transfer, value);
                assert!(
                    light.is_finite() && slope.is_finite() && back.is_finite(),
                    "{value}"
                );
            }
        }
    }
}
