//! Layers of keys: reading, checking against the default's keys, merging.

use super::{ConfigError, DEFAULT, WorldName, one_line, rules};
use crate::files::read_text;
use std::path::Path;
use toml::{Table, Value};

/// Keys and values from one place.
#[derive(Debug, Clone)]
pub(super) struct Layer {
    /// The file or the option, for messages.
    pub origin: String,
    /// Its keys.
    pub table: Table,
}

impl Layer {
    pub fn default_layer() -> Layer {
        Layer::parse("configs/default.toml", DEFAULT).expect("the embedded default is valid TOML")
    }

    pub fn read(path: &Path) -> Result<Layer, ConfigError> {
        let text = read_text(path)
            .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        Layer::parse(&path.display().to_string(), &text)
    }

    fn parse(origin: &str, text: &str) -> Result<Layer, ConfigError> {
        let table = text.parse::<Table>().map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            let line = 1 + text[..start.min(text.len())].matches('\n').count();
            let message = format!("line {line}: {}", one_line(error.message()));
            ConfigError::Syntax { origin: origin.to_owned(), message }
        })?;
        Ok(Layer { origin: origin.to_owned(), table })
    }

    /// Refuses keys that the schema has not, values of another type and values out of range.
    pub fn check(&self, schema: &Table) -> Result<(), ConfigError> {
        let known = known_keys(schema);
        for (key, value) in leaves(&self.table) {
            match lookup(schema, &key) {
                None => {
                    return Err(ConfigError::UnknownKey {
                        advice: advice(&key, &known),
                        key,
                        origin: self.origin.clone(),
                    });
                }
                Some(example) => rules::check(&key, &value, example, &self.origin)?,
            }
        }
        Ok(())
    }
}

/// More parts than any key has.
const DEEPEST: usize = 16;

/// One `key=value` from the command line.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    origin: String,
    key: Vec<String>,
    value: Value,
}

impl Setting {
    /// Parses the text behind `--set`: the value is TOML, and a string if it is not.
    ///
    /// # Errors
    /// If there is no `=` or no key before it.
    pub fn parse(text: &str) -> Result<Setting, ConfigError> {
        let refused = || ConfigError::Setting { setting: text.to_owned() };
        let (key, value) = text.split_once('=').ok_or_else(refused)?;
        let key: Vec<String> = key.split('.').map(|part| part.trim().to_owned()).collect();
        // No key is nested as deeply; reading one by one goes as deep as it is.
        if key.len() > DEEPEST || key.iter().any(String::is_empty) {
            return Err(refused());
        }
        let value =
            value.trim().parse::<Value>().unwrap_or_else(|_| Value::String(value.to_owned()));
        Ok(Setting { origin: "--set".to_owned(), key, value })
    }

    /// What an option of the command line stands for, such as `--steps` for `train.steps`.
    pub fn option(option: &str, key: &str, value: impl Into<Value>) -> Setting {
        Setting {
            origin: option.to_owned(),
            key: key.split('.').map(str::to_owned).collect(),
            value: value.into(),
        }
    }

    /// Whether the key is `env.KEY` with KEY no world's: it then means each selected world.
    pub(super) fn is_shorthand(&self) -> bool {
        self.key.len() > 1
            && self.key[0] == "env"
            && WorldName::ALL.iter().all(|world| world.as_str() != self.key[1])
    }

    pub(super) fn layer(&self) -> Layer {
        Layer { origin: self.origin.clone(), table: nested(&self.key, self.value.clone()) }
    }

    /// The layer that a shorthand stands for.
    pub(super) fn expanded(
        &self,
        worlds: &[WorldName],
        schema: &Table,
    ) -> Result<Layer, ConfigError> {
        let mut table = Table::new();
        for world in worlds {
            let mut key = self.key.clone();
            key.insert(1, world.to_string());
            if lookup(schema, &key.join(".")).is_some() {
                merge(&mut table, &nested(&key, self.value.clone()));
            }
        }
        if table.is_empty() {
            let known = known_keys(schema);
            let names: Vec<&str> = worlds.iter().map(|world| world.as_str()).collect();
            let key = self.key.join(".");
            return Err(ConfigError::UnknownKey {
                advice: format!(
                    "no selected world ({}) has it; {}",
                    names.join(", "),
                    advice(&key, &known)
                ),
                key,
                origin: self.origin.clone(),
            });
        }
        Ok(Layer { origin: self.origin.clone(), table })
    }
}

