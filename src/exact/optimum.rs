//! The best attainable CVaR, and a policy that attains it.
//!
//! With alpha in (0, 1] (Rockafellar & Uryasev 2000; Baeuerle & Ott 2011),
//!
//!   max_pi CVaR_alpha(J) = max_w F(w),  F(w) = w - G(w)/alpha,  G(w) = `min_pi E[(w - J)^+]`.
//!
//! G(w) is a finite-horizon dynamic programme over the nodes (t, R_t, s), whose accumulated reward
//! R_t the utility (w - J)^+ needs. For a fixed policy `w - E[(w - J)^+]/alpha` is concave and
//! piecewise linear in w with its breakpoints at values of J, so the maximum over w is attained at an
//! attainable return, and finitely many w are enough.
//!
//! F itself is not concave (G is a minimum of convex functions), so no local search over w is safe.
//! Candidates are left out only where a bound proves that they cannot win: each (w - J)^+ is
//! nondecreasing and 1-Lipschitz in w, hence so is the minimum G, and between evaluated
//! w_1 < w < w_2
//!
//!   G(w) >= max(G(w_1), G(w_2) - (w_2 - w)),   therefore   F(w) <= w - that/alpha.
//!
//! Below the first evaluated candidate G >= 0 takes the place of G(w_1). An interval between evaluated
//! candidates is dropped when the bound of each candidate in it lies below the best F found by more
//! than [`TIE`].
//!
//! Ties: at a node, among the actions of least shortfall the one of highest mean return is taken, and
//! then the first. So where J exceeds w in any case, the policy still walks to the goal. Among several
//! w of the same F the policy of highest mean is taken.

use super::mdp::{FiniteMdp, Node};
use super::policy::Policy;
use super::{ExactError, law, require_alpha};

/// Values of F closer than this are treated as equal.
pub const TIE: f64 = 1e-13;

/// Relative difference up to which two expected shortfalls are taken as equal. A shortfall is a sum
/// of products of non-negative numbers, so its rounding error is a few units in the last place per
/// step, relative to itself.
const SHORTFALL_TIE: f64 = 1e-14;

/// Difference up to which two mean returns are taken as equal.
const MEAN_TIE: f64 = 1e-13;

/// The best attainable CVaR.
#[derive(Debug, Clone, PartialEq)]
pub struct Optimum {
    /// Risk level alpha.
    pub alpha: f64,
    /// max_pi CVaR_alpha(J), which [`Optimum::policy`] attains.
    pub cvar: f64,
    /// VaR_alpha(J) of the optimal policy.
    pub var: f64,
    /// A deterministic optimal policy over (t, R_t, s).
    pub policy: Policy,
    /// The law of J under it and its expected visits.
    pub evaluation: law::Evaluation,
    /// How many of the candidate thresholds were evaluated.
    pub evaluated: usize,
}

/// Solves max_pi CVaR_alpha(J) exactly; alpha = 1 gives the risk-neutral optimum.
///
/// # Errors
/// If alpha is outside (0, 1].
pub fn optimum(mdp: &FiniteMdp, alpha: f64) -> Result<Optimum, ExactError> {
    require_alpha(alpha)?;
    // At alpha = 1 the criterion is the mean. It is what decides where no return falls short of w.
    let (thresholds, evaluated) =
        if alpha == 1.0 { (vec![mdp.returns()[0]], 1) } else { best_thresholds(mdp, alpha) };
    let mut best: Option<Optimum> = None;
    for threshold in thresholds {
        let policy = best_policy(mdp, threshold);
        let evaluation = law::evaluate(mdp, &policy);
        let better =
            best.as_ref().is_none_or(|best| evaluation.law.mean() > best.evaluation.law.mean());
        if better {
            best = Some(Optimum {
                alpha,
                cvar: evaluation.law.cvar(alpha),
                var: evaluation.law.var(alpha),
                policy,
                evaluation,
                evaluated,
            });
        }
    }
    // The search keeps at least the best threshold it saw.
    best.ok_or(ExactError::Alpha(alpha))
}

/// Candidates between two evaluated ones (positions among the returns), and the best F they may have.
struct Interval {
    candidates: std::ops::Range<usize>,
    bound: f64,
}

