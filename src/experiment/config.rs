//! Configuration: what an experiment runs, every number of it with its range.
//!
//! Layers, each winning over the one before: the embedded `configs/default.toml`, a file, `--set
//! key=value` in the order given. The default names every key there is; any other key is refused.
//! The training options of one world come from `[train]` and from its own `[env.WORLD.train]`, layer
//! by layer:
//!
//! ```text
//! default [train] < default [env.W.train] < file [train] < file [env.W.train] < --set ...
//! ```
//!
//! so that a later layer always wins and, within a layer, the world's own section does. `--set
//! env.KEY=value`, where KEY starts with no world's name, is short for that key in every selected
//! world that has it.

mod layers;
mod rules;

use super::artefacts::SCHEMA;
use super::names::{RunId, WorldName};
use crate::game::budget::Eta;
use crate::options::{Credit, TrainOptions};
use lava_envs::{grid::GridConfig, point::PointConfig};
use layers::Layer;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use thiserror::Error;
use toml::{Table, Value};

pub use layers::Setting;

/// The annotated default configuration: the documentation of every option, and the list of all keys.
pub const DEFAULT: &str = include_str!("../../configs/default.toml");

/// The constants of a world in the default configuration, with their comments.
pub fn default_constants(world: WorldName) -> &'static str {
    let comment_above = |at: usize| DEFAULT[..at].rfind("\n\n").map_or(0, |blank| blank + 2);
    let start = DEFAULT.find(&format!("[env.{world}]")).map_or(0, comment_above);
    let end = DEFAULT.find(&format!("[env.{world}.train]")).map_or(DEFAULT.len(), comment_above);
    &DEFAULT[start..end - 1]
}

/// What is wrong with a configuration, in one line.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}; give the path of a configuration file", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Not TOML.
    #[error("{origin}: {message}")]
    Syntax {
        /// Where it was read from.
        origin: String,
        /// What is wrong, with its line.
        message: String,
    },
    /// `--set` without `=`, or with an empty key.
    #[error("--set {setting}: write --set key=value, such as --set train.steps=100000")]
    Setting {
        /// What was given.
        setting: String,
    },
    /// A key that the default configuration has not.
    #[error("unknown key {key} (from {origin}); {advice}")]
    UnknownKey {
        /// The dotted key.
        key: String,
        /// The file or option that has it.
        origin: String,
        /// The nearest known key, or where all keys are listed.
        advice: String,
    },
    /// A value of the wrong type or outside its range.
    #[error("{key} = {value} (from {origin}) is not allowed: must be {allowed}")]
    Value {
        /// The dotted key.
        key: String,
        /// The value.
        value: String,
        /// The file or option that has it.
        origin: String,
        /// What it may be.
        allowed: String,
    },
    /// Values that are fine each and impossible together.
    #[error("{0}")]
    Conflict(String),
    /// A constant of a world that the world refuses.
    #[error("env.{world}.{message}")]
    World {
        /// The world.
        world: WorldName,
        /// What it says; begins with the constant's name.
        message: String,
    },
    /// A run's `config.toml` of another version of the program.
    #[error(
        "{} has schema version {found}, this program writes and reads version {SCHEMA}; use the \
         program version that wrote it, or choose another output folder", path.display()
    )]
    Schema {
        /// The file.
        path: PathBuf,
        /// The version it has.
        found: String,
    },
}

/// The device that the networks are on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// A CUDA device by its number.
    Cuda(usize),
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Device::Cpu => f.write_str("cpu"),
            Device::Cuda(0) => f.write_str("cuda"),
            Device::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = match text {
            "cpu" => return Ok(Device::Cpu),
            "cuda" => Some(0),
            _ => text.strip_prefix("cuda:").and_then(|number| number.parse().ok()),
        };
        number.map(Device::Cuda).ok_or_else(|| format!("device {text:?} is not {}", rules::DEVICE))
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
    }
}

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

/// The runs of a sweep: every world with every eta and every seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Worlds.
    pub envs: Vec<WorldName>,
    /// Budgets.
    pub etas: Vec<Eta>,
    /// Seeds, declared in advance.
    pub seeds: Vec<u64>,
}

/// When unfinished runs are saved.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointOptions {
    /// Updates from one checkpoint to the next.
    pub every: u64,
}

