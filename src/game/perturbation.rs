//! Perturbations of chance: what an antagonist may do in one step.
//!
//! A perturbation is a likelihood ratio delta_t > 0 with `E_P[delta_t]` = 1 and
//! sup delta_t <= eta_t; chance then follows P_t(o) delta_t(o). A [`Family`] turns a few real
//! parameters, the outputs of a network, into a perturbation that is admissible by construction,
//! and knows the gradients that learning needs. All of it in f64: forty factors must multiply to
//! 1e-6.

use crate::game::budget::Budget;
use crate::game::columns::{Column, ln};
use lava_envs::Law;
use rand::Rng;

/// A parametric family of perturbations of one kind of law.
pub trait Family: Clone + std::fmt::Debug + Send {
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

    /// Draws outcomes of a block of laws. Families override it with columns ([`super::columns`]); this is their
    /// reference.
    fn draw<R: Rng>(&self, draws: Draws<'_, '_, Self::Law, R>) {
        let Draws { parameters, laws, budgets, random, nominal, outcomes, ratios, .. } = draws;
        let mut error: f64 = 0.0;
        let mut own = vec![0.0; self.parameters()];
        for (i, random) in random.iter_mut().enumerate() {
            for (own, column) in own.iter_mut().zip(parameters) {
                *own = column[i];
            }
            let perturbation = self.perturbation(&own, &laws[i], budgets[i]);
            let outcome =
                if nominal { laws[i].sample(random) } else { perturbation.sample(random) };
            outcomes.push(outcome);
            ratios[i] = perturbation.likelihood_ratio(outcome);
            error = error.max(perturbation.normalisation_error());
        }
        if let Some(largest) = draws.normalisation_error {
            *largest = largest.max(error);
        }
    }

    /// What learning needs of the perturbations of a block of samples. Families override it with columns
    /// ([`super::columns`]); this is their reference.
    fn learn(&self, block: Block<'_, Self::Law>) {
        let Block { parameters, given, outcomes, log_ratio, entropy, score, entropy_gradient } =
            block;
        let count = self.parameters();
        let mut own = vec![0.0; count];
        let mut gradient = vec![0.0; count];
        for (i, ((law, budget), &outcome)) in given.iter().zip(outcomes).enumerate() {
            for (own, column) in own.iter_mut().zip(parameters) {
                *own = column[i];
            }
            let perturbation = self.perturbation(&own, law, *budget);
            log_ratio[i] = ln(perturbation.score(outcome, &mut gradient));
            for (column, entry) in score.iter_mut().zip(&gradient) {
                column[i] = *entry;
            }
            entropy[i] = perturbation.entropy(&mut gradient);
            for (column, entry) in entropy_gradient.iter_mut().zip(&gradient) {
                column[i] = *entry;
            }
        }
    }
}

/// Perturbations of at most `SAMPLES` laws, of which outcomes are drawn.
pub struct Draws<'a, 'r, L: Law, R> {
    /// The family's parameters, a column each.
    pub parameters: &'a [Column],
    /// The laws.
    pub laws: &'a [L],
    /// The budgets.
    pub budgets: &'a [Budget],
    /// What to draw with, one for each law.
    pub random: &'a mut [&'r mut R],
    /// Whether to draw from P instead of P delta.
    pub nominal: bool,
    /// Receives the outcomes o.
    pub outcomes: &'a mut Vec<L::Outcome>,
    /// Receives delta(o).
    pub ratios: &'a mut [f64],
    /// Becomes the largest [`Perturbation::normalisation_error`] of all and itself, if it is requested.
    pub normalisation_error: Option<&'a mut f64>,
}

/// What learning needs of the perturbations of at most `SAMPLES` samples.
pub struct Block<'a, L: Law> {
    /// The family's parameters, a column each.
    pub parameters: &'a [Column],
    /// The laws and the budgets.
    pub given: &'a [(L, Budget)],
    /// The realised outcomes o.
    pub outcomes: &'a [L::Outcome],
    /// Receives log delta(o).
    pub log_ratio: &'a mut Column,
    /// Receives the entropy or its lower bound, as [`Perturbation::entropy`].
    pub entropy: &'a mut Column,
    /// Receives the gradient of log delta(o) by the parameters.
    pub score: &'a mut [Column],
    /// Receives that of the entropy.
    pub entropy_gradient: &'a mut [Column],
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
