//! What can be wrong with what a world is given: its configuration, and states to go on from.

use thiserror::Error;

/// A configuration that describes no world. Each message says where, what was found and what to do.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ConfigError {
    /// A value outside its range.
    #[error("{field} = {value} is not allowed: {allowed}")]
    Value {
        /// Name of the field.
        field: &'static str,
        /// The value that was found.
        value: String,
        /// What may stand there instead.
        allowed: String,
    },
    /// A map that is no map; row and column count from 1, as an editor shows them.
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
    pub(crate) fn of(snapshot: &impl std::fmt::Debug) -> Self {
        NoSuchState(format!("{snapshot:?}"))
    }
}

impl ConfigError {
    pub(crate) fn value(
        field: &'static str,
        value: impl std::fmt::Debug,
        allowed: impl Into<String>,
    ) -> Self {
        ConfigError::Value { field, value: format!("{value:?}"), allowed: allowed.into() }
    }
}

/// Requires a finite number that passes `test`; `allowed` says which ones do.
pub(crate) fn require(
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