/// How a trained pair is evaluated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationOptions {
    /// Episodes of each play that is sampled.
    pub episodes: u64,
    /// Episodes that are stepped together.
    pub parallel_episodes: usize,
    /// Seed of the evaluation's streams, which are shared by all runs and disjoint from training's.
    pub seed: u64,
    /// Levels at which CVaR is reported.
    pub alphas: Vec<f64>,
    /// Episodes played against the antagonist for the figures; runs of former versions have no such
    /// key.
    #[serde(default = "exhibit_episodes")]
    pub exhibit_episodes: u64,
    /// What lava-point's regret is measured against; runs of former versions have no such key.
    #[serde(default)]
    pub oracle: Oracle,
}

/// Where the certificate of lava-point's oracle comes from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Oracle {
    /// From the program, which has those of the default world; no regret elsewhere.
    #[default]
    Shipped,
    /// Computed where it is not known, which takes minutes.
    Computed,
}

/// The default of [`EvaluationOptions::exhibit_episodes`].
fn exhibit_episodes() -> u64 {
    300_000
}

/// The constants of a world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldConfig {
    /// Constants of `lava-grid`.
    LavaGrid(GridConfig),
    /// Constants of `lava-point`.
    LavaPoint(PointConfig),
}

impl WorldConfig {
    /// The world's name.
    pub fn name(&self) -> WorldName {
        match self {
            WorldConfig::LavaGrid(_) => WorldName::LavaGrid,
            WorldConfig::LavaPoint(_) => WorldName::LavaPoint,
        }
    }

    fn from_table(world: WorldName, table: Table) -> Result<Self, ConfigError> {
        let refused = |error: toml::de::Error| ConfigError::World {
            world,
            message: one_line(error.message()),
        };
        let config = match world {
            WorldName::LavaGrid => WorldConfig::LavaGrid(table.try_into().map_err(refused)?),
            WorldName::LavaPoint => WorldConfig::LavaPoint(table.try_into().map_err(refused)?),
        };
        config.validate()?;
        Ok(config)
    }

    /// Checks all numbers against their ranges.
    ///
    /// # Errors
    /// Names the number that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match self {
            WorldConfig::LavaGrid(config) => config.validate(),
            WorldConfig::LavaPoint(config) => config.validate(),
        }
        .map_err(|error| ConfigError::World { world: self.name(), message: error.to_string() })
    }
}

/// What one world is played with.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldSettings {
    /// Its constants.
    pub constants: WorldConfig,
    /// Its training options: `[train]` with the world's own `[env.WORLD.train]` over it.
    pub train: TrainOptions,
}

/// The resolved configuration of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Which runs.
    pub experiment: Experiment,
    /// Discount factor gamma of the return.
    pub gamma: f64,
    /// Device of the networks.
    pub device: Device,
    /// When unfinished runs are saved.
    pub checkpoint: CheckpointOptions,
    /// Evaluation protocol.
    pub evaluation: EvaluationOptions,
    /// Settings of all worlds, selected or not.
    pub worlds: BTreeMap<WorldName, WorldSettings>,
}

impl Config {
    /// Resolves the default, then `file`, then `settings` in their order.
    ///
    /// # Errors
    /// On a file that cannot be read, an unknown key, a wrong type, a value out of range and values
    /// that do not go together.
    pub fn resolve(file: Option<&Path>, settings: &[Setting]) -> Result<Config, ConfigError> {
        let default = Layer::default_layer();
        let schema = default.table.clone();
        let mut stack = vec![default];
        if let Some(path) = file {
            stack.push(Layer::read(path)?);
        }
        for setting in settings.iter().filter(|setting| !setting.is_shorthand()) {
            stack.push(setting.layer());
        }
        for layer in &stack {
            layer.check(&schema)?;
        }
        let experiment: Experiment = section(&layers::merged(&stack), "experiment")?;

        // Once more in the order given, now that it is known which worlds `env.KEY` means.
        stack.truncate(1 + usize::from(file.is_some()));
        for setting in settings {
            if setting.is_shorthand() {
                stack.push(setting.expanded(&experiment.envs, &schema)?);
            } else {
                stack.push(setting.layer());
            }
        }
        for layer in &stack {
            layer.check(&schema)?;
        }
        let merged = layers::merged(&stack);
        let mut worlds = BTreeMap::new();
        for world in WorldName::ALL {
            let train: TrainOptions = typed("train", layers::merged_train(&stack, world))?;
            let constants = WorldConfig::from_table(world, layers::constants(&merged, world))?;
            if experiment.envs.contains(&world) {
                check_together(&train, world)?;
            }
            worlds.insert(world, WorldSettings { constants, train });
        }
        Ok(Config {
            experiment,
            gamma: section(&merged, "gamma")?,
            device: section(&merged, "device")?,
            checkpoint: section(&merged, "checkpoint")?,
            evaluation: section(&merged, "evaluation")?,
            worlds,
        })
    }

