//! The family of laws of finitely many outcomes: `w = softmax(logits)`, `delta^0_i = w_i / sum_j p_j w_j`,
//! `M = max_i delta^0_i`, followed by identity mixing.

use crate::game::budget::{Budget, Mixing};
use crate::game::perturbation::{Family, Perturbation};
use lava_envs::law::{FiniteLaw, sample_index};
use rand::Rng;

/// The finite family over `N` outcomes; its parameters are the logits, shape `[N]`.
#[derive(Debug, Clone, Copy, Default)]
pub struct FiniteFamily<const N: usize>;

/// An admissible perturbation of a finite law.
#[derive(Debug, Clone)]
pub struct FinitePerturbation<const N: usize> {
    nominal: [f64; N],
    /// delta^0; 1 where the nominal probability is 0.
    base: [f64; N],
    /// The outcome where delta^0 attains M.
    top: usize,
    mixing: Mixing,
    /// delta.
    ratio: [f64; N],
    /// P delta.
    perturbed: [f64; N],
}

impl<const N: usize> Family for FiniteFamily<N> {
    type Law = FiniteLaw<N>;
    type Perturbation = FinitePerturbation<N>;

    fn parameters(&self) -> usize {
        N
    }

    fn perturbation(
        &self,
        parameters: &[f64],
        law: &FiniteLaw<N>,
        budget: Budget,
    ) -> FinitePerturbation<N> {
        let nominal = law.probabilities;
        // The softmax's own normaliser cancels in delta^0. Outcomes that cannot happen have no say
        // in M: their ratio multiplies nothing.
        let mut top = usize::MAX;
        for i in 0..N {
            if nominal[i] > 0.0 && (top == usize::MAX || parameters[i] > parameters[top]) {
                top = i;
            }
        }
        let possible = |i: usize| nominal[i] > 0.0;
        let weights: [f64; N] = std::array::from_fn(|i| {
            if possible(i) { (parameters[i] - parameters[top]).exp() } else { 0.0 }
        });
        let sum: f64 = (0..N).map(|i| nominal[i] * weights[i]).sum();
        let base = std::array::from_fn(|i| if possible(i) { weights[i] / sum } else { 1.0 });
        let mixing = budget.mix(-sum.ln());
        let ratio = base.map(|base| mixing.likelihood_ratio(base));
        let perturbed = std::array::from_fn(|i| nominal[i] * ratio[i]);
        FinitePerturbation { nominal, base, top, mixing, ratio, perturbed }
    }
}

impl<const N: usize> FinitePerturbation<N> {
    /// The perturbed probabilities P_t(o) delta_t(o).
    pub fn probabilities(&self) -> &[f64; N] {
        &self.perturbed
    }

    /// Adds `weight * d delta_i / d logits` to the gradient. With q^0 = P delta^0:
    /// dlog delta^0_i / d logit_k = [i = k] - q^0_k, and the same at the top for log M.
    fn add_ratio_gradient(&self, i: usize, weight: f64, gradient: &mut [f64]) {
        let (by_base, by_supremum) = self.mixing.derivatives(self.base[i]);
        gradient[i] += weight * by_base;
        gradient[self.top] += weight * by_supremum;
        for (entry, (nominal, base)) in gradient.iter_mut().zip(self.nominal.iter().zip(self.base))
        {
            *entry -= weight * (by_base + by_supremum) * nominal * base;
        }
    }
}

impl<const N: usize> Perturbation for FinitePerturbation<N> {
    type Law = FiniteLaw<N>;

    fn likelihood_ratio(&self, outcome: usize) -> f64 {
        self.ratio[outcome]
    }

    fn supremum(&self) -> f64 {
        self.ratio[self.top]
    }

    fn infimum(&self) -> f64 {
        let possible = (0..N).filter(|&i| self.nominal[i] > 0.0);
        possible.map(|i| self.ratio[i]).fold(f64::INFINITY, f64::min)
    }

    fn sample<R: Rng>(&self, random: &mut R) -> usize {
        sample_index(&self.perturbed, random)
    }

    fn score(&self, outcome: usize, gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        self.add_ratio_gradient(outcome, 1.0 / self.ratio[outcome], gradient);
        self.ratio[outcome]
    }

    /// H(q) = -sum q log q of the perturbed law q = P delta.
    fn entropy(&self, gradient: &mut [f64]) -> f64 {
        gradient.fill(0.0);
        let mut entropy = 0.0;
        for i in 0..N {
            let q = self.perturbed[i];
            if q > 0.0 {
                let log_q = q.ln();
                entropy -= q * log_q;
                // The constant 1 of d(q log q) drops out: sum_i P_i d delta_i = 0.
                self.add_ratio_gradient(i, -self.nominal[i] * log_q, gradient);
            }
        }
        entropy
    }

    fn normalisation_error(&self) -> f64 {
        (self.perturbed.iter().sum::<f64>() - 1.0).abs()
    }
}
