//! Methods: what trains a protagonist, and an opponent if it has one.
//!
//! A [`Method`] is one file in [`super::methods`] and one line in the registry. It begins a
//! [`Training`], which proceeds update by update and can be saved and restored between two of them, and it
//! ends with [`Players`], which are all that evaluation, yardsticks, tables and figures need.

pub use super::arena::Arena;

use super::device::Device;
use super::inputs::Inputs;
use super::observation::Observation;
use super::options::TrainOptions;
use super::policy::{Mode, Opponent, Policy};
use super::state::Unfit;
use super::weights::WeightsError;
use crate::game::budget::Eta;
use lava_envs::World;
use lava_envs::random::ChaCha8Rng;

/// Everything that determines a training run, except the world and the method.
#[derive(Debug, Clone)]
pub struct Setting<'a> {
    /// Budget.
    pub eta: Eta,
    /// Discount factor.
    pub gamma: f64,
    /// Seed of all random streams.
    pub seed: u64,
    /// Device of the networks.
    pub device: Device,
    /// Options of training, `[train]`.
    pub options: &'a TrainOptions,
    /// Options of the method, `[method.NAME]`.
    pub own: &'a toml::Table,
}

/// A quantity that training reports with every update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Metric {
    /// Its column in `progress.csv`.
    pub column: &'static str,
    /// Its name in TensorBoard, which users of CleanRL know.
    pub tag: &'static str,
}

/// What one update reports.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// Index of the update, from 1.
    pub update: u64,
    /// Environment steps so far.
    pub steps: u64,
    /// Who was updated.
    pub player: &'static str,
    /// Mean undiscounted return of the episodes that ended in the update's rollout; NaN if none did.
    pub mean_return: f64,
    /// The method's [`Method::METRICS`], in their order.
    pub values: Vec<f64>,
}

/// Why training stopped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrainError {
    /// A quantity became NaN or infinite.
    #[error(
        "training diverged: {quantity} of the {player} is not finite at update {update}; \
         a smaller train.{player}.learning_rate may help"
    )]
    NotFinite {
        /// Index of the update.
        update: u64,
        /// Whose update it was.
        player: &'static str,
        /// What is not finite.
        quantity: &'static str,
    },
}

/// What trains a protagonist.
pub trait Method: Send + Sync + 'static {
    /// The name in configurations, folders and tables, such as `game`.
    const NAME: &'static str;
    /// The method's own options as annotated TOML, the section `[method.NAME]`.
    const DEFAULTS: &'static str = "";
    /// What its training reports.
    const METRICS: &'static [Metric];

    /// Checks that the method can train in this world with these options.
    ///
    /// # Errors
    /// If they do not fit; the error says in one line why and what to do.
    fn check<W: Arena>(options: &TrainOptions, own: &toml::Table) -> Result<(), String> {
        let _ = (options, own);
        Ok(())
    }

    /// Checks that a run at this budget trains the protagonist at all.
    ///
    /// # Errors
    /// If it does not; the error says in one line what would.
    fn check_schedule(options: &TrainOptions, eta: Eta) -> Result<(), String> {
        let _ = (options, eta);
        Ok(())
    }

    /// Begins training on `world`, whose slots are the parallel episodes.
    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a>;

    /// Players as training in this world begins with them, to be given weights by [`Players::load`].
    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>>;
}

/// Training, update by update; between two updates it can be saved and restored.
pub trait Training<W: World> {
    /// The next update; `None` after the last one.
    ///
    /// # Errors
    /// [`TrainError::NotFinite`] at the first quantity that is not a finite number.
    fn update(&mut self) -> Result<Option<Progress>, TrainError>;

    /// Updates done.
    fn updates(&self) -> u64;

    /// Environment steps done.
    fn steps(&self) -> u64;

    /// All that the later updates depend on, as bytes.
    fn state(&self) -> Vec<u8>;

    /// Continues from a state of training with the same setting.
    ///
    /// # Errors
    /// If the state is of another setting; part of it may be in place then.
    fn restore(&mut self, state: &[u8]) -> Result<(), Unfit>;

    /// The players as they are now.
    fn players(&self) -> &dyn Players<W>;
}

/// Trained players.
pub trait Players<W: World>: Send {
    /// The protagonist.
    fn protagonist(&self) -> Box<dyn Policy<W> + '_>;

    /// The opponent that was trained with it, if there is one.
    fn opponent(&self) -> Option<Box<dyn Opponent<W> + '_>>;

    /// What the players see; `None` where they do not look at the world through [`Observation`].
    fn observation(&self) -> Option<Observation> {
        None
    }

    /// The actions that the protagonist chooses for what it sees, a sample each; `None` where
    /// [`Players::observation`] is.
    fn act(&self, inputs: &Inputs, mode: Mode, random: &mut ChaCha8Rng) -> Option<Vec<W::Action>> {
        let _ = (inputs, mode, random);
        None
    }

    /// All weights as the bytes of a safetensors file, with `about` in its header.
    ///
    /// # Errors
    /// If the format refuses a tensor.
    fn weights(&self, about: String) -> Result<Vec<u8>, WeightsError>;

    /// Replaces all weights by those of a safetensors file.
    ///
    /// # Errors
    /// If the bytes are no such file, or a tensor is absent or of another shape.
    fn load(&mut self, bytes: &[u8]) -> Result<(), WeightsError>;
}

/// A method for one world, whatever its type: what the registry lists.
pub struct MethodEntry<W: Arena> {
    /// [`Method::NAME`].
    pub name: &'static str,
    /// [`Method::DEFAULTS`].
    pub defaults: &'static str,
    /// [`Method::METRICS`].
    pub metrics: &'static [Metric],
    /// [`Method::check`].
    pub check: fn(&TrainOptions, &toml::Table) -> Result<(), String>,
    /// [`Method::check_schedule`].
    pub check_schedule: fn(&TrainOptions, Eta) -> Result<(), String>,
    /// [`Method::begin`].
    pub begin: for<'a> fn(W, &'a Setting<'a>) -> Box<dyn Training<W> + 'a>,
    /// [`Method::players`].
    pub players: fn(&W, &Setting<'_>) -> Box<dyn Players<W>>,
}

impl<W: Arena> MethodEntry<W> {
    /// The entry of a method.
    pub fn of<M: Method>() -> Self {
        MethodEntry {
            name: M::NAME,
            defaults: M::DEFAULTS,
            metrics: M::METRICS,
            check: M::check::<W>,
            check_schedule: M::check_schedule,
            begin: M::begin::<W>,
            players: M::players::<W>,
        }
    }
}
