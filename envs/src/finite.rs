//! Worlds of finitely many states, actions and outcomes, as exact solvers read them.

use crate::world::{End, Step};

/// A world whose states, actions and outcomes are finitely many, by their indices.
///
/// The reward of a step and the next state follow from the state, the action and the outcome of chance.
pub trait FiniteModel {
    /// Number of states.
    fn states(&self) -> usize;

    /// The state in which an episode starts.
    fn start(&self) -> usize;

    /// Number of actions.
    fn actions(&self) -> usize;

    /// Number of outcomes of chance.
    fn outcomes(&self) -> usize;

    /// How an episode that has entered the state has ended; `None` where it continues.
    fn ended(&self, state: usize) -> Option<End>;

    /// The nominal probabilities of the outcomes, shape `[outcomes]`, after `action` in `state`.
    fn probabilities(&self, state: usize, action: usize) -> Vec<f64>;

    /// What an outcome leads to after an action in a state: the next state, and the step with its reward
    /// and its end, leaving the time limit aside.
    fn successor(&self, state: usize, action: usize, outcome: usize) -> (usize, Step);

    /// The outcome that carries out the action as it was chosen, where there is one.
    fn intended_outcome(&self, action: usize) -> Option<usize>;

    /// The action in a word.
    fn action_name(&self, action: usize) -> &'static str;

    /// The action as an arrow, for pictures; y downward.
    fn arrow(&self, action: usize) -> [f64; 2];

    /// Column and row of a state on the map of the world's scene.
    fn coordinates(&self, state: usize) -> [usize; 2];

    /// The state that the slot's episode is in.
    fn state(&self, slot: usize) -> usize;

    /// Whether the slot's episode has ended.
    fn is_over(&self, slot: usize) -> bool;

    /// Puts the slot's episode into `state` after `time` steps.
    ///
    /// # Panics
    /// If there is no such state.
    fn place(&mut self, slot: usize, state: usize, time: u32);
}
