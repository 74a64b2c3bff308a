//! Vectors of the float types, with the instructions that the machine has.

use pulp::{Simd, WithSimd};

/// `f32` or `f64` in vectors: the operations of the inner loops.
pub trait Vectors: Sized {
    /// A vector of the machine.
    type Vector<S: Simd>: Copy + Send + Sync + bytemuck::Pod;
    /// The result of comparing two of them.
    type Mask<S: Simd>: Copy;
    /// Values in a vector.
    fn lanes<S: Simd>() -> usize {
        size_of::<Self::Vector<S>>() / size_of::<Self>()
    }
    /// The values as whole vectors; a rest is left out.
    fn vectors<S: Simd>(values: &[Self]) -> &[Self::Vector<S>];
    /// The values as whole vectors; a rest is left out.
    fn vectors_mut<S: Simd>(values: &mut [Self]) -> &mut [Self::Vector<S>];
    /// The value in all lanes.
    fn splat<S: Simd>(simd: S, value: Self) -> Self::Vector<S>;
    /// a + b.
    fn vadd<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// a - b.
    fn vsub<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// a b.
    fn vmul<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// a / b.
    fn vdiv<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S>;
    /// -a.
    fn vneg<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S>;
    /// |a|.
    fn vabs<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S>;
    /// Square root.
    fn vsqrt<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S>;
    /// a b + c.
    fn mul_add<S: Simd>(
        simd: S,
        a: Self::Vector<S>,
        b: Self::Vector<S>,
        c: Self::Vector<S>,
    ) -> Self::Vector<S>;
    /// a < b; false where one is not a number.
    fn less<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Mask<S>;
    /// Both.
    fn and<S: Simd>(simd: S, a: Self::Mask<S>, b: Self::Mask<S>) -> Self::Mask<S>;
    /// Whether the mask is set anywhere.
    fn any<S: Simd>(simd: S, mask: Self::Mask<S>) -> bool;
    /// `yes` where the mask is set, else `no`.
    fn select<S: Simd>(
        simd: S,
        mask: Self::Mask<S>,
        yes: Self::Vector<S>,
        no: Self::Vector<S>,
    ) -> Self::Vector<S>;
    /// Sum of the lanes, always in the same order.
    fn sum<S: Simd>(simd: S, a: Self::Vector<S>) -> Self;
    /// `exp(-x)` for `x >= 0`, as the inner loops use it.
    ///
    /// For `f32` it has no branch, a relative error under 2e-7 up to 80, and stays at `exp(-80)` beyond;
    /// for `f64` it is the library's.
    fn exp_neg<S: Simd>(simd: S, x: Self::Vector<S>) -> Self::Vector<S>;
}

/// Runs `work` with the machine's vectors. (pulp takes closures as they are too, but calls them in a way that is not always
/// inlined, and what is not knows nothing of the vectors.)
pub fn vectorized<R>(work: impl FnMut() -> R) -> R {
    struct Work<F>(F);
    impl<R, F: FnMut() -> R> WithSimd for Work<F> {
        type Output = R;
        #[inline(always)]
        fn with_simd<S: Simd>(mut self, _: S) -> R {
            (self.0)()
        }
    }
    pulp::Arch::new().dispatch(Work(work))
}

/// The operations on vectors that both float types have in one form.
macro_rules! vector_ops {
    (
        $vector:ident, $mask:ident, $as_simd:ident, $as_mut_simd:ident, $splat:ident, $add:ident, $sub:ident, $mul:ident,
        $div:ident, $neg:ident, $abs:ident, $sqrt:ident, $mul_add:ident, $less:ident, $first_true:ident, $and:ident, $select:ident, $sum:ident
    ) => {
        type Vector<S: Simd> = S::$vector;
        type Mask<S: Simd> = S::$mask;
        #[inline(always)]
        fn vectors<S: Simd>(values: &[Self]) -> &[Self::Vector<S>] {
            S::$as_simd(values).0
        }
        #[inline(always)]
        fn vectors_mut<S: Simd>(values: &mut [Self]) -> &mut [Self::Vector<S>] {
            S::$as_mut_simd(values).0
        }
        #[inline(always)]
        fn splat<S: Simd>(simd: S, value: Self) -> Self::Vector<S> {
            simd.$splat(value)
        }
        #[inline(always)]
        fn vadd<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S> {
            simd.$add(a, b)
        }
        #[inline(always)]
        fn vsub<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S> {
            simd.$sub(a, b)
        }
        #[inline(always)]
        fn vmul<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S> {
            simd.$mul(a, b)
        }
        #[inline(always)]
        fn vdiv<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Vector<S> {
            simd.$div(a, b)
        }
        #[inline(always)]
        fn vneg<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S> {
            simd.$neg(a)
        }
        #[inline(always)]
        fn vabs<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S> {
            simd.$abs(a)
        }
        #[inline(always)]
        fn vsqrt<S: Simd>(simd: S, a: Self::Vector<S>) -> Self::Vector<S> {
            simd.$sqrt(a)
        }
        #[inline(always)]
        fn mul_add<S: Simd>(
            simd: S,
            a: Self::Vector<S>,
            b: Self::Vector<S>,
            c: Self::Vector<S>,
        ) -> Self::Vector<S> {
            simd.$mul_add(a, b, c)
        }
        #[inline(always)]
        fn less<S: Simd>(simd: S, a: Self::Vector<S>, b: Self::Vector<S>) -> Self::Mask<S> {
            simd.$less(a, b)
        }
        #[inline(always)]
        fn any<S: Simd>(simd: S, mask: Self::Mask<S>) -> bool {
            simd.$first_true(mask) < Self::lanes::<S>()
        }
        #[inline(always)]
        fn and<S: Simd>(simd: S, a: Self::Mask<S>, b: Self::Mask<S>) -> Self::Mask<S> {
            simd.$and(a, b)
        }
        #[inline(always)]
        fn select<S: Simd>(
            simd: S,
            mask: Self::Mask<S>,
            yes: Self::Vector<S>,
            no: Self::Vector<S>,
        ) -> Self::Vector<S> {
            simd.$select(mask, yes, no)
        }
        #[inline(always)]
        fn sum<S: Simd>(simd: S, a: Self::Vector<S>) -> Self {
            simd.$sum(a)
        }
    };
}

