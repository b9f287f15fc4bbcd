//! What the protagonist's gradient owes to the budget, in the game `joint`.
//!
//! There the value of the game is the CVaR of the sampled policy, and its derivative is (Tamar and others,
//! AAAI 2015)
//!
//! ```text
//! grad CVaR = E_Q[ sum_t grad log pi(a_t|s_t) (J - VaR) ],
//! ```
//!
//! with Q the law of episodes against the worst antagonist. This is the envelope theorem: it holds where the
//! antagonist plays its best, as the leader of Algorithm 1 assumes. With V_A and A_A, value and advantage of
//! the antagonist before the draw, J - VaR becomes in step t
//!
//! ```text
//! -A_A - D,    D = VaR_t - CVaR_t = VaR_t + V_A(s_t, eta_t),    VaR_t = (VaR - sum_{k<t} gamma^k r_k) / gamma^t.
//! ```
//!
//! D is the price of the budget, dV_A / dlog eta_t. No baseline may be taken from it: under Q the mean of the
//! score is not 0. But that of grad log pi / delta_A is, because Q draws a_t from pi delta_A. So what is used is
//!
//! ```text
//! -A_A - D (1 - kappa / delta_A(a_t)),    kappa = min(1, C inf delta_A),
//! ```
//!
//! the same gradient with less noise. Where the antagonist leaves the draw alone it is the usual advantage -A_A.
//! kappa keeps the factor of D below C; where the antagonist excludes an action it is 0.
//!
//! VaR is that of the policy's return under nominal chance. Episodes against the antagonist give it without
//! bias if each has the weight 1 / prod delta.

use super::family::Ratio;
use super::gae::Estimates;
use crate::game::budget::Eta;
use crate::game::returns::ReturnSoFar;

/// C, the largest kappa / delta_A.
const LARGEST: f64 = 5.0;

/// An episode that has ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Finished {
    /// Its return J, discounted.
    pub value: f64,
    /// prod delta.
    pub likelihood_ratio: f64,
}

/// VaR_{1/eta} of the return under nominal chance, by episodes against an antagonist; `None` without any.
pub fn value_at_risk(episodes: &[Finished], eta: Eta) -> Option<f64> {
    let mut ascending = episodes.to_vec();
    ascending.sort_by(|a, b| a.value.total_cmp(&b.value));
    let mut missing = eta.alpha() * episodes.len() as f64;
    for episode in &ascending {
        missing -= 1.0 / episode.likelihood_ratio;
        if missing <= 0.0 {
            return Some(episode.value);
        }
    }
    ascending.last().map(|episode| episode.value)
}

/// The protagonist's advantages along a rollout, shape `[steps, slots]`. `estimates` and `ratios` are those of
/// the antagonist of the draw. `so_far` is the return before each step; where it or VaR is not known, as in
/// an episode that started anywhere, the budget has no price.
pub fn advantages(
    estimates: &Estimates,
    ratios: &[Ratio],
    so_far: &[Option<ReturnSoFar>],
    value_at_risk: Option<f64>,
) -> Vec<f32> {
    let steps = estimates.advantages.iter().zip(&estimates.values).zip(ratios.iter().zip(so_far));
    steps
        .map(|((&advantage, &value), (ratio, so_far))| {
            let at_risk = value_at_risk.zip(*so_far).map(|(all, so_far)| so_far.missing(all));
            let price = at_risk.map_or(0.0, |at_risk| (at_risk + f64::from(value)).max(0.0));
            let kappa = (LARGEST * ratio.least).min(1.0);
            (-f64::from(advantage) - price * (1.0 - kappa / ratio.realised)) as f32
        })
        .collect()
}
