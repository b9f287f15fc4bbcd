//! A bump of likelihood ratio in noise space.
//!
//! `delta^0(xi) = (1/Z) exp(-1/2 (xi-c)' K (xi-c))` with K symmetric positive semidefinite. Under
//! xi ~ N(0, I), with S = (I+K)^{-1}:
//!
//! - `log M = -log Z = 1/2 log|I+K| + 1/2 c' K S c`, attained at xi = c,
//! - the reweighted law is N(m, S) with m = S K c.
//!
//! A pure shift of the mean would have an unbounded ratio and break every finite budget: that is why
//! the bump must narrow as it moves.
//!
//! | symbol | identifier |
//! |---|---|
//! | c, in standard deviations of the noise | `center` |
//! | K = L L' | `curvature`, `factor` |
//! | S | `covariance` |
//! | m | `mean` |

use super::gaussian::{Component, Gradient, MOST};
use super::squashed::Squashed;
use nalgebra::{Matrix2, SVector, Vector2};
use rand::Rng;

/// What zero parameters mean on the diagonal of each bump's L, before squashing: K = L L' has no gradient at
/// L = 0. A mild round bump first, then narrower ones.
const NEUTRAL_DIAGONAL: [f64; MOST] = [0.1, 0.3, 0.6];

/// A normalised likelihood ratio delta^0 of the standard normal law.
#[derive(Debug, Clone, Copy)]
pub struct Bump {
    center: Squashed<2>,
    /// Entries (L11, L21, L22) of the Cholesky factor.
    factor: Squashed<3>,
    curvature: Matrix2<f64>,
    covariance: Matrix2<f64>,
    log_supremum: f64,
}

impl Bump {
    /// The centre c.
    pub fn center(&self) -> Vector2<f64> {
        self.center.value
    }

    /// The curvature K.
    pub fn curvature(&self) -> Matrix2<f64> {
        self.curvature
    }

    /// The mean m = S K c of the reweighted law.
    pub fn mean(&self) -> Vector2<f64> {
        self.covariance * (self.curvature * self.center.value)
    }

    /// The covariance S of the reweighted law.
    pub fn covariance(&self) -> Matrix2<f64> {
        self.covariance
    }

    /// log of the integral of P exp(-1/2 (xi-c)' K (xi-c)) over the plane, log Z, evaluated with a
    /// decomposition of K of its own.
    pub fn log_integral(&self) -> f64 {
        let eigen = self.curvature.symmetric_eigen();
        let along = eigen.eigenvectors.transpose() * self.center.value;
        (0..2)
            .map(|i| {
                let k = eigen.eigenvalues[i];
                -0.5 * k.ln_1p() - 0.5 * along[i] * along[i] * k / (1.0 + k)
            })
            .sum()
    }
}

impl Component for Bump {
    /// Two that are squashed into the disc |c| < `center`, and three that are squashed into a ball of Cholesky
    /// factors L with `||K|| <= ||L||_F^2 < curvature`.
    const PARAMETERS: usize = 5;

    fn new(parameters: &[f64], index: usize, center: f64, curvature: f64) -> Self {
        let [x, y, a, b, d] = std::array::from_fn(|i| parameters[i]);
        let neutral = NEUTRAL_DIAGONAL[index];
        let center = Squashed::new(Vector2::new(x, y), center);
        let raw = SVector::<f64, 3>::new(neutral + a, b, neutral + d);
        let factor = Squashed::new(raw, curvature.sqrt());
        let lower = lower_triangle(&factor.value);
        let curvature = lower * lower.transpose();
        // The inverse of I + K in closed form; its determinant is at least 1.
        let (k11, k12, k22) = (curvature.m11, curvature.m12, curvature.m22);
        let determinant = (1.0 + k11) * (1.0 + k22) - k12 * k12;
        let covariance = Matrix2::new(1.0 + k22, -k12, -k12, 1.0 + k11) / determinant;
        let c = center.value;
        let log_supremum = 0.5 * determinant.ln() + 0.5 * c.dot(&(curvature * (covariance * c)));
        Bump { center, factor, curvature, covariance, log_supremum }
    }

    fn log_supremum(&self) -> f64 {
        self.log_supremum
    }

    /// M exp(-1/2 (xi-c)' K (xi-c)).
    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        let off = xi - self.center.value;
        (self.log_supremum - 0.5 * off.dot(&(self.curvature * off))).exp()
    }

    /// m + A z with A A' = S.
    fn draw<R: Rng>(&self, z: Vector2<f64>, _: &mut R) -> Vector2<f64> {
        self.mean() + square_root(&self.covariance) * z
    }

    /// 1/2 log|I+K|.
    fn lost_entropy(&self) -> f64 {
        -0.5 * self.covariance.determinant().ln()
    }

    fn pull_back(&self, xi: Vector2<f64>, by: Gradient, gradient: &mut [f64]) {
        let Gradient { by_ratio, by_supremum, by_lost } = by;
        // By c: K (xi-c) and, of log M, c - S c (as K S = I - S). By K (all four entries free):
        // -1/2 (xi-c)(xi-c)' and, of log M, 1/2 (S + S c c' S); of log|I+K|, S.
        let (c, s) = (self.center.value, self.covariance);
        let (off, shrunk) = (xi - c, s * c);
        // log delta^0 = log M - 1/2 (xi-c)' K (xi-c), so log M enters both ways.
        let through_supremum = by_ratio + by_supremum;
        let by_center = (c - shrunk) * through_supremum + self.curvature * off * by_ratio;
        let by_curvature = (s + shrunk * shrunk.transpose()) * (0.5 * through_supremum)
            - off * off.transpose() * (0.5 * by_ratio)
            + s * (0.5 * by_lost);
        // K = L L': dF/dL = 2 (dF/dK) L for a symmetric dF/dK.
        let by_factor = by_curvature * lower_triangle(&self.factor.value) * 2.0;
        let by_entries = SVector::<f64, 3>::new(by_factor.m11, by_factor.m21, by_factor.m22);
        gradient[..2].copy_from_slice(self.center.pull_back(by_center).as_slice());
        gradient[2..].copy_from_slice(self.factor.pull_back(by_entries).as_slice());
    }

    /// With a decomposition of K of its own.
    fn normalisation_error(&self) -> f64 {
        (self.log_supremum + self.log_integral()).exp_m1()
    }
}

fn lower_triangle(entries: &SVector<f64, 3>) -> Matrix2<f64> {
    Matrix2::new(entries[0], 0.0, entries[1], entries[2])
}

/// The lower triangular A with A A' = S, of a positive definite S.
fn square_root(covariance: &Matrix2<f64>) -> Matrix2<f64> {
    let a = covariance.m11.sqrt();
    let b = covariance.m21 / a;
    Matrix2::new(a, 0.0, b, (covariance.m22 - b * b).sqrt())
}
