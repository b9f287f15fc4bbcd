//! The standard normal law on the line.

use statrs::function::erf::{erfc, erfc_inv};
use std::f64::consts::{PI, SQRT_2};

/// log(2 pi).
pub const LOG_2_PI: f64 = 1.837_877_066_409_345_3;

/// Phi(z), the probability below z; accurate in the lower tail.
pub fn below(z: f64) -> f64 {
    0.5 * erfc(-z / SQRT_2)
}

/// The z with Phi(z) = `share`; accurate for small shares.
pub fn quantile(share: f64) -> f64 {
    -SQRT_2 * erfc_inv(2.0 * share)
}

/// phi(z), the density.
pub fn density(z: f64) -> f64 {
    (-0.5 * z * z).exp() / (2.0 * PI).sqrt()
}
