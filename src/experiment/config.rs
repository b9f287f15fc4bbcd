//! Configuration: what an experiment runs, every number of it with its range.
//!
//! Layers, each winning over the one before: the default, a file after the files that it extends, the
//! variant of the experiment, `--set key=value` in the order given. The default has every key;
//! any other key is refused. It is the embedded `configs/default.toml` with a section of each world
//! and method of the [`Catalogue`], and its text is also the documentation and the range of every key.
//! The training options of one world come from `[train]` and from its own `[env.WORLD.train]`, layer
//! by layer:
//!
//! ```text
//! default [train] < default [env.W.train] < file [train] < file [env.W.train] < variant < --set ...
//! ```
//!
//! so that a later layer always wins and, within a layer, the world's own section does. `env.KEY`,
//! where KEY does not begin with a world's name, means that key in every selected world that has it;
//! `--set` and variants may use it.
//!
//! A world may be played on a scene, by the name `WORLD/SCENE`. Its constants are the world's, with those of the
//! scene below `[env.WORLD]` and the scene's map above it; `[env."WORLD/SCENE"]` wins over all, and may be a scene
//! of its own.
//!
//! | question | module |
//! |---|---|
//! | which worlds and methods are there | [`catalogue`] |
//! | how is the annotated default read | `annotated`, `rules` |
//! | which layer wins | `layers` |
//! | what are variants and axes | `variants` |
//! | what are shifts of constants | `shift` |
//! | what are scenes | [`scenes`] |
//! | what does one run's `config.toml` hold, and how is it repeated | `run`, `constants`, `of_run` |

mod annotated;
pub mod catalogue;
mod conflicts;
mod constants;
mod keys;
mod layers;
mod of_run;
mod renamed;
mod rules;
mod run;
pub mod scenes;
mod shift;
mod variants;

use super::artefacts::SCHEMA;
use super::names::{MethodName, RunId, VariantName, WorldName};
use crate::exact::yardstick;
use crate::game::budget::Eta;
use crate::learn::device::Device;
use crate::learn::options::TrainOptions;
use layers::Layer;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use thiserror::Error;
use toml::{Table, Value};

pub use annotated::OptionInfo;
pub use catalogue::{Catalogue, MethodInfo, WorldInfo};
pub use constants::WorldConstants;
pub use layers::Setting;
pub use run::{Difference, RunConfig};
pub use shift::{Shift, as_toml};

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
    /// A file's `extends` that cannot be followed.
    #[error("{origin}: extends: {what}")]
    Extends {
        /// The file.
        origin: String,
        /// What is wrong.
        what: String,
    },
    /// A name that the catalogue does not have.
    #[error("there is no {kind} {name:?}; the {kind}s are {known}")]
    UnknownName {
        /// `world` or `method`.
        kind: &'static str,
        /// The name.
        name: String,
        /// The names there are.
        known: String,
    },
    /// A key that the default configuration does not have.
    #[error("unknown key {key} (from {origin}); {advice}")]
    UnknownKey {
        /// The dotted key.
        key: String,
        /// The file or option that has it.
        origin: String,
        /// Its present name, the nearest known key, or where all keys are listed.
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
    /// Values that are each in range and impossible together.
    #[error("{0}")]
    Conflict(String),
    /// A constant of a world that the world refuses.
    #[error("env.{world}.{message}")]
    World {
        /// The world.
        world: WorldName,
        /// Its message, which begins with the constant's name.
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

/// The runs of a sweep: every world with every method, every eta and every seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Worlds.
    pub envs: Vec<WorldName>,
    /// Methods of training.
    pub methods: Vec<MethodName>,
    /// Budgets.
    pub etas: Vec<Eta>,
    /// Seeds, declared in advance.
    pub seeds: Vec<u64>,
    /// Constants under which the policies are judged as well.
    pub shifts: Vec<Shift>,
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
    #[serde(default = "figure_episodes")]
    pub figure_episodes: u64,
    /// What lava-point's regret is measured against; runs of former versions have no such key.
    #[serde(default)]
    pub oracle: Oracle,
}

/// The most episodes of a play; the upper bound of `evaluation.episodes`.
pub const MOST_EPISODES: u64 = 10_000_000;

/// Memory that an episode takes while a run is evaluated: it is kept in three plays, and once more while
/// they are sorted.
pub const BYTES_OF_AN_EPISODE: f64 = 200.0;

/// Where the certificate of lava-point's oracle comes from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Oracle {
    /// From the program, which has those of the default world; no regret elsewhere.
    #[default]
    Shipped,
    /// Computed where the program does not have it, which takes minutes.
    Computed,
}

