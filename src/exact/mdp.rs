//! Finite MDPs with a time limit, and the accumulated reward as part of their state.
//!
//! Risk criteria of the return `J = sum_{t=0}^{T-1} gamma^t r_t` are not solved by policies over
//! (s, t): the accumulated reward `R_t = sum_{k<t} gamma^k r_k` must be known too (Baeuerle &
//! Ott 2011, "Markov decision processes with average-value-at-risk criteria"). [`FiniteMdp`]
//! therefore lists, per time t, the values that R_t takes while the episode runs, its *levels*, and
//! everything in this module is solved over nodes (t, level, s), see [`Node`].
//!
//! Where all rewards of running episodes are equal, as on the grid, there is one level per time, and
//! the nodes are the pairs (s, t). Where they differ, the number of levels grows up to the number of
//! distinct sums. So the general case costs the grid nothing, and small random MDPs with arbitrary
//! rewards can test it.
//!
//! | symbol | identifier |
//! |---|---|
//! | o | [`Outcome`], numbered from 0 for each state and action |
//! | P(o), r, s' | [`Outcome::probability`], [`Outcome::reward`], [`Outcome::next`] |
//! | T, gamma | [`FiniteMdp::horizon`], [`FiniteMdp::gamma`] |
//! | R_t | [`Accumulated`], numbered by level |
//! | (r, s') | a landing: outcomes with the same reward and next state share one |

use super::ExactError;
use lava_envs::End;
use std::ops::Range;

/// The most nodes (t, level, s) an MDP may unfold into.
pub const MAX_NODES: usize = 5_000_000;

/// States that a pair (time, level) counts for at least, because it takes memory by itself.
const LEAST_WIDTH: usize = 16;

/// One thing chance may decide after an action in a state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Nominal probability P(o).
    pub probability: f64,
    /// Reward of the step.
    pub reward: f64,
    /// Index of the next state.
    pub next: usize,
}

/// A state of a [`FiniteMdp`].
#[derive(Debug, Clone, PartialEq)]
pub enum State {
    /// The episode continues: the outcomes of each action.
    Running(Vec<Vec<Outcome>>),
    /// The episode has ended so.
    Ended(End),
}

/// A state at a time with what has been accumulated so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Node {
    /// Steps taken, t in 0..T.
    pub time: usize,
    /// Which of the values that R_t can take, see [`FiniteMdp::accumulated`]; 0 on the grid.
    pub level: usize,
    /// Index of the state.
    pub state: usize,
}

/// Reward accumulated while the episode runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Accumulated {
    /// R_t, discounted by gamma.
    pub discounted: f64,
    /// The undiscounted sum.
    pub undiscounted: f64,
}

/// An outcome as the solvers read it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Branch {
    pub probability: f64,
    pub landing: u32,
}

/// A reward together with the state it leads to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Landing {
    pub reward: f64,
    pub state: usize,
    /// Index among the distinct rewards of running episodes; unused where the episode ends.
    reward_index: usize,
}

#[derive(Debug, Clone)]
struct Layer {
    /// gamma^t
    discount: f64,
    accumulated: Vec<Accumulated>,
    /// Level at t + 1, by level and reward index.
    next: Vec<u32>,
    /// Number of the layer's first block, see [`FiniteMdp::block`].
    first_block: usize,
}

/// A finite MDP with a time limit: an episode that has not ended after T steps ends by
/// [`End::Timeout`], and its last reward counts like any other.
#[derive(Debug, Clone)]
pub struct FiniteMdp {
    start: usize,
    horizon: usize,
    gamma: f64,
    ends: Vec<Option<End>>,
    /// Pairs (state, action) of state s: `pairs[s]..pairs[s + 1]`.
    pairs: Vec<usize>,
    /// Branches of a pair: `branch_ranges[pair]..branch_ranges[pair + 1]`.
    branch_ranges: Vec<usize>,
    branches: Vec<Branch>,
    landings: Vec<Landing>,
    rewards: usize,
    layers: Vec<Layer>,
    /// Number of pairs (time, level).
    blocks: usize,
    returns: Vec<f64>,
    /// By block and landing: index into `returns` if the episode ends there.
    return_indices: Vec<u32>,
}

