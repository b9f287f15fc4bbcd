//! What can be wrong with what a world is given: its constants, and states to continue from.

use thiserror::Error;

/// Constants that describe no world. Each message says where the problem is, what was found and what
/// to do.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ConfigError {
    /// A value outside its range.
    #[error("{field} = {value} is not allowed: {allowed}")]
    Value {
        /// Name of the field.
        field: &'static str,
        /// The value that was found.
        value: String,
        /// The values that are allowed.
        allowed: String,
    },
    /// A table of transitions that is no process; lines count from 1, as an editor shows them.
    #[error("model, line {line}: {problem}")]
    Model {
        /// Line in the text, from 1.
        line: u64,
        /// What is wrong.
        problem: String,
    },
    /// A picture that is no map; row and column count from 1, as an editor shows them.
    #[error("map, row {row}, column {column}: {problem}; {remedy}")]
    Map {
        /// Row in the text, from 1.
        row: usize,
        /// Column in the text, from 1.
        column: usize,
        /// What was found there.
        problem: String,
        /// What to do.
        remedy: String,
    },
}

/// A snapshot that is no state of the world.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the world has no state {0}")]
pub struct NoSuchState(pub String);

impl NoSuchState {
    /// The refusal of a snapshot.
    pub fn of(snapshot: &impl std::fmt::Debug) -> Self {
        NoSuchState(format!("{snapshot:?}"))
    }
}

impl ConfigError {
    /// A value of a field that is out of range; `allowed` says which values are in range.
    pub fn value(
        field: &'static str,
        value: impl std::fmt::Debug,
        allowed: impl Into<String>,
    ) -> Self {
        ConfigError::Value { field, value: format!("{value:?}"), allowed: allowed.into() }
    }
}

/// Requires a finite number that passes `test`; `allowed` says which ones do.
///
/// # Errors
/// Names the field, its value and the allowed ones, if the number does not pass.
pub fn require(
    field: &'static str,
    value: f64,
    test: impl Fn(f64) -> bool,
    allowed: &str,
) -> Result<(), ConfigError> {
    if value.is_finite() && test(value) {
        Ok(())
    } else {
        Err(ConfigError::value(field, value, allowed))
    }
}

/// Requires a step cost, rewards and a time limit with which no return overflows.
///
/// # Errors
/// Names the first one that is out of range.
pub fn require_rewards(
    step_cost: f64,
    [goal_reward, lesser_goal_reward, lava_reward]: [f64; 3],
    horizon: u32,
) -> Result<(), ConfigError> {
    let cost = |cost: f64| (0.0..=1e6).contains(&cost);
    require("step_cost", step_cost, cost, "in [0, 1000000] (it is subtracted)")?;
    for (field, reward) in [
        ("goal_reward", goal_reward),
        ("lesser_goal_reward", lesser_goal_reward),
        ("lava_reward", lava_reward),
    ] {
        require(field, reward, |reward| reward.abs() <= 1e6, "in [-1000000, 1000000]")?;
    }
    if !(1..=1_000_000).contains(&horizon) {
        return Err(ConfigError::value("horizon", horizon, "from 1 to 1000000 steps"));
    }
    Ok(())
}
