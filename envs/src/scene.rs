//! The place where episodes happen, as figures draw it, and fields of recorded steps.

use serde::{Deserialize, Serialize};

/// A rectangular place with areas in it. Lengths are in the world's unit; x to the right, y downward.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Width and height.
    pub size: [f64; 2],
    /// Whether positions are the indices of unit cells, so that a figure shows whole cells; otherwise
    /// they are points of the plane.
    pub cells: bool,
    /// Where an episode starts: the index of a cell, or a point.
    pub start: [f64; 2],
    /// Lava, goals and walls.
    pub areas: Vec<Area>,
    /// Rules of the world in a sentence or two, for captions.
    pub rules: String,
}

/// A rectangle of one kind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Area {
    /// What it is.
    pub kind: AreaKind,
    /// The corner with the smaller coordinates.
    pub min: [f64; 2],
    /// The corner with the larger coordinates.
    pub max: [f64; 2],
}

/// What an area is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AreaKind {
    /// Entering it ends the episode badly.
    Lava,
    /// Entering it ends the episode well.
    Goal,
    /// A goal that pays another reward.
    LesserGoal,
    /// It cannot be entered.
    Wall,
}

/// A field of a recorded step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Field {
    /// A whole number.
    Count(u64),
    /// A number.
    Number(f64),
    /// A word.
    Word(&'static str),
    /// Nothing: the field is empty.
    Empty,
}
