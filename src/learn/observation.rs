//! What the players of the game see.
//!
//! The protagonist sees the world's observation, and the time if it is time-aware, but not the budget:
//! given the budget it would solve Chow's decomposition, which is not CVaR-optimal. The antagonist
//! sees the situation after the action was chosen, its remaining budget as log eta_t / log eta, and
//! the time if it is time-aware. Every row ends with the constant 1 of the networks' biases.

use super::options::TrainOptions;
use super::policy::Situation;
use crate::game::budget::Eta;
use lava_envs::World;

/// What the players of a game see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    protagonist_time: bool,
    antagonist_time: bool,
    /// 1 / log eta, or 0 where the budget is hidden.
    budget_scale: f64,
}

impl Observation {
    /// What the players of a game with these options see.
    pub fn new(options: &TrainOptions, eta: Eta) -> Self {
        let blind = options.hide_budget || eta.is_neutral();
        Observation {
            protagonist_time: options.protagonist.time_aware,
            antagonist_time: options.antagonist.time_aware,
            budget_scale: if blind { 0.0 } else { 1.0 / eta.get().ln() },
        }
    }

    /// Whether the protagonist sees the time.
    pub fn protagonist_sees_time(&self) -> bool {
        self.protagonist_time
    }

    /// Numbers that the protagonist sees.
    pub fn protagonist_inputs<W: World>(&self) -> usize {
        W::OBSERVATION + usize::from(self.protagonist_time)
    }

    /// Numbers that the antagonist sees.
    pub fn antagonist_inputs<W: World>(&self) -> usize {
        W::SITUATION + 1 + usize::from(self.antagonist_time)
    }

    /// Writes what the protagonist sees in every slot, shape `[slots, protagonist_inputs + 1]`.
    pub fn protagonist<W: World>(&self, world: &W, inputs: &mut Vec<f32>) {
        let width = self.protagonist_inputs::<W>() + 1;
        inputs.resize(world.episodes() * width, 0.0);
        for (slot, row) in inputs.chunks_exact_mut(width).enumerate() {
            world.observe(slot, &mut row[..W::OBSERVATION]);
            close(world, slot, &mut row[W::OBSERVATION..]);
        }
    }

    /// Writes what the antagonist sees in every slot, shape `[slots, antagonist_inputs + 1]`.
    pub fn antagonist<W: World>(&self, of: &Situation<'_, W>, inputs: &mut Vec<f32>) {
        let width = self.antagonist_inputs::<W>() + 1;
        inputs.resize(of.world.episodes() * width, 0.0);
        for (slot, row) in inputs.chunks_exact_mut(width).enumerate() {
            of.world.situation(slot, of.actions[slot], &mut row[..W::SITUATION]);
            row[W::SITUATION] = (of.budgets[slot].get().ln() * self.budget_scale) as f32;
            close(of.world, slot, &mut row[W::SITUATION + 1..]);
        }
    }

    /// Turns rows of the antagonist into those that it would see with exp(`log_factor`) times the
    /// budget.
    pub fn with_more_budget<W: World>(&self, inputs: &mut [f32], log_factor: f64) {
        for row in inputs.chunks_exact_mut(self.antagonist_inputs::<W>() + 1) {
            row[W::SITUATION] += (log_factor * self.budget_scale) as f32;
        }
    }
}

/// Writes the time, where there is room for it, and the constant 1.
fn close<W: World>(world: &W, slot: usize, rest: &mut [f32]) {
    if let [time, _] = rest {
        *time = 2.0 * world.time(slot) as f32 / world.horizon() as f32 - 1.0;
    }
    rest[rest.len() - 1] = 1.0;
}
