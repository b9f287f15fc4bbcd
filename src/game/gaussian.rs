//! The Gaussian family (point mass): a bump of likelihood ratio in noise space.
//!
//! `delta^0(xi) = (1/Z) exp(-1/2 (xi-c)' K (xi-c))` with K symmetric positive semidefinite. Under
//! xi ~ N(0, I), with S = (I+K)^{-1}:
//!
//! - `log M = -log Z = 1/2 log|I+K| + 1/2 c' K S c`, attained at xi = c,
//! - the reweighted law is N(m, S) with m = S K c.
//!
//! After identity mixing the perturbed law is `lambda N(0, I) + (1 - lambda) N(m, S)`. A pure shift
//! of the mean would have an unbounded ratio and break every finite budget: that is why the bump
//! must narrow as it moves.
//!
//! | symbol | identifier |
//! |---|---|
//! | c, in standard deviations of the noise | `center` |
//! | K = L L' | `curvature`, `factor` |
//! | S | `covariance` |
//! | m | `mean` |

use crate::game::budget::{Budget, Mixing};
use crate::game::perturbation::{Family, Perturbation};
use lava_envs::GaussianLaw;
use nalgebra::{Matrix2, SVector, Vector2};
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

/// The Gaussian family. Five parameters: two that are squashed into the disc |c| < `center_bound`,
/// and three that are squashed into a ball of Cholesky factors L with
/// `||K|| <= ||L||_F^2 < curvature_bound`.
#[derive(Debug, Clone, Copy)]
pub struct GaussianFamily {
    /// Bound of |c|.
    pub center_bound: f64,
    /// Bound of the eigenvalues of K.
    pub curvature_bound: f64,
}

/// K = L L' has no gradient at L = 0; parameters of zero mean this diagonal before squashing, a
/// mild round bump.
const NEUTRAL_DIAGONAL: f64 = 0.1;

/// An admissible perturbation of the standard normal law.
#[derive(Debug, Clone)]
pub struct GaussianPerturbation {
    center: Squashed<2>,
    /// Entries (L11, L21, L22) of the Cholesky factor.
    factor: Squashed<3>,
    curvature: Matrix2<f64>,
    covariance: Matrix2<f64>,
    log_supremum: f64,
    mixing: Mixing,
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

impl Family for GaussianFamily {
    type Law = GaussianLaw;
    type Perturbation = GaussianPerturbation;
    const PARAMETERS: usize = 5;

    fn perturbation(
        &self,
        parameters: &[f64],
        _law: &GaussianLaw,
        budget: Budget,
    ) -> GaussianPerturbation {
        let [x, y, a, b, d] = std::array::from_fn(|i| parameters[i]);
        let center = Squashed::new(Vector2::new(x, y), self.center_bound);
        let factor = Squashed::new(
            SVector::<f64, 3>::new(NEUTRAL_DIAGONAL + a, b, NEUTRAL_DIAGONAL + d),
            self.curvature_bound.sqrt(),
        );
        GaussianPerturbation::new(center, factor, budget)
    }
}

impl GaussianPerturbation {
    fn new(center: Squashed<2>, factor: Squashed<3>, budget: Budget) -> Self {
        let lower = lower_triangle(&factor.value);
        let curvature = lower * lower.transpose();
        // The inverse of I + K in closed form; its determinant is at least 1.
        let (k11, k12, k22) = (curvature.m11, curvature.m12, curvature.m22);
        let determinant = (1.0 + k11) * (1.0 + k22) - k12 * k12;
        let covariance = Matrix2::new(1.0 + k22, -k12, -k12, 1.0 + k11) / determinant;
        let c = center.value;
        let log_supremum = 0.5 * determinant.ln() + 0.5 * c.dot(&(curvature * (covariance * c)));
        let mixing = budget.mix(log_supremum);
        GaussianPerturbation { center, factor, curvature, covariance, log_supremum, mixing }
    }

    /// The centre c of the bump.
    pub fn center(&self) -> Vector2<f64> {
        self.center.value
    }

    /// The curvature K of the bump.
    pub fn curvature(&self) -> Matrix2<f64> {
        self.curvature
    }

    /// The mean m = S K c of the reweighted law before mixing.
    pub fn mean(&self) -> Vector2<f64> {
        self.covariance * (self.curvature * self.center.value)
    }

    /// The covariance S of the reweighted law before mixing.
    pub fn covariance(&self) -> Matrix2<f64> {
        self.covariance
    }

    /// log M.
    pub fn log_supremum(&self) -> f64 {
        self.log_supremum
    }

    /// 1 - lambda, the share of the reweighted law in the mixture.
    pub fn weight(&self) -> f64 {
        self.mixing.weight
    }

