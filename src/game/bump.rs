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

use super::columns::{exp, exp_m1, ln};
use super::gaussian::{Component, Gradient, MOST};
use super::squashed::Squashed;
use nalgebra::{Matrix2, Vector2};

/// What zero parameters mean on the diagonal of each bump's L, before squashing: K = L L' has no gradient at
/// L = 0. A mild round bump first, then narrower ones.
const NEUTRAL_DIAGONAL: [f64; MOST] = [0.1, 0.3, 0.6];

/// A normalised likelihood ratio delta^0 of the standard normal law.
#[derive(Debug, Clone, Copy)]
pub struct Bump {
    center: Squashed<2>,
    /// Entries (L11, L21, L22) of the Cholesky factor.
    factor: Squashed<3>,
    curvature: Symmetric,
    covariance: Symmetric,
    /// log|I+K|.
    log_determinant: f64,
    log_supremum: f64,
}

/// A symmetric matrix, by its entries. Every formula is written out, so that it can be one of columns
/// ([`super::columns`]).
#[derive(Debug, Clone, Copy)]
struct Symmetric {
    xx: f64,
    xy: f64,
    yy: f64,
}

impl Symmetric {
    #[inline(always)]
    fn times(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.xx * x + self.xy * y, self.xy * x + self.yy * y]
    }

    /// v' A v.
    #[inline(always)]
    fn form(&self, [x, y]: [f64; 2]) -> f64 {
        self.xx * x * x + 2.0 * self.xy * x * y + self.yy * y * y
    }

    fn matrix(&self) -> Matrix2<f64> {
        Matrix2::new(self.xx, self.xy, self.xy, self.yy)
    }
}

impl Bump {
    /// The centre c.
    pub fn center(&self) -> Vector2<f64> {
        self.center.value.into()
    }

    /// The curvature K.
    pub fn curvature(&self) -> Matrix2<f64> {
        self.curvature.matrix()
    }

    /// The mean m = S K c of the reweighted law.
    pub fn mean(&self) -> Vector2<f64> {
        self.covariance.times(self.curvature.times(self.center.value)).into()
    }

    /// The covariance S of the reweighted law.
    pub fn covariance(&self) -> Matrix2<f64> {
        self.covariance.matrix()
    }

    /// log Z, of the integral of P exp(-1/2 (xi-c)' K (xi-c)) over the plane, taken over one axis after the other.
    #[inline(always)]
    pub fn log_integral(&self) -> f64 {
        let Symmetric { xx, xy, yy } = self.curvature;
        let [x, y] = self.center.value;
        // Over the second axis it leaves exp(-1/2 (first u^2 + 2 linear u + rest)) / sqrt(second), with u the
        // distance to x along the first.
        let second = 1.0 + yy;
        let first = 1.0 + xx - xy * xy / second;
        let linear = x - xy * y / second;
        let rest = x * x + yy * y * y / second;
        -0.5 * (ln(second * first) + rest - linear * linear / first)
    }

    /// xi - c.
    #[inline(always)]
    fn off(&self, xi: Vector2<f64>) -> [f64; 2] {
        [xi.x - self.center.value[0], xi.y - self.center.value[1]]
    }
}

impl Component for Bump {
    /// Two that are squashed into the disc |c| < `center`, and three that are squashed into a ball of Cholesky
    /// factors L with `||K|| <= ||L||_F^2 < curvature`.
    const PARAMETERS: usize = 5;
    const UNIFORM: bool = false;

