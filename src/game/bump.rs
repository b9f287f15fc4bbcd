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

use nalgebra::{Matrix2, SVector, Vector2};

/// Parameters of a bump: two that are squashed into the disc |c| < `center_bound`, and three that are
/// squashed into a ball of Cholesky factors L with `||K|| <= ||L||_F^2 < curvature_bound`.
pub const PARAMETERS: usize = 5;

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

/// `y = bound * v / sqrt(1 + |v|^2)`: all of R^N onto the open ball of radius `bound`.
#[derive(Debug, Clone, Copy)]
struct Squashed<const N: usize> {
    value: SVector<f64, N>,
    bound: f64,
    scale: f64,
}

impl<const N: usize> Squashed<N> {
    fn new(raw: SVector<f64, N>, bound: f64) -> Self {
        let scale = 1.0 / (1.0 + raw.norm_squared()).sqrt();
        Squashed { value: raw * (bound * scale), bound, scale }
    }

    /// Gradient by v, from the gradient by y: (bound/r) (I - u u') g with u = v/r, r^2 = 1 + |v|^2.
    fn pull_back(&self, gradient: SVector<f64, N>) -> SVector<f64, N> {
        let unit = self.value / self.bound;
        (gradient - unit * unit.dot(&gradient)) * (self.bound * self.scale)
    }
}

impl Bump {
    /// The bump with these five parameters. K = L L' has no gradient at L = 0: parameters of zero
    /// mean `neutral` on L's diagonal before squashing.
    pub fn new(parameters: &[f64], neutral: f64, center_bound: f64, curvature_bound: f64) -> Self {
        let [x, y, a, b, d] = std::array::from_fn(|i| parameters[i]);
        let center = Squashed::new(Vector2::new(x, y), center_bound);
        let raw = SVector::<f64, 3>::new(neutral + a, b, neutral + d);
        let factor = Squashed::new(raw, curvature_bound.sqrt());
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

    /// log M.
    pub fn log_supremum(&self) -> f64 {
        self.log_supremum
    }

    /// log|I+K|: the entropy of the reweighted law is lower than the nominal one's by half of it.
    pub fn log_determinant(&self) -> f64 {
        -self.covariance.determinant().ln()
    }

    /// delta^0(xi) = M exp(-1/2 (xi-c)' K (xi-c)).
    pub fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        let off = xi - self.center.value;
        (self.log_supremum - 0.5 * off.dot(&(self.curvature * off))).exp()
    }

    /// Where a standard normal draw z lies under the reweighted law: m + A z with A A' = S.
    pub fn place(&self, z: Vector2<f64>) -> Vector2<f64> {
        self.mean() + square_root(&self.covariance) * z
    }

    /// Writes the gradient by the parameters of
    /// `by_ratio log delta^0(xi) + by_supremum log M + by_determinant log|I+K|`.
    pub fn pull_back(
        &self,
        xi: Vector2<f64>,
        by_ratio: f64,
        by_supremum: f64,
        by_determinant: f64,
        gradient: &mut [f64],
    ) {
        // By c: K (xi-c) and, of log M, c - S c (as K S = I - S). By K (all four entries free):
        // -1/2 (xi-c)(xi-c)' and, of log M, 1/2 (S + S c c' S); of log|I+K|, S.
        let (c, s) = (self.center.value, self.covariance);
        let (off, shrunk) = (xi - c, s * c);
        // log delta^0 = log M - 1/2 (xi-c)' K (xi-c), so log M enters both ways.
        let through_supremum = by_ratio + by_supremum;
        let by_center = (c - shrunk) * through_supremum + self.curvature * off * by_ratio;
        let by_curvature = (s + shrunk * shrunk.transpose()) * (0.5 * through_supremum)
            - off * off.transpose() * (0.5 * by_ratio)
            + s * by_determinant;
        // K = L L': dF/dL = 2 (dF/dK) L for a symmetric dF/dK.
        let by_factor = by_curvature * lower_triangle(&self.factor.value) * 2.0;
        let by_entries = SVector::<f64, 3>::new(by_factor.m11, by_factor.m21, by_factor.m22);
        gradient[..2].copy_from_slice(self.center.pull_back(by_center).as_slice());
        gradient[2..].copy_from_slice(self.factor.pull_back(by_entries).as_slice());
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

fn lower_triangle(entries: &SVector<f64, 3>) -> Matrix2<f64> {
    Matrix2::new(entries[0], 0.0, entries[1], entries[2])
}

/// The lower triangular A with A A' = S, of a positive definite S.
fn square_root(covariance: &Matrix2<f64>) -> Matrix2<f64> {
    let a = covariance.m11.sqrt();
    let b = covariance.m21 / a;
    Matrix2::new(a, 0.0, b, (covariance.m22 - b * b).sqrt())
}
