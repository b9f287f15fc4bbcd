//! Episodes to be shown.

use lava_envs::End;
use serde::{Deserialize, Serialize};

/// An episode of a policy under nominal chance, step by step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Walk {
    /// Index of the episode in the evaluation's streams.
    pub index: u64,
    /// How it ended.
    pub end: End,
    /// Its return J.
    pub value: f64,
    /// Where it was, from the start on: n + 1 places (cells or m).
    pub path: Vec<[f64; 2]>,
    /// Chosen actions, as arrows.
    pub actions: Vec<[f64; 2]>,
    /// Outcomes of chance, as arrows.
    pub outcomes: Vec<[f64; 2]>,
}