impl EvaluationOptions {
    /// How the yardstick of a run is computed.
    pub fn yardstick(&self) -> yardstick::Options {
        let source = match self.oracle {
            Oracle::Shipped => yardstick::Source::Shipped,
            Oracle::Computed => yardstick::Source::Computed,
        };
        yardstick::Options { source, ..yardstick::Options::default() }
    }
}

/// The default of [`EvaluationOptions::figure_episodes`].
fn figure_episodes() -> u64 {
    300_000
}

/// What one world is played with.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldSettings {
    /// Its constants.
    pub constants: WorldConstants,
    /// Its training options: `[train]` with the world's own `[env.WORLD.train]` over it.
    pub train: TrainOptions,
}

/// The options of runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
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
    /// Own options of all methods, selected or not.
    pub methods: BTreeMap<MethodName, Table>,
}

/// A part of the experiment with options of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    /// Its name.
    pub name: VariantName,
    /// Its worlds.
    pub envs: Vec<WorldName>,
    /// Its methods.
    pub methods: Vec<MethodName>,
    /// Its budgets.
    pub etas: Vec<Eta>,
    /// Its options.
    pub settings: Settings,
}

/// What a configuration begins with, over the default.
#[derive(Debug, Clone, Copy)]
pub enum Source<'a> {
    /// Nothing.
    Default,
    /// `configs/quick.toml`, which is embedded in the program.
    Quick,
    /// A file.
    File(&'a Path),
}

impl<'a> Source<'a> {
    /// The file, if there is one.
    pub fn of(file: Option<&'a Path>) -> Self {
        file.map_or(Source::Default, Source::File)
    }
}

/// The resolved configuration of a sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Which runs.
    pub experiment: Experiment,
    /// Options without any variant's.
    pub base: Settings,
    /// The variants; where there are any, each run belongs to one.
    pub variants: Vec<Variant>,
}

impl Config {
    /// Resolves the default, then a file after the files that it extends, then each variant, then
    /// `settings` in their order.
    ///
    /// # Errors
    /// On a file that cannot be read, an unknown key, a wrong type, a value out of range and values
    /// that are impossible together.
    pub fn resolve(
        catalogue: &Catalogue,
        source: Source<'_>,
        settings: &[Setting],
    ) -> Result<Config, ConfigError> {
        Config::resolve_on(catalogue, source, settings, &[])
    }