/// The thresholds whose F is maximal (within [`TIE`]), ascending, and how many were evaluated.
fn best_thresholds(mdp: &FiniteMdp, alpha: f64) -> (Vec<f64>, usize) {
    let returns = mdp.returns();
    let mut programme = Shortfall::new(mdp);
    // (position, G)
    let mut evaluated: Vec<(usize, f64)> = Vec::new();
    let mut best = f64::NEG_INFINITY;
    let mut open = vec![Interval { candidates: 0..returns.len(), bound: f64::INFINITY }];
    while let Some(position) =
        (0..open.len()).max_by(|&a, &b| open[a].bound.total_cmp(&open[b].bound))
    {
        let Interval { candidates, bound } = open.swap_remove(position);
        if bound < best - TIE {
            break; // it was the interval with the highest bound
        }
        let middle = candidates.start + candidates.len() / 2;
        let w = returns[middle];
        let shortfall = programme.least(w);
        best = best.max(w - shortfall / alpha);
        let place = evaluated.partition_point(|(at, _)| *at < middle);
        let below = if place == 0 { 0.0 } else { evaluated[place - 1].1 };
        let above = evaluated.get(place).map(|&(at, g)| (returns[at], g));
        evaluated.insert(place, (middle, shortfall));
        let mut push =
            |candidates: std::ops::Range<usize>, below: f64, above: Option<(f64, f64)>| {
                let bound = candidates
                    .clone()
                    .map(|candidate| {
                        let w = returns[candidate];
                        let right = above.map_or(0.0, |(w_2, g)| g - (w_2 - w));
                        w - below.max(right) / alpha
                    })
                    .fold(f64::NEG_INFINITY, f64::max);
                if !candidates.is_empty() {
                    open.push(Interval { candidates, bound });
                }
            };
        push(candidates.start..middle, below, Some((w, shortfall)));
        push(middle + 1..candidates.end, shortfall, above);
    }
    let thresholds = evaluated
        .iter()
        .map(|&(at, shortfall)| (returns[at], shortfall))
        .filter(|(w, shortfall)| w - shortfall / alpha >= best - TIE)
        .map(|(w, _)| w)
        .collect();
    (thresholds, evaluated.len())
}

/// The programme G(w), values only.
struct Shortfall<'a> {
    mdp: &'a FiniteMdp,
    /// (w - J)^+ by return.
    excess: Vec<f64>,
    /// By landing: the shortfall to go after it.
    landed: Vec<f64>,
    /// By level and state, at the next time.
    next: Vec<f64>,
    now: Vec<f64>,
}

impl<'a> Shortfall<'a> {
    fn new(mdp: &'a FiniteMdp) -> Self {
        Shortfall {
            mdp,
            excess: vec![0.0; mdp.returns().len()],
            landed: vec![0.0; mdp.landings().len()],
            next: Vec::new(),
            now: Vec::new(),
        }
    }

    /// G(w) = `min_pi E[(w - J)^+]`.
    fn least(&mut self, w: f64) -> f64 {
        let mdp = self.mdp;
        let states = mdp.states();
        for (excess, value) in self.excess.iter_mut().zip(mdp.returns()) {
            *excess = (w - value).max(0.0);
        }
        for time in (0..mdp.horizon()).rev() {
            self.now.clear();
            self.now.resize(mdp.levels(time) * states, 0.0);
            for level in 0..mdp.levels(time) {
                land(mdp, time, level, &mut self.landed, &self.excess, &self.next);
                let now = &mut self.now[level * states..][..states];
                for (state, value) in now.iter_mut().enumerate() {
                    *value = mdp
                        .pair_range(state)
                        .map(|pair| expectation(mdp, pair, &self.landed))
                        .fold(f64::INFINITY, f64::min);
                }
            }
            std::mem::swap(&mut self.now, &mut self.next);
        }
        self.next[mdp.start()]
    }
}

/// Fills the value after each landing: `at_end` by return where the episode ends, `next` by level and
/// state where it continues.
pub(super) fn land(
    mdp: &FiniteMdp,
    time: usize,
    level: usize,
    landed: &mut [f64],
    at_end: &[f64],
    next: &[f64],
) {
    for (landing, value) in landed.iter_mut().enumerate() {
        *value = match mdp.end(time, landing) {
            Some(_) => at_end[mdp.return_index(time, level, landing)],
            None => {
                let level = mdp.next_level(time, level, landing);
                next[level * mdp.states() + mdp.landings()[landing].state]
            }
        };
    }
}

