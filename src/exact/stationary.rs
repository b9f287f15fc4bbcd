//! A good stationary deterministic policy pi(s), found by local search: the benchmark's protagonists
//! see the state and not the time, so the optimum over (s, t) may be out of their reach.
//!
//! Finding the best one is a hard combinatorial problem and is not attempted. From each start, the
//! action of one state at a time is changed as long as the exact CVaR_alpha grows. The result is
//! *found, not proven*: a lower bound of the best stationary CVaR, as the optimum over (s, t) is an
//! upper bound.
//!
//! Which change is tried first follows from the first-order effect of choosing a in s at every visit,
//!
//!   gain(s, a) = sum_t m_t(s) [U_t(s) - Q_t(s, a)],
//!
//! with m_t the probability of being there, U the expected shortfall (w - J)^+ to go under the policy
//! at its VaR w, and Q_t(s, a) the same after one deviation. Every change is judged by the exact law.
//! A search ends when no single change improves the CVaR by more than [`LEAST_GAIN`]. States whose
//! visits times (max J - min J)/alpha lie below that are left out: what changes there touches no more
//! than the trajectories that visit them.
//!
//! Starts: the optimal (s, t)-policy and the risk-neutral one, each made stationary by taking for each
//! state the action chosen on most visits, then random changes of the best policy so far, drawn from a
//! fixed stream. The number of evaluations is bounded, so large maps take bounded time.

use super::law::{Evaluation, Nominal, evaluate, forward};
use super::mdp::{FiniteMdp, Node};
use super::optimum::{best_policy, expectation, land};
use super::policy::Policy;
use super::{ExactError, require_alpha};
use rand::rngs::ChaCha8Rng;
use rand::{RngExt, SeedableRng};

/// An improvement of the CVaR below this is not pursued.
pub const LEAST_GAIN: f64 = 1e-9;

/// Most policies evaluated in one search.
pub const MAX_EVALUATIONS: usize = 4000;

/// Random changes of the best policy that are searched from, each of about one visited state in eight.
const RESTARTS: usize = 4;

/// What the search found.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundStationary {
    /// CVaR_alpha(J) of [`FoundStationary::policy`].
    pub cvar: f64,
    /// A stationary deterministic policy.
    pub policy: Policy,
    /// The law of J under it and its expected visits.
    pub evaluation: Evaluation,
    /// Whether no change of the action in one state improves it by more than [`LEAST_GAIN`]. False
    /// only if [`MAX_EVALUATIONS`] stopped the search.
    pub local_optimum: bool,
    /// Policies evaluated.
    pub evaluated: usize,
}

/// Searches for a good stationary deterministic policy, beginning with `optimal`, a policy over
/// (s, t) of high CVaR_alpha.
///
/// # Errors
/// If alpha is outside (0, 1].
pub fn search(
    mdp: &FiniteMdp,
    alpha: f64,
    optimal: &Policy,
) -> Result<FoundStationary, ExactError> {
    require_alpha(alpha)?;
    let mut search = Search::new(mdp, alpha);
    let risk_neutral = best_policy(mdp, mdp.returns()[0]);
    let mut best = search.climb(project(mdp, optimal));
    best = best.or(search.climb(project(mdp, &risk_neutral)));
    let mut random = ChaCha8Rng::seed_from_u64(0);
    for _ in 0..RESTARTS {
        if search.exhausted() {
            break;
        }
        let mut choices = best.choices.clone();
        let visits = evaluate(mdp, &stationary(mdp, &choices)).visits;
        for state in search.worth_changing(&visits) {
            if random.random_range(0..8) == 0 {
                choices[state] = random.random_range(0..mdp.actions(state));
            }
        }
        best = best.or(search.climb(choices));
    }
    let policy = stationary(mdp, &best.choices);
    let evaluation = evaluate(mdp, &policy);
    Ok(FoundStationary {
        cvar: evaluation.law.cvar(alpha),
        policy,
        evaluation,
        local_optimum: best.local_optimum,
        evaluated: search.evaluated,
    })
}

fn stationary(mdp: &FiniteMdp, choices: &[usize]) -> Policy {
    Policy::stationary_choice(mdp, |state| choices[state])
}

