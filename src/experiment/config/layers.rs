//! Layers of keys: reading, checking against the default's keys, merging.

use super::annotated::Schema;
use super::keys::{at, leaves, merge, nested};
use super::of_run::as_experiment;
use super::{Catalogue, ConfigError, one_line};
use crate::experiment::names::WorldName;
use crate::files::read_text;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Keys and values from one place.
#[derive(Debug, Clone)]
pub(super) struct Layer {
    /// The file or the option, for messages.
    pub origin: String,
    /// Its keys, but for those of `variants` and `axes`.
    pub table: Table,
    /// `experiment.variant`, if the layer has it.
    pub variants: Option<Value>,
    /// `experiment.axes`, if the layer has it.
    pub axes: Option<Value>,
}

impl Layer {
    pub fn new(origin: &str, mut table: Table) -> Layer {
        let mut taken = |key| match table.get_mut("experiment") {
            Some(Value::Table(experiment)) => experiment.remove(key),
            _ => None,
        };
        let (variants, axes) = (taken("variant"), taken("axes"));
        Layer { origin: origin.to_owned(), table, variants, axes }
    }

    /// The default configuration.
    pub fn default_of(catalogue: &Catalogue) -> Layer {
        Layer::new("the default", catalogue.schema().table.clone())
    }

    /// Refuses keys that the schema does not have, values of another type and values out of range.
    pub fn check(&self, schema: &Schema) -> Result<(), ConfigError> {
        leaves(&self.table)
            .iter()
            .try_for_each(|(key, value)| schema.check(key, value, &self.origin))
    }
}

/// The small benchmark that runs in minutes.
const QUICK: &str = "configs/quick.toml";

/// The configurations of the repository, which the program carries: there they are no files.
const EMBEDDED: &[(&str, &str)] = &[
    (QUICK, include_str!("../../../configs/quick.toml")),
    ("configs/paper.toml", include_str!("../../../configs/paper.toml")),
    ("configs/paper-plain.toml", include_str!("../../../configs/paper-plain.toml")),
    ("configs/paper-timeless.toml", include_str!("../../../configs/paper-timeless.toml")),
    ("configs/equal-updates.toml", include_str!("../../../configs/equal-updates.toml")),
    ("configs/response.toml", include_str!("../../../configs/response.toml")),
    ("configs/published.toml", include_str!("../../../configs/published.toml")),
    ("configs/coordinates.toml", include_str!("../../../configs/coordinates.toml")),
    ("configs/ablations.toml", include_str!("../../../configs/ablations.toml")),
    ("configs/methods.toml", include_str!("../../../configs/methods.toml")),
    ("configs/iqn.toml", include_str!("../../../configs/iqn.toml")),
    ("configs/suite.toml", include_str!("../../../configs/suite.toml")),
    ("configs/frozen-lake.toml", include_str!("../../../configs/frozen-lake.toml")),
    ("configs/noise.toml", include_str!("../../../configs/noise.toml")),
];

/// The embedded small benchmark.
pub(super) fn quick() -> Result<Layer, ConfigError> {
    let (name, text) = EMBEDDED[0];
    parse(name, text)
}

/// A TOML file, or the embedded one of that path where there is no such file.
pub(super) fn read(path: &Path) -> Result<(String, Table), ConfigError> {
    let embedded = |source: std::io::Error| {
        let known = EMBEDDED.iter().find(|(name, _)| Path::new(name) == path);
        let missing = source.kind() == std::io::ErrorKind::NotFound;
        let text = known.filter(|_| missing).map(|&(_, text)| text.to_owned());
        text.ok_or_else(|| ConfigError::Read { path: path.to_owned(), source })
    };
    let text = read_text(path).or_else(embedded)?;
    let origin = path.display().to_string();
    let table = table(&origin, &text)?;
    Ok((origin, table))
}

/// A text as TOML.
pub(super) fn table(origin: &str, text: &str) -> Result<Table, ConfigError> {
    text.parse::<Table>().map_err(|error| {
        let start = error.span().map_or(0, |span| span.start);
        let line = 1 + text[..start.min(text.len())].matches('\n').count();
        let message = format!("line {line}: {}", one_line(error.message()));
        ConfigError::Syntax { origin: origin.to_owned(), message }
    })
}

/// A text as a layer.
pub(super) fn parse(origin: &str, text: &str) -> Result<Layer, ConfigError> {
    Ok(Layer::new(origin, table(origin, text)?))
}

/// The most files that extend one another.
const MOST_FILES: usize = 16;

/// A configuration file after the files that it extends.
pub(super) fn read_files(path: &Path) -> Result<Vec<Layer>, ConfigError> {
    let mut layers = Vec::new();
    let mut read_paths: Vec<PathBuf> = Vec::new();
    let mut next = Some(path.to_owned());
    while let Some(path) = next {
        let (origin, table) = read(&path)?;
        let mut table = as_experiment(&path, table)?;
        let extends = |what: String| ConfigError::Extends { origin: origin.clone(), what };
        next = match table.remove("extends") {
            None => None,
            Some(Value::String(base)) => Some(path.parent().unwrap_or(Path::new("")).join(base)),
            Some(value) => {
                return Err(extends(format!(
                    "{} is no path of a file",
                    one_line(&value.to_string())
                )));
            }
        };
        // One file may be reached by several paths.
        let real = path.canonicalize().unwrap_or(path);
        if read_paths.contains(&real) {
            return Err(extends("the files extend one another in a circle".to_owned()));
        }
        read_paths.push(real);
        if read_paths.len() > MOST_FILES {
            return Err(extends(format!("more than {MOST_FILES} files extend one another")));
        }
        layers.push(Layer::new(&origin, table));
    }
    layers.reverse();
    Ok(layers)
}