fn nested(key: &[String], value: Value) -> Table {
    let (last, path) = key.split_last().expect("a setting has a key");
    let leaf = Table::from_iter([(last.clone(), value)]);
    path.iter()
        .rev()
        .fold(leaf, |inner, part| Table::from_iter([(part.clone(), Value::Table(inner))]))
}

/// Writes `over` over `base`, table by table.
fn merge(base: &mut Table, over: &Table) {
    for (key, value) in over {
        match (base.get_mut(key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            _ => {
                base.insert(key.clone(), value.clone());
            }
        }
    }
}

/// All layers, the later ones over the earlier ones.
pub(super) fn merged(stack: &[Layer]) -> Table {
    let mut table = Table::new();
    for layer in stack {
        merge(&mut table, &layer.table);
    }
    table
}

/// The training options of a world: per layer `[train]`, then the world's own `[env.WORLD.train]`.
pub(super) fn merged_train(stack: &[Layer], world: WorldName) -> Table {
    let mut train = Table::new();
    for layer in stack {
        let own = format!("env.{world}.train");
        for section in ["train", &own] {
            if let Some(Value::Table(section)) = at(&layer.table, section) {
                merge(&mut train, section);
            }
        }
    }
    train
}

/// The constants of a world.
pub(super) fn constants(merged: &Table, world: WorldName) -> Table {
    let mut table = match at(merged, &format!("env.{world}")) {
        Some(Value::Table(table)) => table.clone(),
        _ => Table::new(),
    };
    table.remove("train");
    table
}

/// All values that are no tables, with their dotted keys. An empty table counts as a value, so that
/// an unknown empty section is found too.
pub(super) fn leaves(table: &Table) -> Vec<(String, Value)> {
    let mut found = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) if !inner.is_empty() => {
                let inner = leaves(inner).into_iter();
                found.extend(inner.map(|(rest, value)| (format!("{key}.{rest}"), value)));
            }
            _ => found.push((key.clone(), value.clone())),
        }
    }
    found
}

fn at<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    match key.split_once('.') {
        None => table.get(key),
        Some((first, rest)) => match table.get(first) {
            Some(Value::Table(inner)) => at(inner, rest),
            _ => None,
        },
    }
}

/// The default's value of a key; a world's own `train` section has the keys of `[train]`.
fn lookup<'a>(schema: &'a Table, key: &str) -> Option<&'a Value> {
    at(schema, canonical(key))
}

/// `train.KEY` for `env.WORLD.train.KEY`, and any other key itself.
pub(super) fn canonical(key: &str) -> &str {
    let own = key.strip_prefix("env.").and_then(|rest| rest.split_once('.'));
    match own {
        Some((world, rest)) if rest == "train" || rest.starts_with("train.") => {
            if world.parse::<WorldName>().is_ok() { rest } else { key }
        }
        _ => key,
    }
}

fn known_keys(schema: &Table) -> Vec<String> {
    let mut keys: Vec<String> =
        leaves(schema).into_iter().map(|(key, _)| canonical(&key).to_owned()).collect();
    keys.sort();
    keys.dedup();
    keys
}

/// The nearest known key by edit distance of the last part, then of the whole.
fn advice(key: &str, known: &[String]) -> String {
    let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let distance = |candidate: &String| {
        (strsim::osa_distance(&last(key), &last(candidate)), strsim::osa_distance(key, candidate))
    };
    let nearest = known.iter().min_by_key(|candidate| distance(candidate));
    match nearest {
        Some(nearest) if distance(nearest).0 <= 1 + last(key).len() / 4 => {
            format!("did you mean {nearest}?")
        }
        _ => "`cvar-game config` lists all keys".to_owned(),
    }
}
