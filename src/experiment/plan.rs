//! The plan: which runs a configuration means, in which order, and where each is kept.

use super::config::{Config, WorldName};
use crate::game::budget::Eta;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

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

/// The runs of a sweep: by world, then by eta, then by seed, each in the order of the configuration.
pub fn runs(config: &Config) -> Vec<RunId> {
    let experiment = &config.experiment;
    let mut runs = Vec::new();
    for &env in &experiment.envs {
        for &eta in &experiment.etas {
            runs.extend(experiment.seeds.iter().map(|&seed| RunId { env, eta, seed }));
        }
    }
    runs
}
