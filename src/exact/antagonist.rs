//! The exact worst-case antagonist of a deterministic policy.
//!
//! The infimum of `E_Q[J]` over the laws Q of trajectories with dQ/dP <= eta is CVaR_{1/eta}(J), and it
//! is attained by conditioning on the tail: with w = VaR_alpha(J), alpha = 1/eta, and the atom at w
//! split so that the tail has probability alpha,
//!
//!   h(t, R, s) = P(tail | s_t = s, R_t = R),
//!   h at the end of an episode: 1 if J < w, (alpha - P(J < w)) / P(J = w) if J = w, 0 if J > w,
//!   delta_t(o) = h(s', t + 1) / h(s, t).
//!
//! h is a martingale under P, so `E_P[delta_t]` = 1. The product of the perturbations of a trajectory
//! telescopes to h(end)/h(start) <= 1/alpha = eta, which is the budget of the paper (Eq. 5), and the
//! remaining budget is eta_t = 1/h(s_t, t) >= sup_o delta_t(o). Its value is CVaR_{1/eta}(J).
//!
//! For a stochastic policy this argument fails: an antagonist that acts once the action is drawn
//! cannot reweight the protagonist's own randomness, and its infimum is in general above the CVaR.

use super::law::{Perturbation, evaluate};
use super::mdp::{FiniteMdp, Node};
use super::optimum::{expectation, land};
use super::policy::Policy;
use super::{ExactError, require_eta};

/// The worst-case antagonist of one deterministic policy at one budget.
#[derive(Debug, Clone)]
pub struct WorstCase<'a> {
    mdp: &'a FiniteMdp,
    /// Budget eta.
    eta: f64,
    /// VaR level w of the return.
    threshold: f64,
    /// Share of the atom at w that belongs to the tail.
    share: f64,
    /// CVaR_{1/eta}(J) under the nominal law.
    cvar: f64,
    /// h, by block and state.
    tail: Vec<f64>,
}

impl<'a> WorstCase<'a> {
    /// The antagonist of `policy` under budget `eta`.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite, or the policy is not deterministic.
    pub fn new(mdp: &'a FiniteMdp, policy: &Policy, eta: f64) -> Result<Self, ExactError> {
        let alpha = require_eta(eta)?;
        if !policy.is_deterministic() {
            return Err(ExactError::Stochastic);
        }
        let law = evaluate(mdp, policy).law;
        let threshold = law.var(alpha);
        let mass = |keep: fn(f64, f64) -> bool| -> f64 {
            law.atoms().iter().filter(|a| keep(a.value, threshold)).map(|a| a.mass).sum()
        };
        let (below, at) = (mass(|value, w| value < w), mass(|value, w| value == w));
        // Only rounding takes the quotient out of [0, 1].
        let share = ((alpha - below) / at).clamp(0.0, 1.0);
        let tail = tail_probabilities(mdp, policy, threshold, share);
        Ok(WorstCase { mdp, eta, threshold, share, cvar: law.cvar(alpha), tail })
    }

    /// Budget eta.
    pub fn eta(&self) -> f64 {
        self.eta
    }

    /// VaR level w: episodes below it are the tail.
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// Share of the atom J = w that belongs to the tail.
    pub fn share(&self) -> f64 {
        self.share
    }

    /// The value of the game: CVaR_{1/eta}(J) of the policy.
    pub fn value(&self) -> f64 {
        self.cvar
    }

    /// h = P(tail | node), under the nominal law and the policy.
    pub fn tail_probability(&self, node: Node) -> f64 {
        self.tail[self.mdp.block(node.time, node.level) * self.mdp.states() + node.state]
    }

    /// Remaining budget eta_t = 1/h; infinite where the tail is out of reach.
    pub fn remaining_budget(&self, node: Node) -> f64 {
        1.0 / self.tail_probability(node)
    }

    /// delta_t(o) at a node, given the action the policy chooses there.
    ///
    /// Where h = 0 (below the least normal number) the tail is out of reach and delta = 1: under this antagonist such nodes have
    /// probability 0. `action` must be the one of the policy, else `E_P[delta]` = 1 does not hold.
    pub fn delta(&self, node: Node, action: usize, outcome: usize) -> f64 {
        let tail = self.tail_probability(node);
        if tail < f64::MIN_POSITIVE {
            return 1.0; // a quotient of subnormal numbers has no meaning
        }
        let after = match self.mdp.successor(node, action, outcome) {
            Some(next) => self.tail_probability(next),
            None => self
                .mdp
                .ending(node, action, outcome)
                .map_or(0.0, |(_, value)| tail_share(value, self.threshold, self.share)),
        };
        after / tail
    }
}

impl Perturbation for WorstCase<'_> {
    fn ratio(&self, node: Node, action: usize, outcome: usize) -> f64 {
        self.delta(node, action, outcome)
    }
}

/// How much of an episode with return `value` belongs to the tail.
fn tail_share(value: f64, threshold: f64, share: f64) -> f64 {
    if value < threshold {
        1.0
    } else if value == threshold {
        share
    } else {
        0.0
    }
}

fn tail_probabilities(mdp: &FiniteMdp, policy: &Policy, threshold: f64, share: f64) -> Vec<f64> {
    let states = mdp.states();
    let at_end: Vec<f64> =
        mdp.returns().iter().map(|&value| tail_share(value, threshold, share)).collect();
    let mut tail = vec![0.0; mdp.block_count() * states];
    let mut landed = vec![0.0; mdp.landings().len()];
    for time in (0..mdp.horizon()).rev() {
        // The levels of one time are consecutive blocks.
        let (now, later) = tail.split_at_mut((mdp.block(time, 0) + mdp.levels(time)) * states);
        for level in 0..mdp.levels(time) {
            land(mdp, time, level, &mut landed, &at_end, later);
            let block = mdp.block(time, level) * states;
            for state in (0..states).filter(|&state| mdp.ended(state).is_none()) {
                let action = policy.action(mdp, Node { time, level, state });
                now[block + state] =
                    expectation(mdp, mdp.pair_range(state).start + action, &landed);
            }
        }
    }
    tail
}