/// For each state the action that the policy chooses on most of its visits.
fn project(mdp: &FiniteMdp, policy: &Policy) -> Vec<usize> {
    let mut chosen = vec![0.0; mdp.pair_count()];
    for_visits(mdp, policy, |node, mass| {
        let pairs = mdp.pair_range(node.state);
        for (total, probability) in chosen[pairs].iter_mut().zip(policy.row(mdp, node)) {
            *total += mass * probability;
        }
    });
    (0..mdp.states())
        .map(|state| {
            let row = &chosen[mdp.pair_range(state)];
            if row.iter().all(|&total| total == 0.0) && !row.is_empty() {
                // Never visited: what the policy would do there first.
                return policy.action(mdp, Node { time: 0, level: 0, state });
            }
            (0..row.len()).rev().max_by(|&a, &b| row[a].total_cmp(&row[b])).unwrap_or(0)
        })
        .collect()
}

/// Where a climb ended: an action for each state.
struct Climbed {
    cvar: f64,
    choices: Vec<usize>,
    local_optimum: bool,
}

impl Climbed {
    fn or(self, other: Climbed) -> Climbed {
        if other.cvar > self.cvar { other } else { self }
    }
}

struct Search<'a> {
    mdp: &'a FiniteMdp,
    alpha: f64,
    /// max J - min J
    range: f64,
    evaluated: usize,
    /// Probability of each return.
    masses: Vec<f64>,
    /// Whether the episode ends with a landing, leaving the time limit aside.
    ends: Vec<bool>,
    /// By level and state: probability of being there now and at the next time.
    now: Vec<f64>,
    next: Vec<f64>,
    landed: Vec<f64>,
}

impl<'a> Search<'a> {
    fn new(mdp: &'a FiniteMdp, alpha: f64) -> Self {
        let returns = mdp.returns();
        Search {
            mdp,
            alpha,
            range: returns[returns.len() - 1] - returns[0],
            evaluated: 0,
            masses: vec![0.0; returns.len()],
            ends: mdp.landings().iter().map(|l| mdp.ended(l.state).is_some()).collect(),
            now: Vec::new(),
            next: Vec::new(),
            landed: vec![0.0; mdp.landings().len()],
        }
    }

    fn exhausted(&self) -> bool {
        self.evaluated >= MAX_EVALUATIONS
    }

    /// Changes one action at a time until nothing improves.
    fn climb(&mut self, mut choices: Vec<usize>) -> Climbed {
        let (mut cvar, mut threshold) = self.score(&choices);
        loop {
            let mut improved = false;
            for (state, action) in self.changes(&choices, threshold) {
                if self.exhausted() {
                    return Climbed { cvar, choices, local_optimum: false };
                }
                let before = std::mem::replace(&mut choices[state], action);
                let (changed, var) = self.score(&choices);
                if changed > cvar + LEAST_GAIN {
                    (cvar, threshold) = (changed, var);
                    improved = true;
                    break;
                }
                choices[state] = before;
            }
            if !improved {
                return Climbed { cvar, choices, local_optimum: true };
            }
        }
    }

    /// CVaR_alpha and VaR_alpha of a policy: the recursion of [`super::law`], for the one case on
    /// which the search spends its time. Nodes of so small a probability that all of them together
    /// change the CVaR by less than a tenth of [`LEAST_GAIN`] are left out; they count as the best
    /// return.
    fn score(&mut self, choices: &[usize]) -> (f64, f64) {
        self.evaluated += 1;
        let mdp = self.mdp;
        let states = mdp.states();
        let nodes = (mdp.block_count() * states) as f64;
        let negligible =
            0.1 * LEAST_GAIN * self.alpha / (nodes * self.range.max(f64::MIN_POSITIVE));
        self.masses.fill(0.0);
        self.now.clear();
        self.now.resize(states, 0.0);
        self.now[mdp.start()] = 1.0;
        for time in 0..mdp.horizon() {
            let last = time + 1 == mdp.horizon();
            self.next.clear();
            self.next.resize(if last { 0 } else { mdp.levels(time + 1) * states }, 0.0);
            for level in 0..mdp.levels(time) {
                self.landed.fill(0.0);
                for (state, &mass) in self.now[level * states..][..states].iter().enumerate() {
                    if mass > negligible {
                        let pair = mdp.pair_range(state).start + choices[state];
                        for branch in mdp.branches(pair) {
                            self.landed[branch.landing as usize] += mass * branch.probability;
                        }
                    }
                }
                for (landing, &mass) in self.landed.iter().enumerate() {
                    if mass == 0.0 {
                        continue;
                    }
                    if last || self.ends[landing] {
                        self.masses[mdp.return_index(time, level, landing)] += mass;
                    } else {
                        let level = mdp.next_level(time, level, landing);
                        self.next[level * states + mdp.landings()[landing].state] += mass;
                    }
                }
            }
            std::mem::swap(&mut self.now, &mut self.next);
        }
        self.tail_mean()
    }

