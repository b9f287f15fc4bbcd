//! Options that are each in range and impossible together.

use super::catalogue::WorldInfo;
use super::{Catalogue, ConfigError};
use crate::experiment::names::MethodName;
use crate::learn::options::TrainOptions;
use toml::Table;

/// Largest rollout in environment steps: about 2 GB of records.
const LARGEST_ROLLOUT: usize = 10_000_000;
/// Longest schedule.
const MOST_UPDATES: u64 = 10_000_000;
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
    let check = world.methods.iter().find(|(name, _)| *method == *name).map(|(_, check)| check);
    check.map_or(Ok(()), |check| check(train, options).map_err(conflict))
}

fn check_sizes(train: &TrainOptions) -> Result<(), String> {
    let rollout = train.parallel_episodes.saturating_mul(train.rollout_steps);
    if rollout > LARGEST_ROLLOUT {
        return Err(format!(
            "train.parallel_episodes * train.rollout_steps = {rollout} is too large; use at most \
             {LARGEST_ROLLOUT}"
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
