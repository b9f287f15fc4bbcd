//! The configuration of one run, and its `config.toml`.

use super::constants::WorldConstants;
use super::keys::{self, dotted_leaves};
use super::layers::{self, Setting};
use super::{
    Catalogue, CheckpointOptions, ConfigError, EvaluationOptions, conflicts, of_run, printed,
    rules, typed,
};
use crate::experiment::archive;
use crate::experiment::artefacts::SCHEMA;
use crate::experiment::names::{MethodName, RunId, VariantName};
use crate::game::budget::Eta;
use crate::learn::device::Device;
use crate::learn::method;
use crate::learn::options::{PlayerOptions, TrainOptions};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use toml::{Table, Value};

/// The resolved configuration of one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Method of training; former versions had one method and did not write it.
    #[serde(default = "MethodName::game")]
    pub method: MethodName,
    /// Variant of the experiment, if it has variants. Its options are in this configuration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub variant: Option<VariantName>,
    /// Budget eta.
    pub eta: Eta,
    /// Seed of all random streams of training.
    pub seed: u64,
    /// Discount factor gamma of the return.
    pub gamma: f64,
    /// Device of the networks.
    pub device: Device,
    /// The world.
    pub env: WorldConstants,
    /// Training options.
    pub train: TrainOptions,
    /// The method's own options.
    #[serde(default, skip_serializing_if = "Table::is_empty")]
    pub options: Table,
    /// When the unfinished run is saved.
    pub checkpoint: CheckpointOptions,
    /// Evaluation protocol.
    pub evaluation: EvaluationOptions,
}

impl RunConfig {
    /// The run's name.
    pub fn id(&self) -> RunId {
        RunId {
            world: self.env.world.clone(),
            method: self.method.clone(),
            variant: self.variant.clone(),
            eta: self.eta,
            seed: self.seed,
        }
    }

    /// The constants of its world with some replaced, by settings `env.KEY` or `env.WORLD.KEY`.
    ///
    /// # Errors
    /// If a setting is none of a constant, or the world refuses the constants.
    pub fn constants_with(
        &self,
        settings: &[Setting],
        catalogue: &Catalogue,
    ) -> Result<WorldConstants, ConfigError> {
        let mut changed = self.env.clone();
        for setting in settings {
            let (constant, value) = setting.constant(self.env.world.as_str())?;
            changed.table.insert(constant, value);
        }
        changed.checked(catalogue)
    }

