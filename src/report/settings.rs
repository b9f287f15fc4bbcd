//! What a run was trained and evaluated on, by its `config.toml`: which runs make one row, and which rows
//! may be compared.
//!
//! | part | keys | where two runs differ in it |
//! |---|---|---|
//! | the task | gamma and the world's constants | separate rows, and no differences between them: CVaR compares policies of one task |
//! | training | `train.*` and the method's own options | separate rows |
//! | evaluation | `evaluation.episodes`, `evaluation.seed` | a note |
//!
//! A run of another program, without a `config.toml`, is of the world's default task. It may bring a
//! `config.toml` with `gamma` and `[env.WORLD]`; what these leave out has its default.

use super::Worlds;
use crate::experiment::archive::RunName;
use std::collections::BTreeMap;
use toml::{Table, Value};

/// More characters of a value than this do not fit into a label.
const LONGEST_VALUE: usize = 24;

/// The most keys in a label or a note.
const MOST_KEYS: usize = 3;

/// What is played: a world with its constants, and the discount of its return.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// Discount factor gamma of the return.
    pub gamma: f64,
    /// All constants of the world, as far as they are known.
    pub constants: Table,
}

/// What a run was trained and evaluated on.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// What was played.
    pub task: Task,
    /// Options of training and of the method, by dotted key.
    training: BTreeMap<String, Value>,
    /// Options of the evaluation on which its numbers depend, by dotted key.
    evaluation: BTreeMap<String, Value>,
    /// The text of `config.toml`, if there is one.
    pub text: Option<String>,
}

/// A key in which two runs differ, with the values of both.
#[derive(Debug, Clone, PartialEq)]
pub struct Difference {
    /// The dotted key: `slip`, `train.steps`.
    pub key: String,
    /// The values, as TOML.
    pub values: [String; 2],
}

impl Settings {
    /// The settings of a run with this `config.toml`.
    ///
    /// # Errors
    /// If it is no TOML, or of another world.
    pub fn of(name: &RunName, text: Option<String>, worlds: &dyn Worlds) -> Result<Self, String> {
        let file = text.as_deref().map(|text| read(text, worlds)).transpose()?.unwrap_or_default();
        let section = |key: &str| file.get(key).and_then(Value::as_table).cloned();
        let own = match section("env") {
            None => Table::new(),
            Some(mut worlds) => match worlds.remove(&name.world) {
                Some(Value::Table(own)) => own,
                _ => {
                    let found: Vec<&str> = worlds.keys().map(String::as_str).collect();
                    return Err(format!(
                        "it has no [env.{}], but the constants of {}",
                        name.world,
                        found.join(", ")
                    ));
                }
            },
        };
        let gamma = match file.get("gamma") {
            Some(Value::Float(gamma)) => *gamma,
            Some(Value::Integer(gamma)) => *gamma as f64,
            Some(other) => return Err(format!("gamma = {other} is no number")),
            None => worlds.gamma(),
        };
        let constants = worlds.constants(&name.world, &own).unwrap_or(own);
        let mut training = BTreeMap::new();
        for part in ["train", "options"] {
            training.extend(leaves(part, &section(part).unwrap_or_default()));
        }
        let mut evaluation = leaves("evaluation", &section("evaluation").unwrap_or_default());
        evaluation.retain(|key, _| ["evaluation.episodes", "evaluation.seed"].contains(&&key[..]));
        Ok(Settings { task: Task { gamma, constants }, training, evaluation, text })
    }

    /// Whether runs with these settings make one row.
    pub fn are_alike(&self, other: &Settings) -> bool {
        self.task == other.task && self.training_differences(other).is_empty()
    }

    /// The keys in which training differs, of those that both have: a run of another program says nothing
    /// of its training, or little.
    pub fn training_differences(&self, other: &Settings) -> Vec<Difference> {
        common(&self.training, &other.training)
    }

    /// The options of the evaluation, in words: `evaluation.episodes = 2000`.
    pub fn evaluation(&self) -> impl Iterator<Item = (&String, &Value)> {
        self.evaluation.iter()
    }

    /// The seed of the evaluation's streams, where it is known.
    pub fn stream(&self) -> Option<u64> {
        self.evaluation.get("evaluation.seed")?.as_integer()?.try_into().ok()
    }

    /// All that tells settings apart, by dotted key.
    fn keys(&self) -> BTreeMap<String, Value> {
        let task = self.task.keys().into_iter();
        task.chain(self.training.iter().map(|(key, value)| (key.clone(), value.clone()))).collect()
    }
}