    #[inline(always)]
    fn new(parameters: &[f64], index: usize, center: f64, curvature: f64) -> Self {
        let neutral = NEUTRAL_DIAGONAL[index];
        let center = Squashed::new([parameters[0], parameters[1]], center);
        let raw = [neutral + parameters[2], parameters[3], neutral + parameters[4]];
        let factor = Squashed::new(raw, curvature.sqrt());
        let [a, b, d] = factor.value;
        let k = Symmetric { xx: a * a, xy: a * b, yy: b * b + d * d };
        // The inverse of I + K in closed form; its determinant is at least 1.
        let determinant = (1.0 + k.xx) * (1.0 + k.yy) - k.xy * k.xy;
        let inverse = 1.0 / determinant;
        let covariance = Symmetric {
            xx: (1.0 + k.yy) * inverse,
            xy: -k.xy * inverse,
            yy: (1.0 + k.xx) * inverse,
        };
        let log_determinant = ln(determinant);
        let c = center.value;
        let pulled = k.times(covariance.times(c));
        let log_supremum = 0.5 * (log_determinant + c[0] * pulled[0] + c[1] * pulled[1]);
        Bump { center, factor, curvature: k, covariance, log_determinant, log_supremum }
    }

    #[inline(always)]
    fn log_supremum(&self) -> f64 {
        self.log_supremum
    }

    /// M exp(-1/2 (xi-c)' K (xi-c)).
    #[inline(always)]
    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        exp(self.log_supremum - 0.5 * self.curvature.form(self.off(xi)))
    }

    /// m + A z with A A' = S.
    #[inline(always)]
    fn draw(&self, z: Vector2<f64>, _: f64) -> Vector2<f64> {
        let mean = self.covariance.times(self.curvature.times(self.center.value));
        let [a, b, d] = square_root(&self.covariance);
        Vector2::new(mean[0] + a * z.x, mean[1] + b * z.x + d * z.y)
    }

    /// 1/2 log|I+K|.
    #[inline(always)]
    fn lost_entropy(&self) -> f64 {
        0.5 * self.log_determinant
    }

    #[inline(always)]
    fn pull_back(&self, xi: Vector2<f64>, by: Gradient, gradient: &mut [f64]) {
        let Gradient { by_ratio, by_supremum, by_lost } = by;
        // By c: K (xi-c) and, of log M, c - S c (as K S = I - S). By K (all four entries free):
        // -1/2 (xi-c)(xi-c)' and, of log M, 1/2 (S + S c c' S); of log|I+K|, S.
        let (c, s, off) = (self.center.value, self.covariance, self.off(xi));
        let shrunk = s.times(c);
        // log delta^0 = log M - 1/2 (xi-c)' K (xi-c), so log M enters both ways.
        let through_supremum = by_ratio + by_supremum;
        let pulled = self.curvature.times(off);
        let by_center = [
            (c[0] - shrunk[0]) * through_supremum + pulled[0] * by_ratio,
            (c[1] - shrunk[1]) * through_supremum + pulled[1] * by_ratio,
        ];
        let by_entry = |s: f64, shrunk: f64, off: f64| {
            0.5 * ((s + shrunk) * through_supremum - off * by_ratio + s * by_lost)
        };
        let by_curvature = Symmetric {
            xx: by_entry(s.xx, shrunk[0] * shrunk[0], off[0] * off[0]),
            xy: by_entry(s.xy, shrunk[0] * shrunk[1], off[0] * off[1]),
            yy: by_entry(s.yy, shrunk[1] * shrunk[1], off[1] * off[1]),
        };
        // K = L L': dF/dL = 2 (dF/dK) L for a symmetric dF/dK.
        let [a, b, d] = self.factor.value;
        let column = by_curvature.times([a, b]);
        let by_factor = [2.0 * column[0], 2.0 * column[1], 2.0 * by_curvature.yy * d];
        let (center, factor) = (self.center.pull_back(by_center), self.factor.pull_back(by_factor));
        gradient[0] = center[0];
        gradient[1] = center[1];
        gradient[2] = factor[0];
        gradient[3] = factor[1];
        gradient[4] = factor[2];
    }

    /// With [`Bump::log_integral`].
    #[inline(always)]
    fn normalisation_error(&self) -> f64 {
        exp_m1(self.log_supremum + self.log_integral())
    }
}

/// The entries (A11, A21, A22) of the lower triangular A with A A' = S, of a positive definite S.
#[inline(always)]
fn square_root(covariance: &Symmetric) -> [f64; 3] {
    let a = covariance.xx.sqrt();
    let b = covariance.xy / a;
    [a, b, (covariance.yy - b * b).sqrt()]
}
