//! Certificates of trained policies: how far they are from the best attainable CVaR, without sampling
//! error.
//!
//! | certificate | definition |
//! |---|---|
//! | regret | V*(eta) - CVaR_{1/eta} of the greedy policy; at eta = 1 the best mean minus its mean |
//! | antagonist gap | value of the greedy policy under the learned antagonist, minus its CVaR_{1/eta} |
//! | bound | the game value under any admissible antagonist is at least CVaR_{1/eta} of the policy |
//!
//! The value under a learned antagonist depends on the remaining budget and is sampled elsewhere;
//! [`Certificate::antagonist_gap`] subtracts. Three numbers are never conflated: the game value, the
//! CVaR of the sampled policy, and the CVaR of the greedy policy.

use super::law::evaluate;
use super::mdp::FiniteMdp;
use super::optimum::Optimum;
use super::policy::Policy;
use super::{ExactError, require_eta};
use crate::game::returns::ReturnLaw;
use lava_envs::End;
use serde::Serialize;

/// The exact risk of one policy.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Risk {
    /// `E[J]`.
    pub mean: f64,
    /// CVaR_alpha(J).
    pub cvar: f64,
    /// VaR_alpha(J).
    pub var: f64,
    /// Probability of ending in lava.
    pub lava_probability: f64,
    /// Probability of reaching the goal.
    pub goal_probability: f64,
    /// Probability of reaching the time limit.
    pub timeout_probability: f64,
}

impl Risk {
    /// The risk measures of a law at level alpha.
    ///
    /// # Errors
    /// If alpha is outside (0, 1].
    pub fn of(law: &ReturnLaw, alpha: f64) -> Result<Risk, ExactError> {
        super::require_alpha(alpha)?;
        Ok(Risk {
            mean: law.mean(),
            cvar: law.cvar(alpha),
            var: law.var(alpha),
            lava_probability: law.probability(End::Lava),
            goal_probability: law.probability(End::Goal),
            timeout_probability: law.probability(End::Timeout),
        })
    }
}

/// What is certain about a trained policy.
#[derive(Debug, Clone, PartialEq)]
pub struct Certificate {
    /// Budget eta of the comparison.
    pub eta: f64,
    /// alpha = 1/eta.
    pub alpha: f64,
    /// V*(eta), the best attainable CVaR_alpha.
    pub optimal_cvar: f64,
    /// The policy that always takes the likeliest action.
    pub greedy: Risk,
    /// The policy that draws its actions.
    pub sampled: Risk,
    /// V*(eta) - CVaR_alpha of the greedy policy, not negative up to rounding.
    pub regret: f64,
    /// The exact law of the greedy policy, for other risk levels.
    pub greedy_law: ReturnLaw,
    /// The exact law of the sampled policy, for other risk levels.
    pub sampled_law: ReturnLaw,
}

impl Certificate {
    /// Compares policies with the optimum at alpha = 1/eta.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite, or `optimum` is for another risk level.
    pub fn new(
        mdp: &FiniteMdp,
        optimum: &Optimum,
        greedy: &Policy,
        sampled: &Policy,
        eta: f64,
    ) -> Result<Certificate, ExactError> {
        let alpha = require_eta(eta)?;
        if optimum.alpha != alpha {
            return Err(ExactError::Alpha(optimum.alpha));
        }
        let greedy_law = evaluate(mdp, greedy).law;
        let sampled_law = evaluate(mdp, sampled).law;
        let greedy = Risk::of(&greedy_law, alpha)?;
        Ok(Certificate {
            eta,
            alpha,
            optimal_cvar: optimum.cvar,
            regret: optimum.cvar - greedy.cvar,
            sampled: Risk::of(&sampled_law, alpha)?,
            greedy,
            greedy_law,
            sampled_law,
        })
    }

    /// How much better the greedy policy does under a learned antagonist than in the worst case;
    /// `value` is its mean return under that antagonist. Not negative up to the sampling error of
    /// `value`: below that, the antagonist exceeds its budget.
    pub fn antagonist_gap(&self, value: f64) -> f64 {
        value - self.greedy.cvar
    }
}