impl FiniteMdp {
    /// Builds the MDP and lists the levels of the accumulated reward.
    ///
    /// # Errors
    /// If a probability, reward or index is out of range, a law does not sum to 1 (within 1e-9), the
    /// first state has ended already, gamma is outside (0, 1], T is 0, or there are more than
    /// [`MAX_NODES`] nodes.
    pub fn new(
        states: &[State],
        start: usize,
        horizon: usize,
        gamma: f64,
    ) -> Result<Self, ExactError> {
        if horizon == 0 {
            return Err(ExactError::Mdp("the time limit must be at least one step".to_owned()));
        }
        if !(gamma > 0.0 && gamma <= 1.0) {
            return Err(ExactError::Mdp(format!("gamma must lie in (0, 1], got {gamma}")));
        }
        if !matches!(states.get(start), Some(State::Running(_))) {
            return Err(ExactError::Mdp(format!("no episode can start in state {start}")));
        }
        if horizon.saturating_mul(states.len().max(LEAST_WIDTH)) > MAX_NODES {
            return Err(ExactError::TooLarge);
        }
        let mut mdp = FiniteMdp {
            start,
            horizon,
            gamma,
            ends: Vec::with_capacity(states.len()),
            pairs: vec![0],
            branch_ranges: vec![0],
            branches: Vec::new(),
            landings: Vec::new(),
            rewards: 0,
            layers: Vec::new(),
            blocks: 0,
            returns: Vec::new(),
            return_indices: Vec::new(),
        };
        mdp.add_states(states)?;
        mdp.add_layers()?;
        mdp.add_returns();
        Ok(mdp)
    }

    fn add_states(&mut self, states: &[State]) -> Result<(), ExactError> {
        let mut keys: Vec<(u64, usize)> = Vec::new();
        for (index, state) in states.iter().enumerate() {
            let actions = match state {
                State::Ended(_) => continue,
                State::Running(actions) => actions,
            };
            if actions.is_empty() {
                return Err(ExactError::Mdp(format!("state {index} has no action")));
            }
            for outcome in actions.iter().flatten() {
                if outcome.next >= states.len() {
                    let next = outcome.next;
                    return Err(ExactError::Mdp(format!(
                        "state {index} leads to state {next}, which does not exist"
                    )));
                }
                if !outcome.reward.is_finite() {
                    return Err(ExactError::Mdp(format!(
                        "a reward in state {index} is not finite"
                    )));
                }
                keys.push((ordered(outcome.reward), outcome.next));
            }
        }
        keys.sort_unstable();
        keys.dedup();
        let mut running_rewards: Vec<u64> = keys
            .iter()
            .filter(|(_, next)| matches!(states[*next], State::Running(_)))
            .map(|(reward, _)| *reward)
            .collect();
        running_rewards.dedup();
        self.rewards = running_rewards.len();
        self.landings = keys
            .iter()
            .map(|&(reward, state)| Landing {
                reward: unordered(reward),
                state,
                reward_index: running_rewards.binary_search(&reward).unwrap_or(0),
            })
            .collect();

        for (index, state) in states.iter().enumerate() {
            match state {
                State::Ended(end) => self.ends.push(Some(*end)),
                State::Running(actions) => {
                    self.ends.push(None);
                    for outcomes in actions {
                        self.add_outcomes(index, outcomes, &keys)?;
                    }
                }
            }
            self.pairs.push(self.branch_ranges.len() - 1);
        }
        Ok(())
    }

    fn add_outcomes(
        &mut self,
        state: usize,
        outcomes: &[Outcome],
        keys: &[(u64, usize)],
    ) -> Result<(), ExactError> {
        let total: f64 = outcomes.iter().map(|outcome| outcome.probability).sum();
        let negative = outcomes.iter().any(|outcome| outcome.probability < 0.0);
        // A NaN makes the comparison false as well.
        let normalised = (total - 1.0).abs() <= 1e-9;
        if negative || !normalised {
            return Err(ExactError::Mdp(format!(
                "the probabilities of an action in state {state} are no law (sum {total})"
            )));
        }
        for outcome in outcomes {
            let landing =
                keys.partition_point(|key| *key < (ordered(outcome.reward), outcome.next));
            self.branches
                .push(Branch { probability: outcome.probability, landing: landing as u32 });
        }
        self.branch_ranges.push(self.branches.len());
        Ok(())
    }

