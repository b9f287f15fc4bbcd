//! Arithmetic on many samples at once.
//!
//! Learning needs the gradients of forty thousand perturbations per update. They are computed in columns: a
//! number of `SAMPLES` samples each, in a row. A loop over the samples of columns, whose body is the same
//! formula as for one sample, becomes one over the processor's widest vectors if the body has neither branches
//! nor calls. That is what the functions here are for: unlike those of the C library they have neither.

use pulp::{Arch, Simd, WithSimd};
use std::f64::consts::LOG2_E;

/// Samples of a column: a multiple of the width of any vector register.
pub const SAMPLES: usize = 64;

/// A number of each sample.
pub type Column = [f64; SAMPLES];

/// What is computed with the processor's widest vectors.
pub trait Loops {
    /// Computes it. To be marked `#[inline(always)]`.
    fn run(self);
}

/// Computes with the processor's widest vectors.
pub fn widest(loops: impl Loops) {
    struct Widest<L>(L);
    impl<L: Loops> WithSimd for Widest<L> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) {
            self.0.run();
        }
    }
    Arch::new().dispatch(Widest(loops));
}

/// log 2 in two parts, of which the first has few enough digits that its product with a small integer is exact.
const LN_2: [f64; 2] = [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10];

/// Added to a number below 2^51 it rounds it to an integer, which is then in the lowest bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// 1/k! for k = 13 to 2.
const FACTORIALS: [f64; 12] = {
    let mut inverse = [0.0; 12];
    let (mut factorial, mut k) = (1.0, 2);
    while k <= 13 {
        factorial *= k as f64;
        inverse[13 - k] = 1.0 / factorial;
        k += 1;
    }
    inverse
};

/// 1/(2k+1) for k = 10 to 0.
const ODD: [f64; 11] = {
    let mut inverse = [0.0; 11];
    let mut k = 0;
    while k <= 10 {
        inverse[10 - k] = 1.0 / (2 * k + 1) as f64;
        k += 1;
    }
    inverse
};

/// The bits of 1.
const ONE: u64 = 0x3ff0_0000_0000_0000;

/// The integer k nearest to x / log 2, exp(x - k log 2) - 1, and 2^k.
#[inline(always)]
fn reduced(x: f64) -> (f64, f64, f64) {
    let rounded = x.mul_add(LOG2_E, ROUND);
    let k = rounded - ROUND;
    let r = k.mul_add(-LN_2[1], k.mul_add(-LN_2[0], x));
    let mut sum = FACTORIALS[0];
    let mut i = 1;
    while i < FACTORIALS.len() {
        sum = sum.mul_add(r, FACTORIALS[i]);
        i += 1;
    }
    (k, (sum * r).mul_add(r, r), f64::from_bits((rounded.to_bits() << 52).wrapping_add(ONE)))
}

/// e^x to a relative error of 1e-15; beyond +-708 that at the bound. NaN stays NaN.
#[inline(always)]
pub fn exp(x: f64) -> f64 {
    let x = if x < -708.0 { -708.0 } else { x };
    let x = if x > 708.0 { 708.0 } else { x };
    let (_, less_one, power) = reduced(x);
    less_one.mul_add(power, power)
}

/// e^x - 1 to a relative error of 1e-15, for |x| <= 708 and no other.
#[inline(always)]
pub fn exp_m1(x: f64) -> f64 {
    let (k, less_one, power) = reduced(x);
    if k == 0.0 { less_one } else { less_one.mul_add(power, power - 1.0) }
}

/// log x of a normal positive number, to 1e-15 of the larger one of 1 and itself; of what is below the least
/// normal number, 0 included, that of the least. Neither infinity nor NaN has one.
#[inline(always)]
pub fn ln(x: f64) -> f64 {
    let x = if x < f64::MIN_POSITIVE { f64::MIN_POSITIVE } else { x };
    // x = 2^k m with m between the square roots of 1/2 and 2.
    let k = (x.to_bits().wrapping_sub(0x3fe6_a09e_667f_3bcd) as i64) >> 52;
    let m = f64::from_bits(x.to_bits().wrapping_sub((k as u64) << 52));
    let k = f64::from_bits(ROUND.to_bits().wrapping_add(k as u64)) - ROUND;
    // log m = 2 artanh s.
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let mut sum = ODD[0];
    let mut i = 1;
    while i < ODD.len() {
        sum = sum.mul_add(square, ODD[i]);
        i += 1;
    }
    // 0, and NaN where x is not finite.
    let defect = x * 0.0;
    k.mul_add(LN_2[0], k.mul_add(LN_2[1], 2.0 * s * sum)) + defect
}

/// [`ln`] of each number, with the widest vectors.
pub fn logarithms(numbers: impl Iterator<Item = f64>) -> Vec<f64> {
    struct Each<'a>(&'a mut [f64]);
    impl Loops for Each<'_> {
        #[inline(always)]
        fn run(self) {
            for number in self.0 {
                *number = ln(*number);
            }
        }
    }
    let mut numbers: Vec<f64> = numbers.collect();
    widest(Each(&mut numbers));
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_are_those_of_the_library() {
        let numbers = (-70_000..=70_000).map(|i| f64::from(i) * 0.0101);
        let close = |ours: f64, theirs: f64, scale: f64| (ours - theirs).abs() <= 1e-15 * scale;
        for x in numbers {
            assert!(close(exp(x), x.exp(), x.exp()), "exp({x}) = {}", exp(x));
            assert!(close(exp_m1(x), x.exp_m1(), x.exp_m1().abs()), "exp_m1({x}) = {}", exp_m1(x));
            let tiny = x * 1e-9;
            assert!(close(exp_m1(tiny), tiny.exp_m1(), tiny.abs()), "exp_m1({tiny})");
            for y in [x.exp(), 1.0 + x * 1e-3, x * x] {
                if y >= f64::MIN_POSITIVE {
                    assert!(close(ln(y), y.ln(), y.ln().abs().max(1.0)), "ln({y}) = {}", ln(y));
                }
            }
        }
        let numbers: Vec<f64> = (1..40).map(f64::from).collect();
        let logs = logarithms(numbers.iter().copied());
        assert!(logs.iter().zip(&numbers).all(|(log, number)| close(*log, number.ln(), 4.0)));
    }

    #[test]
    fn numbers_that_are_none_stay_so() {
        assert!(exp(f64::NAN).is_nan() && exp_m1(f64::NAN).is_nan() && ln(f64::NAN).is_nan());
        assert!(ln(f64::INFINITY).is_nan());
        assert_eq!(exp(-1e9), exp(-708.0));
        assert_eq!(ln(0.0), f64::MIN_POSITIVE.ln());
    }
}
