//! What a rollout records for one player, for its update to learn from.

use super::inputs::Inputs;

/// What one player saw, chose and earned. Time-major: index `t * slots + slot`. `G` is what the law
/// of the choice depended on besides the network's outputs, `C` the choice.
#[derive(Debug, Clone)]
pub struct Trajectories<G, C> {
    /// Number of slots.
    pub slots: usize,
    /// Inputs, samples of shape `[steps + 1, slots]`; the last block is the state after the last step,
    /// for bootstrapping.
    pub inputs: Inputs,
    /// What the law depended on, `[steps, slots]`.
    pub given: Vec<G>,
    /// Choices, `[steps, slots]`.
    pub choices: Vec<C>,
    /// log-probabilities of the choices, `[steps, slots]`.
    pub log_probabilities: Vec<f64>,
    /// The player's own rewards, `[steps, slots]`.
    pub rewards: Vec<f32>,
    /// Whether the episode ended with this step, `[steps, slots]`.
    pub ended: Vec<bool>,
}

impl<G, C> Trajectories<G, C> {
    /// Empty, for `slots` parallel episodes.
    pub fn new(slots: usize) -> Self {
        Trajectories {
            slots,
            inputs: Inputs::default(),
            given: Vec::new(),
            choices: Vec::new(),
            log_probabilities: Vec::new(),
            rewards: Vec::new(),
            ended: Vec::new(),
        }
    }

    /// Clears the records.
    pub fn clear(&mut self) {
        self.inputs.clear();
        self.given.clear();
        self.choices.clear();
        self.log_probabilities.clear();
        self.rewards.clear();
        self.ended.clear();
    }
}