    fn add_layers(&mut self) -> Result<(), ExactError> {
        let rewards: Vec<f64> = {
            let mut rewards = vec![0.0; self.rewards];
            for landing in self.landings.iter().filter(|l| self.ends[l.state].is_none()) {
                rewards[landing.reward_index] = landing.reward;
            }
            rewards
        };
        let mut accumulated = vec![Accumulated { discounted: 0.0, undiscounted: 0.0 }];
        let mut discount = 1.0;
        for _ in 0..self.horizon {
            let first_block = self.blocks;
            self.blocks += accumulated.len();
            let width = self.ends.len().max(self.landings.len()).max(LEAST_WIDTH);
            if self.blocks.saturating_mul(width) > MAX_NODES {
                return Err(ExactError::TooLarge);
            }
            let sums: Vec<(u64, u64)> = accumulated
                .iter()
                .flat_map(|so_far| {
                    rewards.iter().map(move |reward| {
                        (
                            ordered(so_far.discounted + discount * reward),
                            ordered(so_far.undiscounted + reward),
                        )
                    })
                })
                .collect();
            let mut levels = sums.clone();
            levels.sort_unstable();
            levels.dedup();
            let next = sums.iter().map(|sum| levels.partition_point(|l| l < sum) as u32).collect();
            self.layers.push(Layer { discount, accumulated, next, first_block });
            accumulated = levels
                .into_iter()
                .map(|(discounted, undiscounted)| Accumulated {
                    discounted: unordered(discounted),
                    undiscounted: unordered(undiscounted),
                })
                .collect();
            discount *= self.gamma;
        }
        Ok(())
    }

    fn add_returns(&mut self) {
        let mut values = Vec::new();
        for (time, level) in self.blocks() {
            for landing in 0..self.landings.len() {
                if self.end(time, landing).is_some() {
                    values.push(self.return_at(time, level, landing));
                }
            }
        }
        values.sort_unstable_by(f64::total_cmp);
        values.dedup();
        self.returns = values;
        let mut indices = Vec::with_capacity(self.blocks * self.landings.len());
        for (time, level) in self.blocks() {
            for landing in 0..self.landings.len() {
                let value = self.return_at(time, level, landing);
                indices.push(match self.end(time, landing) {
                    Some(_) => self.returns.partition_point(|known| *known < value) as u32,
                    None => u32::MAX,
                });
            }
        }
        self.return_indices = indices;
    }

    /// Number of states.
    pub fn states(&self) -> usize {
        self.ends.len()
    }

    /// The state in which an episode starts.
    pub fn start(&self) -> usize {
        self.start
    }

    /// The node in which an episode starts.
    pub fn start_node(&self) -> Node {
        Node { time: 0, level: 0, state: self.start }
    }

    /// Time limit T in steps.
    pub fn horizon(&self) -> usize {
        self.horizon
    }

    /// Discount gamma per step.
    pub fn gamma(&self) -> f64 {
        self.gamma
    }

    /// How the episode has ended in a state; `None` where it continues.
    pub fn ended(&self, state: usize) -> Option<End> {
        self.ends[state]
    }

    /// Number of actions in a state; 0 where the episode has ended.
    pub fn actions(&self, state: usize) -> usize {
        self.pair_range(state).len()
    }

    /// Number of outcomes of an action in a state.
    pub fn outcome_count(&self, state: usize, action: usize) -> usize {
        self.branches(self.pairs[state] + action).len()
    }

    /// An outcome of an action in a state.
    pub fn outcome(&self, state: usize, action: usize, outcome: usize) -> Outcome {
        let branch = self.branches(self.pairs[state] + action)[outcome];
        let landing = self.landings[branch.landing as usize];
        Outcome { probability: branch.probability, reward: landing.reward, next: landing.state }
    }

    /// Whether the time says what has been accumulated: every time has one level.
    pub fn one_level(&self) -> bool {
        self.blocks == self.horizon
    }

    /// The values of the accumulated reward R_t, t in 0..T, ascending; their indices are the levels.
    /// Some may be out of reach from the start.
    pub fn accumulated(&self, time: usize) -> &[Accumulated] {
        &self.layers[time].accumulated
    }

