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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::game::returns::{Atom, ReturnLaw};
    use lava_envs::End;

    const STEPS: usize = 2;
    const GAMMA: f64 = 0.9;
    /// P(outcome 0 | action).
    const FIRST: [f64; 3] = [0.3, 0.6, 0.5];
    /// Reward by step, action and outcome; the last action keeps every return above VaR.
    const REWARDS: [[[f64; 2]; 3]; STEPS] =
        [[[-1.0, 0.4], [0.1, -0.7], [2.1, 2.3]], [[-0.2, 0.55], [0.9, -1.3], [0.35, 0.3]]];
    /// Logits of the policy, the same in every state.
    const LOGITS: [f64; 3] = [0.2, -0.3, 0.5];

    fn policy(logits: &[f64; 3]) -> [f64; 3] {
        let sum: f64 = logits.iter().map(|logit| logit.exp()).sum();
        logits.map(|logit| logit.exp() / sum)
    }

    /// What happened in each step: action and outcome.
    type History = Vec<(usize, usize)>;

    fn so_far(history: &[(usize, usize)]) -> ReturnSoFar {
        let mut sum = ReturnSoFar::START;
        for (t, &(action, outcome)) in history.iter().enumerate() {
            sum.add(REWARDS[t][action][outcome], GAMMA);
        }
        sum
    }

    fn chance(action: usize, outcome: usize) -> f64 {
        if outcome == 0 { FIRST[action] } else { 1.0 - FIRST[action] }
    }

    fn continued(history: &[(usize, usize)]) -> impl Iterator<Item = History> {
        let steps = (0..3).flat_map(|action| [(action, 0), (action, 1)]);
        steps.map(move |step| [history, &[step]].concat())
    }

    fn probability(policy: &[f64; 3], history: &[(usize, usize)]) -> f64 {
        history.iter().map(|&(action, outcome)| policy[action] * chance(action, outcome)).product()
    }

    fn whole() -> Vec<History> {
        continued(&[]).flat_map(|history| continued(&history).collect::<Vec<_>>()).collect()
    }

    fn law(policy: &[f64; 3]) -> ReturnLaw {
        let atom = |history: &History| Atom {
            mass: probability(policy, history),
            ..so_far(history).ended(End::Goal)
        };
        ReturnLaw::exact(whole().iter().map(atom).collect())
    }

    /// The worst case of a policy: the episodes conditioned on the tail, of which the atom at VaR counts with
    /// the share that fits.
    struct Worst {
        policy: [f64; 3],
        at_risk: f64,
        share: f64,
    }

    impl Worst {
        fn new(policy: [f64; 3], eta: Eta) -> Self {
            let law = law(&policy);
            let (mut missing, mut worst) = (eta.alpha(), None);
            for atom in law.atoms() {
                if worst.is_none() && atom.mass >= missing {
                    worst = Some((atom.value, missing / atom.mass));
                }
                missing -= atom.mass;
            }
            let (at_risk, share) = worst.unwrap();
            Worst { policy, at_risk, share }
        }

        /// Probability that an episode which began so ends in the tail.
        fn tail(&self, history: &[(usize, usize)]) -> f64 {
            if history.len() < STEPS {
                let going_on = continued(history);
                return going_on.map(|next| self.odds(history, &next) * self.tail(&next)).sum();
            }
            let value = so_far(history).value;
            if value < self.at_risk {
                1.0
            } else if value == self.at_risk {
                self.share
            } else {
                0.0
            }
        }

        fn odds(&self, history: &[(usize, usize)], next: &[(usize, usize)]) -> f64 {
            let (action, outcome) = next[history.len()];
            self.policy[action] * chance(action, outcome)
        }

        /// Mean of the remaining return under the worst case.
        fn mean(&self, history: &[(usize, usize)]) -> f64 {
            if history.len() == STEPS {
                return 0.0;
            }
            let of_next = |next: History| {
                let (action, outcome) = next[history.len()];
                let reward = REWARDS[history.len()][action][outcome];
                let odds = self.odds(history, &next) * self.tail(&next) / self.tail(history);
                if odds > 0.0 { odds * (reward + GAMMA * self.mean(&next)) } else { 0.0 }
            };
            continued(history).map(of_next).sum()
        }

        /// delta_A of an action.
        fn ratio(&self, history: &[(usize, usize)], action: usize) -> f64 {
            let after = |outcome| self.tail(&[history, &[(action, outcome)]].concat());
            let mean: f64 = (0..2).map(|outcome| chance(action, outcome) * after(outcome)).sum();
            mean / self.tail(history)
        }

        /// E_Q[sum_t gamma^t grad log pi(a_t) A_t] by the logits, with these advantages.
        fn gradient(&self, at_risk: Option<f64>) -> [f64; 3] {
            let mut gradient = [0.0; 3];
            for history in whole() {
                let odds =
                    probability(&self.policy, &history) * self.tail(&history) / self.tail(&[]);
                if odds == 0.0 {
                    continue;
                }
                let value = so_far(&history).value;
                for t in 0..STEPS {
                    let (before, action) = (&history[..t], history[t].0);
                    let so_far = so_far(before);
                    let mean = self.mean(before);
                    let estimates = Estimates {
                        values: vec![-mean as f32],
                        advantages: vec![(mean - so_far.missing(value)) as f32],
                    };
                    let all = [0, 1, 2].map(|action| self.ratio(before, action));
                    let least = all.into_iter().fold(f64::INFINITY, f64::min);
                    let ratio = Ratio { realised: all[action], least };
                    let advantage = advantages(&estimates, &[ratio], &[Some(so_far)], at_risk)[0];
                    for (i, sum) in gradient.iter_mut().enumerate() {
                        let score = f64::from(i == action) - self.policy[i];
                        *sum += odds * GAMMA.powi(t as i32) * score * f64::from(advantage);
                    }
                }
            }
            gradient
        }
    }

    /// Against the exact worst case, over all episodes of a small game, the gradient with the price of the
    /// budget is the derivative of the exact CVaR; without the price it is not.
    #[test]
    fn the_priced_gradient_is_that_of_cvar() {
        for eta in [1.2, 2.0, 3.7, 8.0] {
            let eta = Eta::new(eta).unwrap();
            let worst = Worst::new(policy(&LOGITS), eta);
            let exact: [f64; 3] = std::array::from_fn(|i| {
                let shifted = |by: f64| {
                    let mut logits = LOGITS;
                    logits[i] += by;
                    law(&policy(&logits)).cvar(eta.alpha())
                };
                (shifted(1e-5) - shifted(-1e-5)) / 2e-5
            });
            let distance = |at_risk| {
                let off =
                    worst.gradient(at_risk).into_iter().zip(exact).map(|(a, b)| (a - b).abs());
                off.fold(0.0, f64::max)
            };
            let priced = distance(Some(worst.at_risk));
            assert!(priced < 1e-5, "eta = {}: {priced}", eta.get());
            assert!(distance(None) > 1e-2, "eta = {}: {}", eta.get(), distance(None));
        }
    }

    /// Episodes against an antagonist, weighted, have the VaR of nominal ones.
    #[test]
    fn weighted_episodes_have_the_nominal_var() {
        let of = |value, likelihood_ratio| Finished { value, likelihood_ratio };
        // The antagonist draws 0 and 1 twice as often as chance would, and 3 rarely.
        let episodes = [of(3.0, 1e-3), of(0.0, 2.0), of(1.0, 2.0), of(0.0, 2.0), of(1.0, 2.0)];
        let at = |eta| value_at_risk(&episodes, Eta::new(eta).unwrap()).unwrap();
        assert_eq!([at(2.5), at(5.0), at(10.0)], [1.0, 0.0, 0.0]);
        assert_eq!(at(1.0), 3.0);
        assert_eq!(value_at_risk(&[], Eta::NEUTRAL), None);
    }
}
