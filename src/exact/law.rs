//! The exact law of the return under a policy, by forward recursion.
//!
//! With m_t(s, R) = P(s_t = s, R_t = R, the episode runs),
//!
//!   m_{t+1}(s', R + gamma^t r) = sum_{s,a,o} m_t(s, R) pi_t(a|s,R) P(o|s,a) delta_t(o),
//!
//! where delta = 1 gives the nominal law, and a [`Perturbation`] the one under an antagonist. What
//! ends becomes an atom of J.

use super::mdp::{FiniteMdp, Node};
use super::policy::Policy;
use crate::game::returns::{Atom, ReturnLaw};
use lava_envs::End;

/// An antagonist that reweights chance only by the node and the action.
pub trait Perturbation {
    /// The likelihood ratio delta_t(o), not negative and of mean 1 under P(o|s,a).
    fn ratio(&self, node: Node, action: usize, outcome: usize) -> f64;
}

/// No antagonist: delta = 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nominal;

impl Perturbation for Nominal {
    fn ratio(&self, _node: Node, _action: usize, _outcome: usize) -> f64 {
        1.0
    }
}

/// What a policy does, without sampling error.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// The law of J.
    pub law: ReturnLaw,
    /// Expected number of times t in 0..=T at which the episode is in each state; for states in
    /// which it ends, the probability of that.
    pub visits: Vec<f64>,
}

/// The exact law of the return under a policy.
pub fn evaluate(mdp: &FiniteMdp, policy: &Policy) -> Evaluation {
    evaluate_under(mdp, policy, &Nominal)
}

/// The exact law of the return under a policy and an antagonist.
pub fn evaluate_under(
    mdp: &FiniteMdp,
    policy: &Policy,
    perturbation: &impl Perturbation,
) -> Evaluation {
    let mut atoms = Vec::new();
    let mut visits = vec![0.0; mdp.states()];
    let on_end = |time, level, landing, end, mass| {
        atoms.push(Atom {
            value: mdp.return_at(time, level, landing),
            undiscounted: mdp.undiscounted_return_at(time, level, landing),
            steps: (time + 1) as u32,
            end,
            mass,
        });
    };
    forward(mdp, policy, perturbation, on_end, |_, state, mass| visits[state] += mass);
    Evaluation { law: ReturnLaw::exact(atoms), visits }
}

/// Runs the recursion. `on_end(time, level, landing, end, mass)` receives what ends, and
/// `on_visit(node, state, mass)` the probability of every node and, with `None` for the node, of every
/// state in which the episode has ended.
pub(super) fn forward(
    mdp: &FiniteMdp,
    policy: &Policy,
    perturbation: &impl Perturbation,
    mut on_end: impl FnMut(usize, usize, usize, End, f64),
    mut on_visit: impl FnMut(Option<Node>, usize, f64),
) {
    let states = mdp.states();
    let mut masses = vec![0.0; states];
    masses[mdp.start()] = 1.0;
    let mut landed = vec![0.0; mdp.landings().len()];
    for time in 0..mdp.horizon() {
        let last = time + 1 == mdp.horizon();
        let mut next = vec![0.0; if last { 0 } else { mdp.levels(time + 1) * states }];
        for level in 0..mdp.levels(time) {
            landed.fill(0.0);
            for (state, &mass) in masses[level * states..][..states].iter().enumerate() {
                if mass == 0.0 {
                    continue;
                }
                let node = Node { time, level, state };
                on_visit(Some(node), state, mass);
                let pairs = mdp.pair_range(state);
                for (action, &chosen) in policy.row(mdp, node).iter().enumerate() {
                    if chosen == 0.0 {
                        continue;
                    }
                    let branches = mdp.branches(pairs.start + action);
                    for (outcome, branch) in branches.iter().enumerate() {
                        landed[branch.landing as usize] += mass
                            * chosen
                            * branch.probability
                            * perturbation.ratio(node, action, outcome);
                    }
                }
            }
            for (landing, &mass) in landed.iter().enumerate() {
                if mass == 0.0 {
                    continue;
                }
                let state = mdp.landings()[landing].state;
                match mdp.end(time, landing) {
                    Some(end) => {
                        on_end(time, level, landing, end, mass);
                        on_visit(None, state, mass);
                    }
                    None => {
                        next[mdp.next_level(time, level, landing) * states + state] += mass;
                    }
                }
            }
        }
        masses = next;
    }
}