    /// The node after an outcome; `None` if the episode ends with it.
    pub fn successor(&self, node: Node, action: usize, outcome: usize) -> Option<Node> {
        let branch = self.branches(self.pairs[node.state] + action)[outcome];
        self.next_node(node.time, node.level, branch.landing as usize)
    }

    /// How the episode ends with an outcome, and its return J; `None` if it continues.
    pub fn ending(&self, node: Node, action: usize, outcome: usize) -> Option<(End, f64)> {
        let branch = self.branches(self.pairs[node.state] + action)[outcome];
        let landing = branch.landing as usize;
        let end = self.end(node.time, landing)?;
        Some((end, self.return_at(node.time, node.level, landing)))
    }

    /// Every value the return may take, ascending. Some may be out of reach from the start.
    pub fn returns(&self) -> &[f64] {
        &self.returns
    }

    /// Pairs (time, level) in order; the position in this list is the block.
    pub(super) fn blocks(&self) -> impl DoubleEndedIterator<Item = (usize, usize)> + '_ {
        self.layers
            .iter()
            .enumerate()
            .flat_map(|(time, layer)| (0..layer.accumulated.len()).map(move |level| (time, level)))
    }

    pub(super) fn block_count(&self) -> usize {
        self.blocks
    }

    pub(super) fn levels(&self, time: usize) -> usize {
        self.layers[time].accumulated.len()
    }

    /// Number of a pair (time, level).
    pub(super) fn block(&self, time: usize, level: usize) -> usize {
        self.layers[time].first_block + level
    }

    /// Number of pairs (state, action).
    pub(super) fn pair_count(&self) -> usize {
        self.branch_ranges.len() - 1
    }

    /// Pairs (state, action) of a state.
    pub(super) fn pair_range(&self, state: usize) -> Range<usize> {
        self.pairs[state]..self.pairs[state + 1]
    }

    pub(super) fn branches(&self, pair: usize) -> &[Branch] {
        &self.branches[self.branch_ranges[pair]..self.branch_ranges[pair + 1]]
    }

    pub(super) fn landings(&self) -> &[Landing] {
        &self.landings
    }

    /// How an episode ends that lands so with the step taken at `time`.
    pub(super) fn end(&self, time: usize, landing: usize) -> Option<End> {
        let timeout = (time + 1 == self.horizon).then_some(End::Timeout);
        self.ends[self.landings[landing].state].or(timeout)
    }

    /// J = R_t + gamma^t r of an episode that ends with this landing.
    pub(super) fn return_at(&self, time: usize, level: usize, landing: usize) -> f64 {
        let layer = &self.layers[time];
        layer.accumulated[level].discounted + layer.discount * self.landings[landing].reward
    }

    pub(super) fn undiscounted_return_at(&self, time: usize, level: usize, landing: usize) -> f64 {
        self.layers[time].accumulated[level].undiscounted + self.landings[landing].reward
    }

    /// Index of [`FiniteMdp::return_at`] in [`FiniteMdp::returns`]; valid where the episode ends.
    pub(super) fn return_index(&self, time: usize, level: usize, landing: usize) -> usize {
        self.return_indices[self.block(time, level) * self.landings.len() + landing] as usize
    }

    /// Level at `time + 1` after a landing with which the episode continues.
    pub(super) fn next_level(&self, time: usize, level: usize, landing: usize) -> usize {
        let layer = &self.layers[time];
        layer.next[level * self.rewards + self.landings[landing].reward_index] as usize
    }

    fn next_node(&self, time: usize, level: usize, landing: usize) -> Option<Node> {
        self.end(time, landing).is_none().then(|| Node {
            time: time + 1,
            level: self.next_level(time, level, landing),
            state: self.landings[landing].state,
        })
    }
}

/// Bits whose order as integers is the order of the numbers, so that sums can be sorted and
/// distinguished exactly. Both zeros are one.
fn ordered(value: f64) -> u64 {
    let bits = (value + 0.0).to_bits();
    if bits >> 63 == 1 { !bits } else { bits | (1 << 63) }
}

fn unordered(bits: u64) -> f64 {
    f64::from_bits(if bits >> 63 == 1 { bits & !(1 << 63) } else { !bits })
}
