//! Names of worlds and runs, as they stand in configurations, folders and tables.

use crate::game::budget::Eta;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A world by its name in configurations, folders and tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldName {
    /// The grid with slips.
    LavaGrid,
    /// The point mass with Gaussian noise.
    LavaPoint,
}

impl WorldName {
    /// All worlds, in the order of tables.
    pub const ALL: [WorldName; 2] = [WorldName::LavaGrid, WorldName::LavaPoint];

    /// The name as text.
    pub const fn as_str(self) -> &'static str {
        match self {
            WorldName::LavaGrid => "lava-grid",
            WorldName::LavaPoint => "lava-point",
        }
    }
}

impl fmt::Display for WorldName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl FromStr for WorldName {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        WorldName::ALL.into_iter().find(|world| world.as_str() == name).ok_or_else(|| {
            format!(
                "there is no world {name:?}; the worlds are {}",
                WorldName::ALL.map(WorldName::as_str).join(" and ")
            )
        })
    }
}

/// Names one run of a sweep: `lava-grid/eta-25/seed-3`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunId {
    /// World.
    pub env: WorldName,
    /// Budget.
    pub eta: Eta,
    /// Seed.
    pub seed: u64,
}

impl RunId {
    /// The run's folder in an output folder. Made of a world's name and two numbers, it never leads
    /// out of that folder.
    pub fn folder(&self, out: &Path) -> PathBuf {
        out.join(self.to_string())
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(&format!("{}/eta-{}/seed-{}", self.env, self.eta, self.seed))
    }
}

/// A text that names no run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} names no run; runs are named like lava-grid/eta-25/seed-3")]
pub struct NotARun(String);

impl FromStr for RunId {
    type Err = NotARun;

    fn from_str(text: &str) -> Result<Self, NotARun> {
        let parse = || {
            let mut parts = text.split('/');
            let env = parts.next()?.parse().ok()?;
            let eta = parts.next()?.strip_prefix("eta-")?.parse().ok()?;
            let seed = parts.next()?.strip_prefix("seed-")?.parse().ok()?;
            let id = RunId { env, eta, seed };
            // One run has one name: `eta-25.0` and `seed-03` are none.
            (parts.next().is_none() && id.to_string() == text).then_some(id)
        };
        parse().ok_or_else(|| NotARun(text.to_owned()))
    }
}
