//! Perturbations of chance: what an antagonist may do in one step.
//!
//! A perturbation is a likelihood ratio delta_t > 0 with `E_P[delta_t]` = 1 and
//! sup delta_t <= eta_t; chance then follows P_t(o) delta_t(o). A [`Family`] turns a few real
//! parameters, the outputs of a network, into a perturbation that is admissible by construction,
//! and knows the gradients that learning needs. All of it in f64: forty factors must multiply to
//! 1e-6.

use crate::game::budget::Budget;
use lava_envs::Law;
use rand::Rng;

/// A parametric family of perturbations of one kind of law.
pub trait Family: Clone + std::fmt::Debug {
    /// The nominal law it perturbs.
    type Law: Law;
    /// An admissible perturbation.
    type Perturbation: Perturbation<Law = Self::Law>;

    /// Number of parameters.
    fn parameters(&self) -> usize;

    /// The perturbation of `law` with these parameters (any real numbers), made admissible within
    /// `budget` by identity mixing.
    fn perturbation(
        &self,
        parameters: &[f64],
        law: &Self::Law,
        budget: Budget,
    ) -> Self::Perturbation;
}

/// One admissible perturbation delta_t of a law P_t.
pub trait Perturbation {
    /// The nominal law it perturbs.
    type Law: Law;

    /// delta_t(o).
    fn likelihood_ratio(&self, outcome: <Self::Law as Law>::Outcome) -> f64;

    /// sup_o delta_t(o), at most the budget.
    fn supremum(&self) -> f64;

    /// inf_o delta_t(o) over the outcomes that can happen, or a lower bound of it.
    fn infimum(&self) -> f64;

    /// Draws an outcome from the perturbed law P_t delta_t.
    fn sample<R: Rng>(&self, random: &mut R) -> <Self::Law as Law>::Outcome;

    /// Writes the gradient of log delta_t(o) by the family's parameters; answers with delta_t(o).
    fn score(&self, outcome: <Self::Law as Law>::Outcome, gradient: &mut [f64]) -> f64;

    /// The entropy of the perturbed law in nats, or the family's lower bound of it, and its
    /// gradient by the family's parameters.
    fn entropy(&self, gradient: &mut [f64]) -> f64;

    /// |`E_P[delta_t]` - 1|, by the closed form of the family, for the budget audit.
    fn normalisation_error(&self) -> f64;
}