    /// What determines the training of the run, except its world and method.
    pub fn setting(&self) -> method::Setting<'_> {
        method::Setting {
            eta: self.eta,
            gamma: self.gamma,
            seed: self.seed,
            device: self.device,
            options: &self.train,
            own: &self.options,
        }
    }

    /// All that training depends on, as a text: two runs with the same one end with the same weights. The
    /// evaluation is not in it, because it can be done again.
    pub fn training_text(&self) -> String {
        let mut table = Table::try_from(self).expect("a configuration is representable as TOML");
        table.remove("evaluation");
        table.to_string()
    }

    /// How long the run takes, in units that runs can be compared by: samples that go through its networks, times
    /// their hidden units.
    pub fn work(&self) -> f64 {
        let TrainOptions { protagonist, antagonist, .. } = &self.train;
        let EvaluationOptions { episodes, figure_episodes, .. } = self.evaluation;
        // An update takes a pass forwards and one back, which is twice as much.
        let learning = |of: &PlayerOptions| 3.0 * f64::from(of.epochs) * of.hidden as f64;
        let mut playing = protagonist.hidden as f64;
        let (update, plays) = if self.eta.is_neutral() {
            (learning(protagonist), 2 * episodes)
        } else {
            playing += antagonist.hidden as f64;
            let updates = [learning(protagonist), learning(antagonist)];
            (updates[0].midpoint(updates[1]), 3 * episodes + figure_episodes.max(episodes))
        };
        let train = self.train.whole_steps() as f64 * (update + playing);
        // A rollout has as many steps as an episode.
        train + (plays as f64 * self.train.rollout_steps as f64) * playing
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

    /// Reads a run's `config.toml`, of this version or a former one, with the same checks as any
    /// configuration.
    ///
    /// # Errors
    /// If the file cannot be read, is of another schema version or is not such a configuration.
    pub fn load(path: &Path, catalogue: &Catalogue) -> Result<RunConfig, ConfigError> {
        let (origin, table) = layers::read(path)?;
        Self::checked(path, &origin, table, catalogue)
    }

    /// That of the run in `folder`, or packed in the archive of its results folder; `None` if there is no such run.
    ///
    /// # Errors
    /// As [`RunConfig::load`].
    pub fn of_folder(
        folder: &Path,
        catalogue: &Catalogue,
    ) -> Result<Option<RunConfig>, ConfigError> {
        let unreadable = |path: &Path, source| ConfigError::Read { path: path.to_owned(), source };
        let (path, bytes) = archive::read_file(folder, "config.toml")
            .map_err(|source| unreadable(folder, source))?;
        let Some(bytes) = bytes else { return Ok(None) };
        let text = String::from_utf8(bytes).map_err(|error| {
            unreadable(&path, io::Error::new(io::ErrorKind::InvalidData, error))
        })?;
        Self::parse(&path, &text, catalogue).map(Some)
    }

    /// The same for a text, which is that of `path`.
    ///
    /// # Errors
    /// As [`RunConfig::load`].
    pub fn parse(path: &Path, text: &str, catalogue: &Catalogue) -> Result<RunConfig, ConfigError> {
        let origin = path.display().to_string();
        let table = layers::table(&origin, text)?;
        Self::checked(path, &origin, table, catalogue)
    }

    fn checked(
        path: &Path,
        origin: &str,
        mut table: Table,
        catalogue: &Catalogue,
    ) -> Result<RunConfig, ConfigError> {
        of_run::to_present(path, &mut table)?;
        for (key, value) in keys::leaves(&table) {
            check_range(catalogue, &key, &value, origin)?;
        }
        let mut run: RunConfig = typed(origin, table)?;
        run.env = run.env.checked(catalogue)?;
        run.options = options(catalogue, &run, origin)?;
        let world = catalogue.world(&run.env.world)?;
        let method = (&run.method, &run.options);
        conflicts::check(catalogue, world, method, &run.train, world.name)?;
        Ok(run)
    }

    /// The dotted keys in which two configurations differ, with both values.
    pub fn differences(&self, other: &RunConfig) -> Vec<Difference> {
        let flat = |config: &RunConfig| {
            let table = Table::try_from(config).expect("a configuration is representable as TOML");
            keys::leaves(&table).into_iter().collect::<BTreeMap<_, _>>()
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

/// Checks a value of a run by the option that it was chosen from.
fn check_range(
    catalogue: &Catalogue,
    key: &str,
    value: &Value,
    origin: &str,
) -> Result<(), ConfigError> {
    let schema = catalogue.schema();
    match key {
        "eta" => schema.check_as("experiment.etas", key, value, origin),
        "seed" => schema.check_as("experiment.seeds", key, value, origin),
        "method" => schema.check_as("experiment.methods", key, value, origin),
        _ => schema.check_range(key, value, origin),
    }
}

/// The options of the run's method, checked; an absent one has its default.
fn options(catalogue: &Catalogue, run: &RunConfig, origin: &str) -> Result<Table, ConfigError> {
    let section = format!("method.{}", run.method);
    for (key, value) in dotted_leaves(&run.options) {
        catalogue.schema().check(&format!("{section}.{key}"), &value, origin)?;
    }
    let defaults = keys::at(&catalogue.schema().table, &section).and_then(Value::as_table);
    let mut options = defaults.cloned().unwrap_or_default();
    keys::merge(&mut options, &run.options);
    Ok(options)
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
