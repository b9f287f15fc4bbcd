//! What every world offers: a batch of independent episodes, stepped together.

use crate::action::Action;
use crate::error::{ConfigError, NoSuchState};
use crate::finite::FiniteModel;
use crate::law::Law;
use crate::map::Map;
use crate::random::ChaCha8Rng;
use crate::scene::{Field, Scene};
use rand::RngExt;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::fmt::Debug;

/// What chance decides in a world.
pub type Outcome<W> = <<W as World>::Law as Law>::Outcome;

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

/// A batch of episodes of one world, indexed by slot `0..self.episodes()`, and all that the rest of the
/// program must know of that world: its name, its constants with their documentation, what both players
/// see, and what figures and recordings show of it.
///
/// Slots never influence each other: the episode in a slot is bit for bit what it would be in a
/// batch of one.
pub trait World: Sized + Send + Sync + 'static {
    /// The constants.
    type Constants: Clone + Debug + PartialEq + Serialize + DeserializeOwned + Send + Sync;
    /// What the protagonist chooses. Its kind decides which policies fit: a
    /// [`Discrete`](crate::action::Discrete) action is drawn from a categorical one.
    type Action: Action;
    /// The nominal law of what chance decides. Its kind decides which families of perturbations fit.
    type Law: Law;
    /// All that the next steps of a slot's episode depend on.
    type Snapshot: Copy + Debug + PartialEq + Serialize + DeserializeOwned + Send;

    /// The name in configurations, folders and tables, such as `lava-grid`.
    const NAME: &'static str;
    /// All constants as annotated TOML: the one source of their documentation, defaults and ranges.
    /// [`World::Constants`] is read from all of them; a configuration lays its changes over this text.
    const DEFAULTS: &'static str;
    /// The training options in which this world's defaults differ from the general ones, as
    /// annotated TOML.
    const TRAINING: &'static str = "";
    /// Whether an outcome of chance is an executed action, which [`World::executed`] then gives.
    const OUTCOMES_ARE_ACTIONS: bool = false;
    /// Length of [`World::observe`]'s vector.
    const OBSERVATION: usize;
    /// Length of [`World::situation`]'s vector.
    const SITUATION: usize;
    /// How many of the first numbers of both vectors are coordinates of a place, each in [-1, 1]. Features
    /// show them in finer detail; 0 shows all numbers as they are.
    const POSITIONS: usize = 0;

    /// Whether experiments that name no worlds play it.
    const IN_BENCHMARK: bool = true;

    /// The constants that make this world play a table of transitions, to be written over others.
    ///
    /// # Errors
    /// If the world is not played on tables, or the text is none, with the reason.
    fn of_model(_text: &str) -> Result<toml::Table, String> {
        Err("it is not played on tables of transitions".to_owned())
    }

    /// The constants that lay this world out as a map, to be written over others.
    ///
    /// # Errors
    /// If the world cannot be laid out so, with the reason.
    fn of_map(_map: &Map) -> Result<toml::Table, String> {
        Err("it has no maps".to_owned())
    }

    /// The default constants, as [`World::DEFAULTS`] has them.
    ///
    /// # Panics
    /// If that text is not the TOML of all constants, which [`conformance`](crate::conformance) checks.
    fn defaults() -> Self::Constants {
        toml::from_str(Self::DEFAULTS)
            .unwrap_or_else(|error| panic!("the defaults of {}: {error}", Self::NAME))
    }

    /// A batch of `episodes` slots, all in the initial state.
    ///
    /// # Errors
    /// If a constant is out of range.
    fn new(constants: &Self::Constants, episodes: usize) -> Result<Self, ConfigError>;

    /// The constants of this world.
    fn constants(&self) -> &Self::Constants;

    /// Checks the constants.
    ///
    /// # Errors
    /// Names the first one that is out of range, its value and the range.
    fn validate(constants: &Self::Constants) -> Result<(), ConfigError>;

    /// Number of slots in the batch.
    fn episodes(&self) -> usize;

    /// Time limit T in steps.
    fn horizon(&self) -> u32;

    /// Puts the slot back to the initial state, at time 0.
    fn reset(&mut self, slot: usize);

    /// Puts the slot anywhere: into a random state in which episodes continue, at a random time from 1 to
    /// T - 1. A finite world draws both uniformly; one that cannot tell which states there are, or whose T is
    /// 1, is reset. Training can explore from there.
    fn scatter(&mut self, slot: usize, random: &mut ChaCha8Rng) {
        let horizon = self.horizon();
        let mut place = |model: &mut dyn FiniteModel| {
            let running: Vec<usize> =
                (0..model.states()).filter(|&state| model.ended(state).is_none()).collect();
            let state = running[random.random_range(0..running.len())];
            model.place(slot, state, random.random_range(1..horizon));
        };
        match self.finite_mut() {
            Some(model) if horizon > 1 => place(model),
            _ => self.reset(slot),
        }
    }

    /// The state of the slot's episode.
    fn snapshot(&self, slot: usize) -> Self::Snapshot;

    /// Puts the slot into a state of a world with the same constants; the episode continues from there
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

    /// The place where episodes happen, for figures.
    fn scene(&self) -> Scene;

    /// The least and the greatest return that an episode can have, discounted by gamma per step; `None`
    /// where the world does not say. Results from elsewhere are checked against it.
    fn return_range(&self, _gamma: f64) -> Option<[f64; 2]> {
        None
    }

    /// The constants that results depend on most, in a few words, for the head of a page. Empty by
    /// default.
    fn headline(&self) -> String {
        String::new()
    }

    /// The slot's state as columns of a recorded step.
    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)>;

    /// An action as columns of a recorded step.
    fn action_columns(action: Self::Action) -> Vec<(&'static str, Field)>;

    /// An outcome as columns of a recorded step.
    fn outcome_columns(outcome: Outcome<Self>) -> Vec<(&'static str, Field)>;

    /// An action as an arrow, for pictures.
    fn action_arrow(action: Self::Action) -> [f64; 2];

    /// An outcome as an arrow, for pictures.
    fn outcome_arrow(outcome: Outcome<Self>) -> [f64; 2];

    /// The outcome that carries out the action as it was chosen, where there is one.
    fn intended(_action: Self::Action) -> Option<Outcome<Self>> {
        None
    }

    /// The action that the outcome amounts to, where outcomes are executed actions.
    fn executed(_outcome: Outcome<Self>) -> Option<Self::Action> {
        None
    }

    /// The world as a finite model, which exact solvers need; `None` where states or outcomes are
    /// not finitely many.
    fn finite(&self) -> Option<&dyn FiniteModel> {
        None
    }

    /// The same, to put slots into states.
    fn finite_mut(&mut self) -> Option<&mut dyn FiniteModel> {
        None
    }

    /// Carries out one step of every slot: its chosen action and what chance decided. All slices
    /// have length [`World::episodes`]. A slot whose episode has ended stays as it is until it is
    /// reset and reports [`Step::IDLE`].
    fn apply(&mut self, actions: &[Self::Action], outcomes: &[Outcome<Self>], steps: &mut [Step]);
}

/// The least and the greatest return of an episode that costs `step_cost` in each step but the last, which
/// pays one of `ends`, or that costs it in each of `horizon` steps.
pub(crate) fn return_range(step_cost: f64, ends: &[f64], horizon: u32, gamma: f64) -> [f64; 2] {
    // sum_{t < steps} gamma^t and gamma^steps.
    let discounts = |steps: u32| {
        let last = gamma.powf(f64::from(steps));
        let sum = if gamma < 1.0 { (1.0 - last) / (1.0 - gamma) } else { f64::from(steps) };
        (sum, last)
    };
    // In between, the return is linear in gamma^t (without discount, in t).
    let (all, _) = discounts(horizon);
    let mut range = [-step_cost * all; 2];
    for steps in [0, horizon - 1] {
        let (sum, last) = discounts(steps);
        for &end in ends {
            let value = last * end - step_cost * sum;
            range = [range[0].min(value), range[1].max(value)];
        }
    }
    range
}

#[cfg(test)]
mod tests {
    use super::return_range;

    #[test]
    fn the_range_of_returns_has_the_shortest_and_the_longest_episodes() {
        let [least, greatest] = return_range(0.035, &[1.0, -1.0], 40, 1.0);
        assert!((least - (-1.0 - 39.0 * 0.035)).abs() < 1e-12 && greatest == 1.0);
        // With gamma = 1/2 and two steps: -1, -1 - 1/2, or an end at once or after a step of cost 1.
        assert_eq!(return_range(1.0, &[4.0, -4.0], 2, 0.5), [-4.0, 4.0]);
        assert_eq!(return_range(1.0, &[-4.0, -8.0], 2, 0.5), [-8.0, -1.5]);
    }
}
