//! Options that are each in range and impossible together.

use super::catalogue::WorldInfo;
use super::{Catalogue, ConfigError};
use crate::experiment::names::MethodName;
use crate::game::budget::Eta;
use crate::learn::options::{MOST_UPDATES, TrainOptions};
use toml::Table;

/// Largest rollout in environment steps.
const LARGEST_ROLLOUT: usize = 10_000_000;
/// Most memory of a rollout, in bytes.
const MOST_MEMORY: usize = 4_000_000_000;
/// Memory of a parallel episode: its world and its random streams.
const MEMORY_OF_AN_EPISODE: usize = 2_000;
/// Memory of a step: what both players see, choose and earn.
const MEMORY_OF_A_STEP: usize = 300;
/// Most hidden units times samples: 8 GB of activations.
const MOST_UNITS: usize = 1_000_000_000;

/// Refuses training options that are impossible together in this world by this method. `whose` names
/// the world, and the variant where there is one.
pub(super) fn check(
    catalogue: &Catalogue,
    world: &WorldInfo,
    (method, options): (&MethodName, &Table),
    train: &TrainOptions,
    whose: &str,
) -> Result<(), ConfigError> {
    let conflict = |message: String| ConfigError::Conflict(format!("{message} ({whose})"));
    check_sizes(train).map_err(conflict)?;
    let phases = train.budget_wait + train.budget_rise + train.response;
    if phases > 1.0 {
        return Err(conflict(format!(
            "train.budget_wait + train.budget_rise + train.response = {phases} must be at most 1, the \
             whole run"
        )));
    }
    catalogue.method(method)?;
    let checks = world.methods.iter().find(|of| *method == of.method);
    checks.map_or(Ok(()), |of| (of.options)(train, options).map_err(conflict))
}

/// Refuses training options with which a run of this world by this method would train nothing at one of
/// these budgets. Not a question to a run that is finished.
pub(super) fn check_schedule(
    world: &WorldInfo,
    method: &MethodName,
    etas: &[Eta],
    train: &TrainOptions,
    whose: &str,
) -> Result<(), ConfigError> {
    let Some(of) = world.methods.iter().find(|of| *method == of.method) else { return Ok(()) };
    etas.iter().try_for_each(|&eta| {
        let refused = |message| ConfigError::Conflict(format!("{message} ({whose})"));
        (of.schedule)(train, eta).map_err(refused)
    })
}

fn check_sizes(train: &TrainOptions) -> Result<(), String> {
    let rollout = train.parallel_episodes.saturating_mul(train.rollout_steps);
    let of_episodes = train.parallel_episodes.saturating_mul(MEMORY_OF_AN_EPISODE);
    let most = MOST_MEMORY.saturating_sub(of_episodes) / MEMORY_OF_A_STEP;
    let most = most.min(LARGEST_ROLLOUT);
    if rollout > most {
        let memory = rollout.saturating_mul(MEMORY_OF_A_STEP).saturating_add(of_episodes);
        return Err(format!(
            "train.parallel_episodes * train.rollout_steps = {rollout} is too large: a rollout would \
             need about {:.1} GB of memory; use at most {most} with {} parallel episodes",
            memory as f64 / 1e9,
            train.parallel_episodes
        ));
    }
    let updates = train.steps / rollout as u64;
    if updates > MOST_UPDATES {
        return Err(format!(
            "train.steps = {} are {updates} updates of {rollout} steps each; use at most \
             {MOST_UPDATES}",
            train.steps
        ));
    }
    if train.steps < rollout as u64 {
        return Err(format!(
            "train.steps = {} is less than one rollout, train.parallel_episodes * \
             train.rollout_steps = {rollout}; raise the one or lower the others",
            train.steps
        ));
    }
    for (player, options) in
        [("protagonist", &train.protagonist), ("antagonist", &train.antagonist)]
    {
        let units = rollout.saturating_mul(options.hidden);
        if units > MOST_UNITS {
            return Err(format!(
                "train.{player}.hidden = {} times the steps of a rollout, {rollout}, is {units}; use \
                 at most {MOST_UNITS}",
                options.hidden
            ));
        }
        if options.minibatch > rollout {
            return Err(format!(
                "train.{player}.minibatch = {} is more than a rollout has, \
                 train.parallel_episodes * train.rollout_steps = {rollout}; use at most that",
                options.minibatch
            ));
        }
    }
    Ok(())
}