/// More parts than any key has.
const DEEPEST: usize = 16;

/// One `key=value`: from the command line, or from a variant of the experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    origin: String,
    key: Vec<String>,
    value: Value,
}

impl Setting {
    /// The constant of a world that it sets, by `env.KEY` or `env.WORLD.KEY`, and its value.
    pub(super) fn constant(&self, world: &str) -> Result<(String, Value), ConfigError> {
        let key: Vec<&str> = self.key.iter().map(String::as_str).collect();
        match key[..] {
            ["env", constant] => Ok((constant.to_owned(), self.value.clone())),
            ["env", of, constant] if of == world => Ok((constant.to_owned(), self.value.clone())),
            _ => Err(ConfigError::UnknownKey {
                key: self.key.join("."),
                origin: self.origin.clone(),
                advice: format!("set constants of the world here, as env.KEY or env.{world}.KEY"),
            }),
        }
    }

    /// Parses the text after `--set`: the value is TOML, and a string if it is not.
    ///
    /// # Errors
    /// If there is no `=` or no key before it.
    pub fn parse(text: &str) -> Result<Setting, ConfigError> {
        let refused = || ConfigError::Setting { setting: text.to_owned() };
        let (key, value) = text.split_once('=').ok_or_else(refused)?;
        let key = parts(key).ok_or_else(refused)?;
        let value =
            value.trim().parse::<Value>().unwrap_or_else(|_| Value::String(value.to_owned()));
        Ok(Setting { origin: "--set".to_owned(), key, value })
    }

    /// The setting of an option of the command line, such as `--steps` for `train.steps`.
    pub fn option(option: &str, key: &str, value: impl Into<Value>) -> Setting {
        Setting {
            origin: option.to_owned(),
            key: key.split('.').map(str::to_owned).collect(),
            value: value.into(),
        }
    }

    /// A setting of a variant; `None` if the key has no parts or too many.
    pub(super) fn of_variant(origin: &str, key: &str, value: Value) -> Option<Setting> {
        Some(Setting { origin: origin.to_owned(), key: parts(key)?, value })
    }

    /// The dotted key.
    pub(super) fn key(&self) -> String {
        self.key.join(".")
    }

    /// Whether the key is `env.KEY` and KEY is not a world's: it then means each selected world.
    fn is_shorthand(&self, schema: &Schema) -> bool {
        self.key.len() > 1 && self.key[0] == "env" && !schema.has_world(&self.key[1])
    }

    /// The layer of the setting, if it needs no list of worlds.
    pub(super) fn plain(&self, schema: &Schema) -> Option<Layer> {
        (!self.is_shorthand(schema))
            .then(|| Layer::new(&self.origin, nested(&self.key, self.value.clone())))
    }

    /// The layer of the setting, with `env.KEY` for each of the worlds that has it.
    pub(super) fn layer(
        &self,
        worlds: &[WorldName],
        schema: &Schema,
    ) -> Result<Layer, ConfigError> {
        if let Some(layer) = self.plain(schema) {
            return Ok(layer);
        }
        let mut table = Table::new();
        for world in worlds {
            let mut key = self.key.clone();
            key.insert(1, world.to_string());
            if schema.lookup(&key.join(".")).is_some() {
                merge(&mut table, &nested(&key, self.value.clone()));
            }
        }
        if table.is_empty() {
            let names: Vec<&str> = worlds.iter().map(WorldName::as_str).collect();
            let key = self.key();
            return Err(ConfigError::UnknownKey {
                advice: format!(
                    "no selected world ({}) has it; {}",
                    names.join(", "),
                    schema.advice(&key)
                ),
                key,
                origin: self.origin.clone(),
            });
        }
        Ok(Layer::new(&self.origin, table))
    }
}

/// The parts of a dotted key; `None` if one is empty or there are more than [`DEEPEST`].
fn parts(key: &str) -> Option<Vec<String>> {
    let parts: Vec<String> = key.split('.').map(|part| part.trim().to_owned()).collect();
    (parts.len() <= DEEPEST && !parts.iter().any(String::is_empty)).then_some(parts)
}

/// All layers, the later ones over the earlier ones.
pub(super) fn merged(stack: &[Layer]) -> Table {
    let mut table = Table::new();
    for layer in stack {
        merge(&mut table, &layer.table);
    }
    table
}

/// The training options of a world: per layer `[train]`, then the world's own `[env.WORLD.train]`, then those of
/// its scene, `[env."WORLD/SCENE".train]`.
pub(super) fn merged_train(stack: &[Layer], world: &WorldName) -> Table {
    let mut train = Table::new();
    for layer in stack {
        let (base, whole) = (format!("env.{}.train", world.base()), format!("env.{world}.train"));
        let scene = (base != whole).then_some(&whole);
        for section in ["train", &base].into_iter().chain(scene.map(String::as_str)) {
            if let Some(Value::Table(section)) = at(&layer.table, section) {
                merge(&mut train, section);
            }
        }
    }
    train
}

/// The constants that a layer, or several that are merged, gives a world or a world with a scene.
pub(super) fn constants(merged: &Table, world: &str) -> Table {
    let mut table = match at(merged, &format!("env.{world}")) {
        Some(Value::Table(table)) => table.clone(),
        _ => Table::new(),
    };
    table.remove("train");
    table
}
