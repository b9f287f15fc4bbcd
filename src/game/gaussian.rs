//! The Gaussian family (point mass): a weighted sum of bumps of likelihood ratio in noise space.
//!
//! `delta^0 = sum_j w_j delta^0_j` with [`Bump`]s delta^0_j and weights w = softmax(logits). One bump
//! can shift the noise; two can at once shift it a little and raise the odds of a rare gust. Then
//! `sup delta^0 <= M = sum_j w_j M_j`, with equality for one bump, and identity mixing by this M keeps
//! the budget. The perturbed law is the mixture of N(0, I), with weight lambda, and N(m_j, S_j), with
//! weights (1 - lambda) w_j.

use crate::game::budget::{Budget, Mixing};
use crate::game::bump::{self, Bump};
use crate::game::perturbation::{Family, Perturbation};
use lava_envs::GaussianLaw;
use nalgebra::Vector2;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;

/// The most bumps of a family.
pub const MAX_BUMPS: usize = 3;

/// What zero parameters mean on the diagonal of each bump's L, before squashing: a mild round bump
/// first, then narrower ones.
const NEUTRAL_DIAGONAL: [f64; MAX_BUMPS] = [0.1, 0.3, 0.6];

/// The Gaussian family. Its parameters are those of each bump and then, of several bumps, the logits
/// of their weights.
#[derive(Debug, Clone, Copy)]
pub struct GaussianFamily {
    /// Number of bumps, 1 to [`MAX_BUMPS`].
    pub bumps: usize,
    /// Bound of |c|.
    pub center_bound: f64,
    /// Bound of the eigenvalues of K.
    pub curvature_bound: f64,
}

/// An admissible perturbation of the standard normal law.
#[derive(Debug, Clone)]
pub struct GaussianPerturbation {
    /// The bumps; those after the first `count` have weight 0.
    bumps: [Bump; MAX_BUMPS],
    weights: [f64; MAX_BUMPS],
    count: usize,
    /// M.
    supremum: f64,
    mixing: Mixing,
}

impl Family for GaussianFamily {
    type Law = GaussianLaw;
    type Perturbation = GaussianPerturbation;

    fn parameters(&self) -> usize {
        bump::PARAMETERS * self.bumps + if self.bumps > 1 { self.bumps } else { 0 }
    }

    fn perturbation(
        &self,
        parameters: &[f64],
        _law: &GaussianLaw,
        budget: Budget,
    ) -> GaussianPerturbation {
        let count = self.bumps;
        let bump = |j: usize| {
            let own = &parameters[bump::PARAMETERS * j..][..bump::PARAMETERS];
            Bump::new(own, NEUTRAL_DIAGONAL[j], self.center_bound, self.curvature_bound)
        };
        let mut bumps = [bump(0); MAX_BUMPS];
        let mut weights = [1.0, 0.0, 0.0];
        if count > 1 {
            let logits = &parameters[bump::PARAMETERS * count..][..count];
            let highest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            for (j, logit) in logits.iter().enumerate() {
                bumps[j] = bump(j);
                weights[j] = (logit - highest).exp();
            }
            let sum: f64 = weights[..count].iter().sum();
            weights[..count].iter_mut().for_each(|weight| *weight /= sum);
        }
        let log_supremum = if count == 1 {
            bumps[0].log_supremum()
        } else {
            (0..count).map(|j| weights[j] * bumps[j].log_supremum().exp()).sum::<f64>().ln()
        };
        let mixing = budget.mix(log_supremum);
        GaussianPerturbation { bumps, weights, count, supremum: log_supremum.exp(), mixing }
    }
}

impl GaussianPerturbation {
    /// The bumps with their weights w_j.
    pub fn bumps(&self) -> impl Iterator<Item = (f64, &Bump)> {
        self.weights[..self.count].iter().copied().zip(&self.bumps)
    }

    /// M, the bound of sup delta^0.
    pub fn base_supremum(&self) -> f64 {
        self.supremum
    }

    /// 1 - lambda, the share of the bumps in the mixture.
    pub fn weight(&self) -> f64 {
        self.mixing.weight
    }

    /// delta^0(xi).
    fn base(&self, xi: Vector2<f64>) -> f64 {
        self.bumps().map(|(weight, bump)| weight * bump.likelihood_ratio(xi)).sum()
    }

