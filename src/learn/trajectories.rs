//! What a rollout records for one player, and its update learns from.

use crate::head::Head;

/// What one player saw, chose and earned. Time-major: index `t * slots + slot`.
#[derive(Debug, Clone)]
pub struct Trajectories<H: Head> {
    /// Number of slots.
    pub slots: usize,
    /// Inputs, shape `[steps + 1, slots, inputs + 1]`; the last block is the state after the last
    /// step, for bootstrapping.
    pub inputs: Vec<f32>,
    /// What the law depended on, `[steps, slots]`.
    pub given: Vec<H::Given>,
    /// Choices, `[steps, slots]`.
    pub choices: Vec<H::Choice>,
    /// log-probabilities of the choices, `[steps, slots]`.
    pub log_probabilities: Vec<f64>,
    /// The player's own rewards, `[steps, slots]`.
    pub rewards: Vec<f32>,
    /// Whether the episode ended with this step, `[steps, slots]`.
    pub ended: Vec<bool>,
}

impl<H: Head> Trajectories<H> {
    /// None yet, of `slots` parallel episodes.
    pub fn new(slots: usize) -> Self {
        Trajectories {
            slots,
            inputs: Vec::new(),
            given: Vec::new(),
            choices: Vec::new(),
            log_probabilities: Vec::new(),
            rewards: Vec::new(),
            ended: Vec::new(),
        }
    }

    /// Forgets what was recorded.
    pub fn clear(&mut self) {
        self.inputs.clear();
        self.given.clear();
        self.choices.clear();
        self.log_probabilities.clear();
        self.rewards.clear();
        self.ended.clear();
    }
}