impl Vectors for f32 {
    vector_ops!(
        f32s,
        m32s,
        as_simd_f32s,
        as_mut_simd_f32s,
        splat_f32s,
        add_f32s,
        sub_f32s,
        mul_f32s,
        div_f32s,
        neg_f32s,
        abs_f32s,
        sqrt_f32s,
        mul_add_e_f32s,
        less_than_f32s,
        first_true_m32s,
        and_m32s,
        select_f32s,
        reduce_sum_f32s
    );
    #[inline(always)]
    fn exp_neg<S: Simd>(simd: S, x: S::f32s) -> S::f32s {
        // exp(-x) = 2^n exp(r), n the integer nearest to -x / ln 2, |r| <= ln 2 / 2. Adding
        // 1.5 * 2^23 leaves n in the low bits of the sum's mantissa. ln 2 is split in two so that
        // n ln 2 is subtracted without loss; the polynomial is Cephes' expf.
        const ROUND: f32 = 12_582_912.0;
        let splat = |v: f32| simd.splat_f32s(v);
        let largest = splat(80.0);
        let x = simd.select_f32s(simd.less_than_f32s(x, largest), x, largest);
        let shifted = simd.mul_add_e_f32s(x, splat(-std::f32::consts::LOG2_E), splat(ROUND));
        let n = simd.sub_f32s(shifted, splat(ROUND));
        // r = (-x - n a) - n b, with the signs turned so that each step is one fused operation.
        let r = simd.mul_add_e_f32s(n, splat(0.693_359_4), x);
        let r = simd.mul_add_e_f32s(n, splat(-2.121_944_4e-4), r);
        let r = simd.neg_f32s(r);
        let mut y = splat(1.987_569_1e-4);
        for c in [
            1.398_2e-3,
            8.333_452e-3,
            4.166_579_6e-2,
            1.666_666_5e-1,
            0.5,
        ] {
            y = simd.mul_add_e_f32s(y, r, splat(c));
        }
        let y = simd.mul_add_e_f32s(y, simd.mul_f32s(r, r), r);
        let y = simd.add_f32s(y, splat(1.0));
        // (n + 127) << 23 are the bits of 2^n.
        let n = simd.wrapping_dyn_shl_u32s(bytemuck::cast(shifted), simd.splat_u32s(23));
        let scale = bytemuck::cast(simd.add_u32s(n, simd.splat_u32s(0x3f80_0000)));
        simd.mul_f32s(y, scale)
    }
}

impl Vectors for f64 {
    vector_ops!(
        f64s,
        m64s,
        as_simd_f64s,
        as_mut_simd_f64s,
        splat_f64s,
        add_f64s,
        sub_f64s,
        mul_f64s,
        div_f64s,
        neg_f64s,
        abs_f64s,
        sqrt_f64s,
        mul_add_e_f64s,
        less_than_f64s,
        first_true_m64s,
        and_m64s,
        select_f64s,
        reduce_sum_f64s
    );
    #[inline(always)]
    fn exp_neg<S: Simd>(_: S, x: S::f64s) -> S::f64s {
        let mut x = x;
        for value in bytemuck::cast_slice_mut::<S::f64s, f64>(std::slice::from_mut(&mut x)) {
            *value = (-*value).exp();
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::Vectors;
    use pulp::{Arch, Simd, WithSimd};

    /// `exp_neg` of every value, with the machine's vectors.
    struct ExpNeg<'a>(&'a mut [f32]);

    impl WithSimd for ExpNeg<'_> {
        type Output = ();

        fn with_simd<S: Simd>(self, simd: S) {
            for x in f32::vectors_mut::<S>(self.0) {
                *x = f32::exp_neg(simd, *x);
            }
        }
    }

    fn exp_neg(values: &[f32]) -> Vec<f32> {
        // Whole vectors, of whatever width.
        let mut padded = values.to_vec();
        padded.resize(values.len().next_multiple_of(16), 0.0);
        Arch::new().dispatch(ExpNeg(&mut padded));
        padded.truncate(values.len());
        padded
    }

    #[test]
    fn fast_exponential_is_within_its_stated_error() {
        let x: Vec<f32> = (0..800_000).map(|k| k as f32 * 1e-4).collect();
        for (x, y) in x.iter().zip(exp_neg(&x)) {
            let exact = (-f64::from(*x)).exp();
            let error = (f64::from(y) - exact).abs() / exact;
            assert!(error < 2e-7, "exp(-{x}): relative error {error:e}");
        }
        let far = [80.0_f32, 1e4, 1e30, f32::INFINITY, f32::NAN];
        for (x, y) in far.iter().zip(exp_neg(&far)) {
            assert!((0.0..1e-30).contains(&y), "exp(-{x}) = {y}");
        }
        assert_eq!(exp_neg(&[0.0]), [1.0], "exp(0)");
    }
}