    /// The settings of a world.
    pub fn world(&self, world: WorldName) -> &WorldSettings {
        &self.worlds[&world]
    }

    /// The configuration of one run.
    pub fn run(&self, id: RunId) -> RunConfig {
        let settings = self.world(id.env);
        RunConfig {
            eta: id.eta,
            seed: id.seed,
            gamma: self.gamma,
            device: self.device,
            env: settings.constants.clone(),
            train: settings.train.clone(),
            checkpoint: self.checkpoint.clone(),
            evaluation: self.evaluation.clone(),
        }
    }

    /// The selected worlds' configuration as a file that resolves to the same.
    pub fn to_toml(&self) -> String {
        #[derive(Serialize)]
        struct File<'a> {
            gamma: f64,
            device: Device,
            experiment: &'a Experiment,
            checkpoint: &'a CheckpointOptions,
            evaluation: &'a EvaluationOptions,
            env: BTreeMap<WorldName, World<'a>>,
        }
        #[derive(Serialize)]
        #[serde(untagged)]
        enum World<'a> {
            Grid(Section<'a, GridConfig>),
            Point(Section<'a, PointConfig>),
        }
        #[derive(Serialize)]
        struct Section<'a, C> {
            #[serde(flatten)]
            constants: &'a C,
            train: &'a TrainOptions,
        }
        let env = self.worlds.iter().filter(|(name, _)| self.experiment.envs.contains(name)).map(
            |(&name, WorldSettings { constants, train })| {
                let world = match constants {
                    WorldConfig::LavaGrid(constants) => World::Grid(Section { constants, train }),
                    WorldConfig::LavaPoint(constants) => World::Point(Section { constants, train }),
                };
                (name, world)
            },
        );
        let file = File {
            gamma: self.gamma,
            device: self.device,
            experiment: &self.experiment,
            checkpoint: &self.checkpoint,
            evaluation: &self.evaluation,
            env: env.collect(),
        };
        printed(&file)
    }
}

/// The resolved configuration of one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Budget eta.
    pub eta: Eta,
    /// Seed of all random streams of training.
    pub seed: u64,
    /// Discount factor gamma of the return.
    pub gamma: f64,
    /// Device of the networks.
    pub device: Device,
    /// The world.
    pub env: WorldConfig,
    /// Training options.
    pub train: TrainOptions,
    /// When the unfinished run is saved.
    pub checkpoint: CheckpointOptions,
    /// Evaluation protocol.
    pub evaluation: EvaluationOptions,
}

impl RunConfig {
    /// `ENV/eta-E/seed-N`.
    pub fn id(&self) -> RunId {
        RunId { env: self.env.name(), eta: self.eta, seed: self.seed }
    }

    /// The text of the run's `config.toml`.
    pub fn to_toml(&self) -> String {
        #[derive(Serialize)]
        struct File<'a> {
            schema: u32,
            #[serde(flatten)]
            run: &'a RunConfig,
        }
        let file = File { schema: SCHEMA, run: self };
        format!("# The resolved configuration of the run {}.\n{}", self.id(), printed(&file))
    }

    /// Reads a run's `config.toml` with the same checks as any configuration.
    ///
    /// # Errors
    /// If the file cannot be read, is of another schema version or is not such a configuration.
    pub fn load(path: &Path) -> Result<RunConfig, ConfigError> {
        let Layer { origin, mut table } = Layer::read(path)?;
        match table.remove("schema") {
            Some(Value::Integer(version)) if version == i64::from(SCHEMA) => {}
            other => {
                let found = other.map_or("none".to_owned(), |version| version.to_string());
                return Err(ConfigError::Schema { path: path.to_owned(), found });
            }
        }
        rules::check_all(&table, &origin)?;
        let config: RunConfig = typed(&origin, table)?;
        config.env.validate()?;
        check_together(&config.train, config.env.name())?;
        Ok(config)
    }

    /// The dotted keys in which two configurations differ, with both values.
    pub fn differences(&self, other: &RunConfig) -> Vec<Difference> {
        let flat = |config: &RunConfig| {
            let table = Table::try_from(config).expect("a configuration is representable as TOML");
            layers::leaves(&table).into_iter().collect::<BTreeMap<_, _>>()
        };
        let (ours, theirs) = (flat(self), flat(other));
        let shown = |value: Option<&Value>| value.map_or("unset".to_owned(), rules::shown);
        let mut keys: Vec<&String> = ours.keys().chain(theirs.keys()).collect();
        keys.sort();
        keys.dedup();
        keys.into_iter()
            .map(|key| (key, ours.get(key), theirs.get(key)))
            .filter(|(_, ours, theirs)| ours != theirs)
            .map(|(key, ours, theirs)| Difference {
                key: key.clone(),
                ours: shown(ours),
                theirs: shown(theirs),
            })
            .collect()
    }
}