    /// Writes the gradient by the parameters of a sum over the bumps j, given how it depends on
    /// (log w_j with log delta^0_j(xi), log w_j with log M_j, log|I+K_j|, w_j alone).
    fn pull_back(
        &self,
        xi: Vector2<f64>,
        gradient: &mut [f64],
        by: impl Fn(f64, &Bump) -> [f64; 4],
    ) {
        let mut by_logarithm = [0.0; MAX_BUMPS];
        for (j, (weight, bump)) in self.bumps().enumerate() {
            let [by_ratio, by_supremum, by_determinant, by_weight] = by(weight, bump);
            let own = &mut gradient[bump::PARAMETERS * j..][..bump::PARAMETERS];
            bump.pull_back(xi, by_ratio, by_supremum, by_determinant, own);
            by_logarithm[j] = by_ratio + by_supremum + by_weight * weight;
        }
        if self.count > 1 {
            // dlog w_j / d logit_k = [j = k] - w_k.
            let sum: f64 = by_logarithm.iter().sum();
            let logits = &mut gradient[bump::PARAMETERS * self.count..][..self.count];
            for (k, logit) in logits.iter_mut().enumerate() {
                *logit = by_logarithm[k] - self.weights[k] * sum;
            }
        }
    }
}

impl Perturbation for GaussianPerturbation {
    type Law = GaussianLaw;

    fn likelihood_ratio(&self, xi: Vector2<f64>) -> f64 {
        self.mixing.likelihood_ratio(self.base(xi))
    }

    fn supremum(&self) -> f64 {
        self.mixing.likelihood_ratio(self.supremum)
    }

    /// lambda: far from the bumps delta^0 tends to 0.
    fn infimum(&self) -> f64 {
        1.0 - self.mixing.weight
    }

    /// A draw from the mixture of N(0, I) and the N(m_j, S_j).
    fn sample<R: Rng>(&self, random: &mut R) -> Vector2<f64> {
        let mut level = random.random::<f64>();
        let z = Vector2::new(random.sample(StandardNormal), random.sample(StandardNormal));
        for (weight, bump) in self.bumps() {
            level -= self.mixing.weight * weight;
            if level < 0.0 {
                return bump.place(z);
            }
        }
        z
    }

    fn score(&self, xi: Vector2<f64>, gradient: &mut [f64]) -> f64 {
        let base = self.base(xi);
        let ratio = self.mixing.likelihood_ratio(base);
        // delta = 1 + rho (delta^0 - 1), and rho depends on log M.
        let (_, by_supremum) = self.mixing.derivatives(base);
        self.pull_back(xi, gradient, |weight, bump| {
            let by_ratio = self.mixing.weight * weight * bump.likelihood_ratio(xi) / ratio;
            let share = weight * bump.log_supremum().exp() / self.supremum;
            [by_ratio, by_supremum * share / ratio, 0.0, 0.0]
        });
        ratio
    }

    /// The entropy of a mixture has no closed form. By concavity it is at least
    /// `lambda H(N(0,I)) + (1-lambda) sum_j w_j H(N(m_j,S_j))
    /// = 1 + log 2 pi - (1-lambda)/2 sum_j w_j log|I+K_j|`, which is the bonus.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        let lost: f64 = self.bumps().map(|(weight, bump)| weight * bump.log_determinant()).sum();
        let by_supremum = -0.5 * lost * self.mixing.by_log_supremum;
        self.pull_back(Vector2::zeros(), gradient, |weight, bump| {
            let share = weight * bump.log_supremum().exp() / self.supremum;
            let by_weight = -0.5 * self.mixing.weight * bump.log_determinant();
            [0.0, by_supremum * share, -0.5 * self.mixing.weight * weight, by_weight]
        });
        1.0 + (2.0 * std::f64::consts::PI).ln() - 0.5 * self.mixing.weight * lost
    }

    /// From the integrals of the bumps, each evaluated with a decomposition of K of its own.
    fn normalisation_error(&self) -> f64 {
        let off = |(weight, bump): (f64, &Bump)| {
            weight * (bump.log_supremum() + bump.log_integral()).exp_m1()
        };
        self.mixing.weight * self.bumps().map(off).sum::<f64>().abs()
    }
}