impl Task {
    fn keys(&self) -> BTreeMap<String, Value> {
        let mut keys = leaves("", &self.constants);
        keys.insert("gamma".to_owned(), Value::Float(self.gamma));
        keys
    }

    /// The constants in which two tasks differ.
    pub fn differences(&self, other: &Task) -> Vec<Difference> {
        let (ours, theirs) = (self.keys(), other.keys());
        let shown = |value: Option<&Value>| value.map_or("unset".to_owned(), Value::to_string);
        let mut keys: Vec<&String> = ours.keys().chain(theirs.keys()).collect();
        keys.sort();
        keys.dedup();
        (keys.into_iter().filter(|key| ours.get(*key) != theirs.get(*key)))
            .map(|key| Difference {
                key: key.clone(),
                values: [shown(ours.get(key)), shown(theirs.get(key))],
            })
            .collect()
    }
}

/// Differences in words: `slip (0.05 and 0.3), goal_reward (1.0 and 2.0)`.
pub fn listed(differences: &[Difference]) -> String {
    let one = |Difference { key, values: [ours, theirs] }: &Difference| {
        if [ours, theirs].iter().any(|value| value.chars().count() > LONGEST_VALUE) {
            return key.clone();
        }
        format!("{key} ({ours} and {theirs})")
    };
    let mut parts: Vec<String> = differences.iter().take(MOST_KEYS).map(one).collect();
    if differences.len() > MOST_KEYS {
        parts.push(format!("and {} more", differences.len() - MOST_KEYS));
    }
    parts.join(", ")
}

/// What tells each of several settings of one world and method apart: `slip=0.3`. The labels are unique.
pub fn labels(all: &[&Settings]) -> Vec<String> {
    let keys: Vec<BTreeMap<String, Value>> = all.iter().map(|of| of.keys()).collect();
    let mut telling: Vec<&String> = keys.iter().flat_map(BTreeMap::keys).collect();
    telling.sort();
    telling.dedup();
    // A key that a run of another program does not have says nothing.
    telling.retain(|key| {
        let mut values = keys.iter().filter_map(|of| of.get(*key));
        let first = values.next();
        values.any(|value| Some(value) != first)
    });
    let mut labels: Vec<String> = Vec::new();
    for own in &keys {
        let values = telling.iter().filter_map(|key| Some((*key, own.get(*key)?)));
        let said = |(key, value): (&String, &Value)| {
            let text = match value {
                Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            let fits = text.chars().count() <= LONGEST_VALUE && !text.contains('\n');
            let key = key.strip_prefix("train.").unwrap_or(key);
            if fits { format!("{key}={text}") } else { key.to_owned() }
        };
        let mut parts: Vec<String> = values.map(said).collect();
        if parts.len() > MOST_KEYS {
            parts.truncate(MOST_KEYS);
            parts.push("...".to_owned());
        }
        labels.push(parts.join(", "));
    }
    let unique = |place: usize, label: &String| {
        let same = labels.iter().filter(|other| *other == label).count();
        let before = labels[..place].iter().filter(|other| *other == label).count();
        if same > 1 { format!("{label} #{}", before + 1) } else { label.clone() }
    };
    labels.iter().enumerate().map(|(place, label)| unique(place, label)).collect()
}

/// A `config.toml` with the keys of this version; of other versions and programs as it is.
fn read(text: &str, worlds: &dyn Worlds) -> Result<Table, String> {
    if let Some(table) = worlds.configuration(text) {
        return Ok(table);
    }
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    toml::from_str(text).map_err(|error| words(error.message()))
}

/// The values of a table by their dotted keys.
fn leaves(above: &str, table: &Table) -> BTreeMap<String, Value> {
    let mut found = BTreeMap::new();
    for (key, value) in table {
        let key = if above.is_empty() { key.clone() } else { format!("{above}.{key}") };
        match value {
            Value::Table(table) => found.extend(leaves(&key, table)),
            value => drop(found.insert(key, value.clone())),
        }
    }
    found
}

fn common(ours: &BTreeMap<String, Value>, theirs: &BTreeMap<String, Value>) -> Vec<Difference> {
    let both = ours.iter().filter_map(|(key, ours)| Some((key, ours, theirs.get(key)?)));
    both.filter(|(_, ours, theirs)| ours != theirs)
        .map(|(key, ours, theirs)| Difference {
            key: key.clone(),
            values: [ours.to_string(), theirs.to_string()],
        })
        .collect()
}