    /// The same with every selected world on each of these scenes, which are names or files, in place of its own.
    ///
    /// # Errors
    /// As [`Config::resolve`], and if a scene is not there or a world cannot be laid out so.
    pub fn resolve_on(
        catalogue: &Catalogue,
        source: Source<'_>,
        settings: &[Setting],
        scenes: &[String],
    ) -> Result<Config, ConfigError> {
        let schema = catalogue.schema();
        let mut files = vec![Layer::default_of(catalogue)];
        match source {
            Source::Default => {}
            Source::Quick => files.push(layers::quick()?),
            Source::File(path) => files.extend(layers::read_files(path)?),
        }
        // At first without `env.KEY`, which needs to know the selected worlds.
        let plain = settings.iter().filter_map(|setting| setting.plain(schema));
        let stack: Vec<Layer> = files.iter().cloned().chain(plain).collect();
        stack.iter().try_for_each(|layer| layer.check(schema))?;
        let mut experiment: Experiment = section(&layers::merged(&stack), "experiment")?;
        experiment.shifts.iter().try_for_each(|shift| shift.check(schema))?;
        let mut drafts = variants::drafts(&stack, &experiment, settings, schema)?;
        if !scenes.is_empty() {
            let layer = scenes::place(scenes, &mut experiment.envs, catalogue)?;
            layer.check(schema)?;
            files.push(layer);
            for draft in &mut drafts {
                files.push(scenes::place(scenes, &mut draft.envs, catalogue)?);
            }
        }

        let mut selected: Vec<WorldName> = drafts.iter().flat_map(|of| of.envs.clone()).collect();
        if drafts.is_empty() {
            selected.clone_from(&experiment.envs);
        }
        selected.sort();
        selected.dedup();
        let mut command = Vec::new();
        for setting in settings {
            let layer = setting.layer(&selected, schema)?;
            layer.check(schema)?;
            command.push(layer);
        }

        let base = files.iter().chain(&command).cloned().collect::<Vec<_>>();
        let base = Settings::of(catalogue, &base, &selected)?;
        if drafts.is_empty() {
            let Experiment { envs, methods, etas, .. } = &experiment;
            base.check(catalogue, (envs, methods, etas), None)?;
        }
        let mut variants = Vec::new();
        for draft in drafts {
            let mut stack = files.clone();
            for setting in &draft.set {
                let layer = setting.layer(&draft.envs, schema)?;
                layer.check(schema)?;
                stack.push(layer);
            }
            stack.extend(command.iter().cloned());
            let variants::Draft { name, envs, methods, etas, .. } = draft;
            let settings = Settings::of(catalogue, &stack, &envs)?;
            settings.check(catalogue, (&envs, &methods, &etas), Some(&name))?;
            variants.push(Variant { name, envs, methods, etas, settings });
        }
        Ok(Config { experiment, base, variants })
    }

    /// The settings of a world without any variant's.
    ///
    /// # Panics
    /// If the catalogue has no such world.
    pub fn world(&self, world: impl AsRef<str>) -> &WorldSettings {
        &self.base.worlds[world.as_ref()]
    }

    /// The configuration of one run.
    ///
    /// # Panics
    /// If the configuration has no such variant, or the catalogue no such world or method.
    pub fn run(&self, id: &RunId) -> RunConfig {
        let settings = match &id.variant {
            None => &self.base,
            Some(name) => {
                let variant = self.variants.iter().find(|variant| {
                    variant.name == *name
                        && variant.envs.contains(&id.world)
                        && variant.methods.contains(&id.method)
                        && variant.etas.contains(&id.eta)
                });
                &variant.expect("the configuration has the variant").settings
            }
        };
        let world = &settings.worlds[&id.world];
        RunConfig {
            method: id.method.clone(),
            variant: id.variant.clone(),
            eta: id.eta,
            seed: id.seed,
            gamma: settings.gamma,
            device: settings.device,
            env: world.constants.clone(),
            train: world.train.clone(),
            options: settings.methods[&id.method].clone(),
            checkpoint: settings.checkpoint.clone(),
            evaluation: settings.evaluation.clone(),
        }
    }

    /// The configuration of the selected worlds and methods as a file that resolves to the same. Axes
    /// are written as the variants that they make.
    pub fn to_toml(&self) -> String {
        let Experiment { envs, methods, .. } = &self.experiment;
        let mut worlds: Vec<&WorldName> = envs.iter().collect();
        let mut all_methods: Vec<&MethodName> = methods.iter().collect();
        for variant in &self.variants {
            worlds.extend(&variant.envs);
            all_methods.extend(&variant.methods);
        }
        let base = self.base.table(&worlds, &all_methods);
        let variants: Vec<Value> = self.variants.iter().map(|of| of.table(&base).into()).collect();
        let mut experiment = as_table(&self.experiment);
        if !variants.is_empty() {
            experiment.insert("variant".to_owned(), variants.into());
        }
        let mut file = Table::new();
        file.insert("experiment".to_owned(), experiment.into());
        keys::merge(&mut file, &base);
        printed(&file)
    }
}

