//! The `config.toml` of a run, of this version or a former one: brought to the present keys, and read as
//! the configuration of an experiment, which repeats the run.

use super::{ConfigError, renamed};
use crate::experiment::artefacts::SCHEMA;
use crate::experiment::names::MethodName;
use std::path::Path;
use toml::{Table, Value};

/// Brings the table of a `config.toml` of this version or a former one to the present keys.
pub(super) fn to_present(path: &Path, table: &mut Table) -> Result<(), ConfigError> {
    match table.remove("schema") {
        Some(Value::Integer(version)) if version == i64::from(SCHEMA) => {}
        other => {
            let found = other.map_or("none".to_owned(), |version| version.to_string());
            return Err(ConfigError::Schema { path: path.to_owned(), found });
        }
    }
    renamed::update(table);
    Ok(())
}

/// The `config.toml` of a run as the configuration of an experiment that consists of this run; any other
/// table as it is.
///
/// # Errors
/// If it is of another schema version.
pub(super) fn as_experiment(path: &Path, mut table: Table) -> Result<Table, ConfigError> {
    if !["schema", "eta", "seed", "env"].iter().all(|key| table.contains_key(*key)) {
        return Ok(table);
    }
    to_present(path, &mut table)?;
    let method = table.remove("method").unwrap_or_else(|| MethodName::GAME.as_str().into());
    let worlds = table.get("env").and_then(Value::as_table);
    let worlds: Vec<Value> =
        worlds.into_iter().flat_map(Table::keys).cloned().map(Value::from).collect();
    let mut experiment = Table::new();
    experiment.insert("envs".to_owned(), worlds.into());
    for (key, list) in [("eta", "etas"), ("seed", "seeds")] {
        let value = table.remove(key).into_iter().collect::<Vec<_>>();
        experiment.insert(list.to_owned(), value.into());
    }
    if let Some(name) = table.remove("variant") {
        let variant = Table::from_iter([("name".to_owned(), name)]);
        experiment.insert("variant".to_owned(), vec![Value::from(variant)].into());
    }
    if let (Some(options), Some(name)) = (table.remove("options"), method.as_str()) {
        let section = Table::from_iter([(name.to_owned(), options)]);
        table.insert("method".to_owned(), section.into());
    }
    experiment.insert("methods".to_owned(), vec![method].into());
    table.insert("experiment".to_owned(), experiment.into());
    Ok(table)
}