/// A key that two configurations do not agree on.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The dotted key.
    pub key: String,
    /// Its value here.
    pub ours: String,
    /// Its value there.
    pub theirs: String,
}

/// Largest rollout in environment steps: about 2 GB of records.
const LARGEST_ROLLOUT: usize = 10_000_000;
/// Longest schedule.
const MOST_UPDATES: u64 = 10_000_000;
/// Most hidden units times samples: 8 GB of activations.
const MOST_UNITS: usize = 1_000_000_000;

/// Refuses training options that are fine each and impossible together.
fn check_together(train: &TrainOptions, world: WorldName) -> Result<(), ConfigError> {
    let conflict = |message: String| Err(ConfigError::Conflict(format!("{message} ({world})")));
    let rollout = train.parallel_episodes.saturating_mul(train.rollout_steps);
    if rollout > LARGEST_ROLLOUT {
        return conflict(format!(
            "train.parallel_episodes * train.rollout_steps = {rollout} is too large; use at most \
             {LARGEST_ROLLOUT}"
        ));
    }
    let updates = train.steps / rollout as u64;
    if updates > MOST_UPDATES {
        return conflict(format!(
            "train.steps = {} are {updates} updates of {rollout} steps each; use at most \
             {MOST_UPDATES}",
            train.steps
        ));
    }
    if train.steps < rollout as u64 {
        return conflict(format!(
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
            return conflict(format!(
                "train.{player}.hidden = {} times the steps of a rollout, {rollout}, is {units}; use \
                 at most {MOST_UNITS}",
                options.hidden
            ));
        }
        if options.minibatch > rollout {
            return conflict(format!(
                "train.{player}.minibatch = {} is more than a rollout has, \
                 train.parallel_episodes * train.rollout_steps = {rollout}; use at most that",
                options.minibatch
            ));
        }
    }
    let phases = train.budget_wait + train.budget_rise + train.response;
    if phases > 1.0 {
        return conflict(format!(
            "train.budget_wait + train.budget_rise + train.response = {phases} must be at most 1, the \
             whole run"
        ));
    }
    if train.credit == Credit::Executed && world != WorldName::LavaGrid {
        return conflict(
            "train.credit = \"executed\" is for lava-grid alone, where chance decides a move; set \
             env.lava-grid.train.credit instead"
                .into(),
        );
    }
    Ok(())
}

/// A configuration as TOML: texts of several lines as they are, and each list on one line.
fn printed(configuration: &impl Serialize) -> String {
    let text = toml::to_string_pretty(configuration).expect("it is representable as TOML");
    let mut lines = Vec::new();
    let mut list: Option<(&str, Vec<&str>)> = None;
    for line in text.lines() {
        list = match list {
            None if line.ends_with("= [") => Some((line, Vec::new())),
            None => {
                lines.push(line.to_owned());
                None
            }
            Some((opening, elements)) if line == "]" => {
                let elements = elements.join(" ");
                lines.push(format!("{opening}{}]", elements.trim_end_matches(',')));
                None
            }
            Some((opening, mut elements)) => {
                elements.push(line.trim());
                Some((opening, elements))
            }
        };
    }
    lines.join("\n") + "\n"
}

/// A key of the merged layers, which the schema guarantees to be there.
fn section<T: DeserializeOwned>(merged: &Table, key: &str) -> Result<T, ConfigError> {
    merged[key].clone().try_into().map_err(|error| syntax(key, &error))
}

fn typed<T: DeserializeOwned>(origin: &str, table: Table) -> Result<T, ConfigError> {
    table.try_into().map_err(|error| syntax(origin, &error))
}

fn syntax(origin: &str, error: &toml::de::Error) -> ConfigError {
    ConfigError::Syntax { origin: origin.to_owned(), message: one_line(error.message()) }
}

/// Error messages are one line.
fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}