impl Settings {
    /// The settings of all worlds and methods of the catalogue, and of the selected worlds with scenes.
    fn of(
        catalogue: &Catalogue,
        stack: &[Layer],
        selected: &[WorldName],
    ) -> Result<Settings, ConfigError> {
        let merged = layers::merged(stack);
        let mut worlds = BTreeMap::new();
        let all = catalogue.worlds.iter().map(|world| world.name.parse());
        let all: Result<Vec<WorldName>, _> = all.collect();
        let all = all.map_err(|error| not_a_name(&error))?;
        let with_scenes = selected.iter().filter(|world| world.scene().is_some()).cloned();
        for world in all.into_iter().chain(with_scenes) {
            let train: TrainOptions = typed("train", layers::merged_train(stack, &world))?;
            let table = scenes::constants(catalogue, stack, &world)?;
            let constants = WorldConstants { world: world.clone(), table }.checked(catalogue)?;
            worlds.insert(world, WorldSettings { constants, train });
        }
        let mut methods = BTreeMap::new();
        for MethodInfo { name, .. } in &catalogue.methods {
            let method: MethodName = name.parse().map_err(|error| not_a_name(&error))?;
            let options = keys::at(&merged, &format!("method.{name}"));
            let options = options.and_then(Value::as_table).cloned().unwrap_or_default();
            methods.insert(method, options);
        }
        Ok(Settings {
            gamma: section(&merged, "gamma")?,
            device: section(&merged, "device")?,
            checkpoint: section(&merged, "checkpoint")?,
            evaluation: section(&merged, "evaluation")?,
            worlds,
            methods,
        })
    }

    /// Refuses options of these worlds and methods that are impossible together.
    fn check(
        &self,
        catalogue: &Catalogue,
        (envs, methods, etas): (&[WorldName], &[MethodName], &[Eta]),
        variant: Option<&VariantName>,
    ) -> Result<(), ConfigError> {
        for name in envs {
            let world = catalogue.world(name)?;
            let whose = match variant {
                None => name.to_string(),
                Some(variant) => format!("{name}, variant {variant}"),
            };
            for method in methods {
                catalogue.method(method)?;
                let (train, own) = (&self.worlds[name].train, &self.methods[method]);
                conflicts::check(catalogue, world, (method, own), train, &whose)?;
                conflicts::check_schedule(world, method, etas, train, &whose)?;
            }
        }
        Ok(())
    }

    /// The options of these worlds and methods as a file has them.
    fn table(&self, worlds: &[&WorldName], methods: &[&MethodName]) -> Table {
        let mut table = Table::new();
        table.insert("gamma".to_owned(), self.gamma.into());
        table.insert("device".to_owned(), self.device.to_string().into());
        table.insert("checkpoint".to_owned(), as_table(&self.checkpoint).into());
        table.insert("evaluation".to_owned(), as_table(&self.evaluation).into());
        let own =
            self.methods.iter().filter(|(name, own)| methods.contains(name) && !own.is_empty());
        let own = own.map(|(name, own)| (name.to_string(), Value::from(own.clone())));
        let own: Table = own.collect();
        if !own.is_empty() {
            table.insert("method".to_owned(), own.into());
        }
        let world = |(name, WorldSettings { constants, train }): (&WorldName, &WorldSettings)| {
            let mut section = constants.table.clone();
            section.insert("train".to_owned(), as_table(train).into());
            (name.to_string(), Value::from(section))
        };
        let selected = self.worlds.iter().filter(|(name, _)| worlds.contains(name));
        table.insert("env".to_owned(), selected.map(world).collect::<Table>().into());
        table
    }
}

impl Variant {
    /// `[[experiment.variant]]` with what differs from the base.
    fn table(&self, base: &Table) -> Table {
        #[derive(Serialize)]
        struct Section<'a> {
            name: &'a VariantName,
            envs: &'a [WorldName],
            methods: &'a [MethodName],
            etas: &'a [Eta],
            set: Table,
        }
        let Variant { name, envs, methods, etas, settings } = self;
        let own =
            settings.table(&envs.iter().collect::<Vec<_>>(), &methods.iter().collect::<Vec<_>>());
        let differs = |(key, value): &(String, Value)| keys::at(base, key) != Some(value);
        let set = keys::leaves(&own).into_iter().filter(differs).collect();
        as_table(&Section { name, envs, methods, etas, set })
    }
}

fn as_table(part: &impl Serialize) -> Table {
    Table::try_from(part).expect("a configuration is representable as TOML")
}

fn not_a_name(error: &super::names::NotAName) -> ConfigError {
    ConfigError::Conflict(error.to_string())
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
