//! What every world offers: a batch of independent episodes, stepped together.

use crate::error::NoSuchState;
use crate::law::Law;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// How an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// The goal was reached.
    Goal,
    /// The lava was touched.
    Lava,
    /// The time limit T was reached. A true end of the episode: nothing follows it, so nothing is
    /// bootstrapped.
    Timeout,
}

/// What one step of one episode gave.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Step {
    /// Reward r_t.
    pub reward: f64,
    /// Set at the last step of the episode.
    pub end: Option<End>,
}

impl Step {
    /// What an episode reports that has already ended and was not reset.
    pub const IDLE: Step = Step { reward: 0.0, end: None };
}

/// A batch of episodes of one world, indexed by slot `0..self.episodes()`.
///
/// Slots never influence each other: the episode in a slot is bit for bit what it would be in a
/// batch of one.
pub trait World {
    /// What the protagonist chooses.
    type Action: Copy + std::fmt::Debug + PartialEq + Send + Sync;
    /// The nominal law of what chance decides.
    type Law: Law;
    /// All that the next steps of a slot's episode depend on.
    type Snapshot: Copy + std::fmt::Debug + PartialEq + Serialize + DeserializeOwned;

    /// Length of [`World::observe`]'s vector.
    const OBSERVATION: usize;
    /// Length of [`World::situation`]'s vector.
    const SITUATION: usize;

    /// Number of slots in the batch.
    fn episodes(&self) -> usize;

    /// Time limit T in steps.
    fn horizon(&self) -> u32;

    /// Puts the slot back to the initial state, at time 0.
    fn reset(&mut self, slot: usize);

    /// The state of the slot's episode.
    fn snapshot(&self, slot: usize) -> Self::Snapshot;

    /// Puts the slot into a state of a world with the same constants; the episode goes on from there
    /// bit for bit as it would have where the snapshot was taken.
    ///
    /// # Errors
    /// If this world has no such state; the slot stays as it is.
    fn restore(&mut self, slot: usize, snapshot: Self::Snapshot) -> Result<(), NoSuchState>;

    /// Steps since the slot's last reset.
    fn time(&self, slot: usize) -> u32;

    /// Writes what the protagonist sees (without time), each entry about [-1, 1], shape `[OBSERVATION]`.
    fn observe(&self, slot: usize, observation: &mut [f32]);

    /// The nominal law P_t of chance, given that the slot's protagonist chose `action`.
    fn law(&self, slot: usize, action: Self::Action) -> Self::Law;

    /// Writes what the antagonist sees of the world (without time and budget) once `action` is
    /// chosen: the state and the parameters of P_t, shape `[SITUATION]`.
    fn situation(&self, slot: usize, action: Self::Action, situation: &mut [f32]);

    /// Distance of the protagonist to the nearest lava, in the world's unit of length (grid: cells,
    /// point mass: metres, 0 at contact).
    fn clearance(&self, slot: usize) -> f64;

    /// Position of the protagonist, for figures and recordings.
    fn position(&self, slot: usize) -> [f64; 2];

    /// Carries out one step of every slot: its chosen action and what chance decided. All slices
    /// have length [`World::episodes`]. A slot whose episode has ended stays as it is until it is
    /// reset and reports [`Step::IDLE`].
    fn apply(
        &mut self,
        actions: &[Self::Action],
        outcomes: &[<Self::Law as Law>::Outcome],
        steps: &mut [Step],
    );
}
