//! The state of training between two updates: all that the later updates depend on besides the
//! configuration, so that a run that continues from it ends with the same bits.
//!
//! The schedules follow from the number of the update. Random streams follow from the seed and from how far
//! they were read. Trajectories are cleared before each rollout and are not part of the state.

use super::adam::Adam;
use crate::game::returns::ReturnSoFar;
use serde::{Deserialize, Serialize};

/// State of training; `S` is the state of a world's episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingState<S> {
    /// Updates done, of both players together.
    pub update: u64,
    /// How far the stream of the minibatches was read.
    pub minibatches: u128,
    /// The protagonist.
    pub protagonist: PlayerState,
    /// The antagonist; absent at eta = 1.
    pub antagonist: Option<PlayerState>,
    /// The antagonist of the protagonist's draw; absent but in the game `joint`.
    pub action_antagonist: Option<PlayerState>,
    /// The parallel games.
    pub games: GamesState<S>,
}

/// State of a player.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlayerState {
    /// All parameters of its networks.
    pub parameters: Vec<f32>,
    /// Its optimiser.
    pub optimiser: Adam,
}

/// State of the parallel games that rollouts are taken from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GamesState<S> {
    /// Per slot.
    pub slots: Vec<SlotState<S>>,
    /// max prod delta / eta over all trajectories so far.
    pub budget_use: f64,
}

/// State of the game in one slot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SlotState<S> {
    /// The episode in the world.
    pub episode: S,
    /// Remaining budget eta_t.
    pub budget: f64,
    /// Budget that the episode started with.
    pub start: f64,
    /// The return of the episode so far.
    pub so_far: ReturnSoFar,
    /// prod delta so far.
    pub product: f64,
    /// How far the stream of the actions was read.
    pub actions: u128,
    /// How far the stream of the outcomes was read.
    pub outcomes: u128,
}

/// A state of another run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{0} state does not fit the run")]
pub struct Unfit(pub &'static str);
