//! The family of shifted normal laws, the bounded force of Pinto and others (2017): chance follows N(m, I) in place of
//! N(0, I). With the slope z in R^2 as its parameters and b as the bound of the step,
//!
//! ```text
//! m = R z / sqrt(1 + |z|^2),    R = sqrt(2 ln b),    delta(xi) = exp(m.xi - |m|^2 / 2),
//! ```
//!
//! so that the relative entropy of N(m, I) to N(0, I), |m|^2 / 2, is at most ln b. It is the mean of log delta; delta
//! itself is not bounded, and no multiplicative budget can pay for it. Only the method `rarl` may use it.

use crate::game::budget::Budget;
use crate::game::normal::LOG_2_PI;
use crate::game::perturbation::{Family, Perturbation};
use lava_envs::{GaussianLaw, Law};
use nalgebra::{Matrix2, Vector2};
use rand::Rng;

/// The shifts; the parameters are z.
#[derive(Debug, Clone, Copy, Default)]
pub struct Shift;

/// A shift by m, in standard deviations of the noise.
#[derive(Debug, Clone, Copy)]
pub struct Shifted {
    mean: Vector2<f64>,
    /// d m / d z, which is symmetric.
    jacobian: Matrix2<f64>,
}

impl Shifted {
    /// The mean m.
    pub fn mean(&self) -> Vector2<f64> {
        self.mean
    }
}

impl Family for Shift {
    type Law = GaussianLaw;
    type Perturbation = Shifted;

    fn parameters(&self) -> usize {
        2
    }

    fn perturbation(&self, parameters: &[f64], _: &GaussianLaw, budget: Budget) -> Shifted {
        let z = Vector2::new(parameters[0], parameters[1]);
        let scale = z.x.hypot(z.y).hypot(1.0);
        let (radius, unit) = ((2.0 * budget.get().ln()).sqrt(), z / scale);
        let jacobian = (Matrix2::identity() - unit * unit.transpose()) * (radius / scale);
        Shifted { mean: unit * radius, jacobian }
    }
}

impl Perturbation for Shifted {
    type Law = GaussianLaw;

    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        (self.mean.dot(&xi) - 0.5 * self.mean.norm_squared()).exp()
    }

    fn supremum(&self) -> f64 {
        if self.mean == Vector2::zeros() { 1.0 } else { f64::INFINITY }
    }

    fn infimum(&self) -> f64 {
        if self.mean == Vector2::zeros() { 1.0 } else { 0.0 }
    }

    fn sample<R: Rng>(&self, random: &mut R) -> Vector2<f64> {
        self.mean + GaussianLaw.sample(random)
    }

    fn score(&self, xi: Vector2<f64>, gradient: &mut [f64]) -> f64 {
        gradient.copy_from_slice((self.jacobian * (xi - self.mean)).as_slice());
        self.likelihood_ratio(xi)
    }

    /// That of the normal law, wherever its mean is.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        1.0 + LOG_2_PI
    }

    fn normalisation_error(&self) -> f64 {
        0.0
    }
}