/// Nominal expectation over the outcomes of a pair.
pub(super) fn expectation(mdp: &FiniteMdp, pair: usize, landed: &[f64]) -> f64 {
    mdp.branches(pair)
        .iter()
        .map(|branch| branch.probability * landed[branch.landing as usize])
        .sum()
}

/// The policy that minimises `E[(w - J)^+]` and, among those that do, maximises `E[J]`.
pub(super) fn best_policy(mdp: &FiniteMdp, w: f64) -> Policy {
    let states = mdp.states();
    let excess: Vec<f64> = mdp.returns().iter().map(|value| (w - value).max(0.0)).collect();
    let mut choices = vec![0_u32; mdp.block_count() * states];
    let mut shortfall_landed = vec![0.0; mdp.landings().len()];
    let mut mean_landed = shortfall_landed.clone();
    let (mut shortfall_next, mut mean_next) = (Vec::new(), Vec::new());
    for time in (0..mdp.horizon()).rev() {
        let mut shortfall = vec![0.0; mdp.levels(time) * states];
        let mut mean = shortfall.clone();
        for level in 0..mdp.levels(time) {
            land(mdp, time, level, &mut shortfall_landed, &excess, &shortfall_next);
            land(mdp, time, level, &mut mean_landed, mdp.returns(), &mean_next);
            let block = mdp.block(time, level);
            for state in 0..states {
                let mut best: Option<(f64, f64)> = None;
                for (action, pair) in mdp.pair_range(state).enumerate() {
                    let candidate = (
                        expectation(mdp, pair, &shortfall_landed),
                        expectation(mdp, pair, &mean_landed),
                    );
                    if best.is_none_or(|best| is_better(candidate, best)) {
                        best = Some(candidate);
                        choices[block * states + state] = action as u32;
                    }
                }
                let (u, m) = best.unwrap_or_default();
                shortfall[level * states + state] = u;
                mean[level * states + state] = m;
            }
        }
        (shortfall_next, mean_next) = (shortfall, mean);
    }
    Policy::augmented_choice(mdp, |Node { time, level, state }| {
        choices[mdp.block(time, level) * states + state] as usize
    })
}

/// Whether (shortfall, mean) is better than another: less shortfall, then more mean.
fn is_better(candidate: (f64, f64), best: (f64, f64)) -> bool {
    let slack = SHORTFALL_TIE * best.0;
    if (candidate.0 - best.0).abs() > slack {
        candidate.0 < best.0
    } else {
        candidate.1 > best.1 + MEAN_TIE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exact::finite::ExactWorld;
    use lava_envs::{GridConfig, LavaGrid};

    #[test]
    fn leaving_out_thresholds_loses_nothing() {
        let configs = [
            GridConfig::default(),
            GridConfig { slip: 0.3, step_cost: 0.1, horizon: 25, ..GridConfig::default() },
            GridConfig { slip: 0.0, step_cost: 0.0, ..GridConfig::default() },
        ];
        for (config, gamma) in configs.iter().zip([1.0, 0.95, 0.9]) {
            let exact = ExactWorld::<LavaGrid>::new(config, gamma).unwrap();
            let mdp = exact.mdp();
            let mut programme = Shortfall::new(mdp);
            let shortfalls: Vec<f64> = mdp.returns().iter().map(|&w| programme.least(w)).collect();
            for alpha in [0.999, 0.5, 0.2, 0.04, 0.01, 0.001, 1e-6] {
                let best = mdp
                    .returns()
                    .iter()
                    .zip(&shortfalls)
                    .map(|(w, shortfall)| w - shortfall / alpha)
                    .fold(f64::NEG_INFINITY, f64::max);
                let solved = optimum(mdp, alpha).unwrap();
                approx::assert_abs_diff_eq!(solved.cvar, best, epsilon = 1e-11);
                assert!(solved.evaluated <= mdp.returns().len());
            }
        }
    }
}