    /// delta^0(xi) = M exp(-1/2 (xi-c)' K (xi-c)).
    fn base(&self, xi: Vector2<f64>) -> f64 {
        let off = xi - self.center.value;
        (self.log_supremum - 0.5 * off.dot(&(self.curvature * off))).exp()
    }

    /// Gradients of log M by c, which is c - S c (as K S = I - S), and by K, which is
    /// 1/2 (S + S c c' S).
    fn log_supremum_gradient(&self) -> (Vector2<f64>, Matrix2<f64>) {
        let c = self.center.value;
        let shrunk = self.covariance * c;
        (c - shrunk, (self.covariance + shrunk * shrunk.transpose()) * 0.5)
    }

    /// Gradient by the parameters, from gradients by c and by K (all four entries free).
    fn pull_back(&self, by_center: Vector2<f64>, by_curvature: Matrix2<f64>, gradient: &mut [f64]) {
        // K = L L': dF/dL = 2 (dF/dK) L for a symmetric dF/dK.
        let by_factor = by_curvature * lower_triangle(&self.factor.value) * 2.0;
        let center = self.center.pull_back(by_center);
        let factor = self.factor.pull_back(SVector::<f64, 3>::new(
            by_factor.m11,
            by_factor.m21,
            by_factor.m22,
        ));
        gradient[..2].copy_from_slice(center.as_slice());
        gradient[2..].copy_from_slice(factor.as_slice());
    }
}

fn lower_triangle(entries: &SVector<f64, 3>) -> Matrix2<f64> {
    Matrix2::new(entries[0], 0.0, entries[1], entries[2])
}

impl Perturbation for GaussianPerturbation {
    type Law = GaussianLaw;

    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        self.mixing.likelihood_ratio(self.base(xi))
    }

    fn supremum(&self) -> f64 {
        self.mixing.likelihood_ratio(self.log_supremum.exp())
    }

    /// A draw from the mixture lambda N(0, I) + (1 - lambda) N(m, S).
    fn sample<R: Rng>(&self, random: &mut R) -> Vector2<f64> {
        let bump = random.random::<f64>() < self.mixing.weight;
        let z = Vector2::new(random.sample(StandardNormal), random.sample(StandardNormal));
        if bump { self.mean() + square_root(&self.covariance) * z } else { z }
    }

    fn score(&self, xi: Vector2<f64>, gradient: &mut [f64]) -> f64 {
        let base = self.base(xi);
        let (by_base, by_supremum) = self.mixing.derivatives(base);
        let ratio = self.mixing.likelihood_ratio(base);
        let (supremum_center, supremum_curvature) = self.log_supremum_gradient();
        let off = xi - self.center.value;
        // log delta^0 = log M - 1/2 (xi-c)' K (xi-c), so log M enters on both ways.
        let through_supremum = (by_base + by_supremum) / ratio;
        let direct = by_base / ratio;
        self.pull_back(
            supremum_center * through_supremum + self.curvature * off * direct,
            supremum_curvature * through_supremum - off * off.transpose() * (0.5 * direct),
            gradient,
        );
        ratio
    }

    /// The entropy of a mixture has no closed form. By concavity it is at least
    /// `lambda H(N(0,I)) + (1-lambda) H(N(m,S)) = 1 + log 2 pi - (1-lambda)/2 log|I+K|`, which is
    /// the bonus.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        let log_determinant = -self.covariance.determinant().ln(); // log|I+K|
        let (supremum_center, supremum_curvature) = self.log_supremum_gradient();
        let by_supremum = -0.5 * log_determinant * self.mixing.by_log_supremum;
        self.pull_back(
            supremum_center * by_supremum,
            // d log|I+K| / dK = S
            supremum_curvature * by_supremum - self.covariance * (0.5 * self.mixing.weight),
            gradient,
        );
        1.0 + (2.0 * std::f64::consts::PI).ln() - 0.5 * self.mixing.weight * log_determinant
    }

    /// The integral of P delta^0 over the plane is `M |I+K|^{-1/2} exp(-1/2 c' K S c)`, evaluated
    /// with a decomposition of K of its own.
    fn normalisation_error(&self) -> f64 {
        let eigen = self.curvature.symmetric_eigen();
        let along = eigen.eigenvectors.transpose() * self.center.value;
        let log_z: f64 = (0..2)
            .map(|i| {
                let k = eigen.eigenvalues[i];
                -0.5 * k.ln_1p() - 0.5 * along[i] * along[i] * k / (1.0 + k)
            })
            .sum();
        self.mixing.weight * (self.log_supremum + log_z).exp_m1().abs()
    }
}

/// The lower triangular A with A A' = S, of a positive definite S.
fn square_root(covariance: &Matrix2<f64>) -> Matrix2<f64> {
    let a = covariance.m11.sqrt();
    let b = covariance.m21 / a;
    Matrix2::new(a, 0.0, b, (covariance.m22 - b * b).sqrt())
}
