//! Policies of the protagonist on a [`FiniteMdp`]: what they remember, and with which probability
//! they choose each action.

use super::ExactError;
use super::mdp::{FiniteMdp, Node};

/// What a policy takes into account besides the state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Memory {
    /// Nothing: pi(a|s).
    Stationary,
    /// The time: pi_t(a|s).
    Time,
    /// The time and the reward accumulated so far: pi_t(a|s,R_t). On the grid the same as `Time`.
    TimeAndReward,
}

/// Action probabilities for every state (and time, and accumulated reward).
#[derive(Debug, Clone, PartialEq)]
pub struct Policy {
    memory: Memory,
    /// Pairs (state, action) of the MDP.
    pairs: usize,
    /// By time, level or nothing, then pair.
    probabilities: Vec<f64>,
}

impl Policy {
    /// A policy that sees only the state. `fill(state, row)` writes the probabilities of the
    /// state's actions; rows come zeroed, and states whose episode has ended are left out.
    ///
    /// # Errors
    /// If a row is no law: negative or not finite, or off 1 by more than 1e-4. Within that (weights
    /// in single precision) rows are normalised.
    pub fn stationary(
        mdp: &FiniteMdp,
        mut fill: impl FnMut(usize, &mut [f64]),
    ) -> Result<Self, ExactError> {
        Self::build(mdp, Memory::Stationary, 1, |_, state, row| fill(state, row))
    }

    /// A policy that sees time and state: `fill(time, state, row)` as in [`Policy::stationary`].
    ///
    /// # Errors
    /// As [`Policy::stationary`].
    pub fn timed(
        mdp: &FiniteMdp,
        fill: impl FnMut(usize, usize, &mut [f64]),
    ) -> Result<Self, ExactError> {
        Self::build(mdp, Memory::Time, mdp.horizon(), fill)
    }

    /// A policy that sees the whole node: `fill(node, row)` as in [`Policy::stationary`].
    ///
    /// # Errors
    /// As [`Policy::stationary`].
    pub fn augmented(
        mdp: &FiniteMdp,
        mut fill: impl FnMut(Node, &mut [f64]),
    ) -> Result<Self, ExactError> {
        let blocks: Vec<(usize, usize)> = mdp.blocks().collect();
        Self::build(mdp, Memory::TimeAndReward, blocks.len(), |block, state, row| {
            let (time, level) = blocks[block];
            fill(Node { time, level, state }, row);
        })
    }

    /// A deterministic policy that sees only the state; `choose` gives the action of a state.
    ///
    /// # Panics
    /// If the state has no such action.
    pub fn stationary_choice(mdp: &FiniteMdp, mut choose: impl FnMut(usize) -> usize) -> Self {
        let mut policy = Self::zeroed(mdp, Memory::Stationary, 1);
        for state in running(mdp) {
            policy.probabilities[mdp.pair_range(state)][choose(state)] = 1.0;
        }
        policy
    }

    /// A deterministic policy that sees time and state; `choose` gives the action.
    ///
    /// # Panics
    /// If the state has no such action.
    pub fn timed_choice(mdp: &FiniteMdp, mut choose: impl FnMut(usize, usize) -> usize) -> Self {
        let mut policy = Self::zeroed(mdp, Memory::Time, mdp.horizon());
        for time in 0..mdp.horizon() {
            for state in running(mdp) {
                policy.row_mut(mdp, time, state)[choose(time, state)] = 1.0;
            }
        }
        policy
    }

    /// A deterministic policy that sees the whole node; `choose` gives the action.
    ///
    /// # Panics
    /// If the state has no such action.
    pub fn augmented_choice(mdp: &FiniteMdp, mut choose: impl FnMut(Node) -> usize) -> Self {
        let mut policy = Self::zeroed(mdp, Memory::TimeAndReward, mdp.block_count());
        for (block, (time, level)) in mdp.blocks().enumerate() {
            for state in running(mdp) {
                policy.row_mut(mdp, block, state)[choose(Node { time, level, state })] = 1.0;
            }
        }
        policy
    }

    /// The policy that always chooses the likeliest action, the first one among equals.
    pub fn greedy(&self, mdp: &FiniteMdp) -> Policy {
        let mut greedy = Policy { probabilities: vec![0.0; self.probabilities.len()], ..*self };
        for block in 0..self.probabilities.len() / self.pairs {
            for state in running(mdp) {
                let row = &self.probabilities[block * self.pairs..][mdp.pair_range(state)];
                greedy.row_mut(mdp, block, state)[likeliest(row)] = 1.0;
            }
        }
        greedy
    }

    /// What the policy takes into account besides the state.
    pub fn memory(&self) -> Memory {
        self.memory
    }

    /// Probabilities of the node's actions.
    ///
    /// # Panics
    /// Possibly, if the policy was built for an MDP of another shape.
    pub fn row(&self, mdp: &FiniteMdp, node: Node) -> &[f64] {
        let block = match self.memory {
            Memory::Stationary => 0,
            Memory::Time => node.time,
            Memory::TimeAndReward => mdp.block(node.time, node.level),
        };
        &self.probabilities[block * self.pairs..][mdp.pair_range(node.state)]
    }

    /// The likeliest action of a node, the first one among equals.
    pub fn action(&self, mdp: &FiniteMdp, node: Node) -> usize {
        likeliest(self.row(mdp, node))
    }

    /// Whether every action is chosen with probability 0 or 1.
    pub fn is_deterministic(&self) -> bool {
        self.probabilities.iter().all(|&p| p == 0.0 || p == 1.0)
    }

    fn row_mut(&mut self, mdp: &FiniteMdp, block: usize, state: usize) -> &mut [f64] {
        &mut self.probabilities[block * self.pairs..][mdp.pair_range(state)]
    }

    fn zeroed(mdp: &FiniteMdp, memory: Memory, blocks: usize) -> Self {
        let pairs = mdp.pair_count();
        Policy { memory, pairs, probabilities: vec![0.0; blocks * pairs] }
    }

    fn build(
        mdp: &FiniteMdp,
        memory: Memory,
        blocks: usize,
        mut fill: impl FnMut(usize, usize, &mut [f64]),
    ) -> Result<Self, ExactError> {
        let mut policy = Self::zeroed(mdp, memory, blocks);
        for block in 0..blocks {
            for state in running(mdp) {
                let row = policy.row_mut(mdp, block, state);
                fill(block, state, row);
                let total: f64 = row.iter().sum();
                // A NaN or an infinity fails the second comparison.
                let law = row.iter().all(|&p| p >= 0.0) && (total - 1.0).abs() <= 1e-4;
                if !law {
                    return Err(ExactError::Policy { state, row: row.to_vec() });
                }
                row.iter_mut().for_each(|p| *p /= total);
            }
        }
        Ok(policy)
    }
}

/// States in which the episode continues.
fn running(mdp: &FiniteMdp) -> impl Iterator<Item = usize> + use<'_> {
    (0..mdp.states()).filter(|&state| mdp.ended(state).is_none())
}

/// The first of the largest probabilities.
pub(super) fn likeliest(row: &[f64]) -> usize {
    let mut best = 0;
    for (action, &probability) in row.iter().enumerate() {
        if probability > row[best] {
            best = action;
        }
    }
    best
}