    /// CVaR_alpha and VaR_alpha of the collected masses.
    fn tail_mean(&self) -> (f64, f64) {
        let returns = self.mdp.returns();
        let mut rest = self.alpha;
        let mut tail = 0.0;
        let mut var = returns[0];
        for (&mass, &value) in self.masses.iter().zip(returns) {
            let share = mass.min(rest);
            tail += share * value;
            rest -= share;
            if share > 0.0 {
                var = value;
            }
        }
        ((tail + rest * returns[returns.len() - 1]) / self.alpha, var)
    }

    /// Single changes (state, action) in the order in which they promise most.
    fn changes(&self, choices: &[usize], threshold: f64) -> Vec<(usize, usize)> {
        let mdp = self.mdp;
        let policy = stationary(mdp, choices);
        let mut occupied = vec![0.0; mdp.block_count() * mdp.states()];
        let mut visits = vec![0.0; mdp.states()];
        for_visits(mdp, &policy, |node, mass| {
            occupied[mdp.block(node.time, node.level) * mdp.states() + node.state] = mass;
            visits[node.state] += mass;
        });
        let gains = gains(mdp, choices, threshold, &occupied);
        let mut changes: Vec<(f64, usize, usize)> = Vec::new();
        for state in self.worth_changing(&visits) {
            for (action, pair) in mdp.pair_range(state).enumerate() {
                if action != choices[state] {
                    changes.push((gains[pair], state, action));
                }
            }
        }
        changes.sort_by(|a, b| b.0.total_cmp(&a.0));
        changes.into_iter().map(|(_, state, action)| (state, action)).collect()
    }

    /// States with a choice whose visits suffice to change the CVaR by [`LEAST_GAIN`].
    fn worth_changing(&self, visits: &[f64]) -> Vec<usize> {
        (0..visits.len())
            .filter(|&state| self.mdp.actions(state) > 1)
            .filter(|&state| visits[state] * self.range / self.alpha > LEAST_GAIN)
            .collect()
    }
}

/// Calls back with the probability of each node in which the episode continues.
fn for_visits(mdp: &FiniteMdp, policy: &Policy, mut visit: impl FnMut(Node, f64)) {
    forward(
        mdp,
        policy,
        &Nominal,
        |_, _, _, _, _| (),
        |node, _, mass| {
            if let Some(node) = node {
                visit(node, mass);
            }
        },
    );
}

/// gain(s, a) by pair, see the module's documentation.
fn gains(mdp: &FiniteMdp, choices: &[usize], threshold: f64, occupied: &[f64]) -> Vec<f64> {
    let states = mdp.states();
    let at_end: Vec<f64> = mdp.returns().iter().map(|v| (threshold - v).max(0.0)).collect();
    let mut gains = vec![0.0; mdp.pair_count()];
    let mut landed = vec![0.0; mdp.landings().len()];
    let mut next = Vec::new();
    for time in (0..mdp.horizon()).rev() {
        let mut now = vec![0.0; mdp.levels(time) * states];
        for level in 0..mdp.levels(time) {
            land(mdp, time, level, &mut landed, &at_end, &next);
            let block = mdp.block(time, level);
            for state in (0..states).filter(|&state| mdp.ended(state).is_none()) {
                let pairs = mdp.pair_range(state);
                let shortfall = expectation(mdp, pairs.start + choices[state], &landed);
                now[level * states + state] = shortfall;
                let mass = occupied[block * states + state];
                if mass > 0.0 {
                    for pair in pairs {
                        gains[pair] += mass * (shortfall - expectation(mdp, pair, &landed));
                    }
                }
            }
        }
        next = now;
    }
    gains
}
