//! TOML tables by dotted keys.

use toml::{Table, Value};

/// The table that has only this key and value.
pub(super) fn nested(key: &[String], value: Value) -> Table {
    let (last, path) = key.split_last().expect("a setting has a key");
    let leaf = Table::from_iter([(last.clone(), value)]);
    path.iter()
        .rev()
        .fold(leaf, |inner, part| Table::from_iter([(part.clone(), Value::Table(inner))]))
}

/// Writes `over` over `base`, table by table.
pub(super) fn merge(base: &mut Table, over: &Table) {
    for (key, value) in over {
        match (base.get_mut(key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            _ => {
                base.insert(key.clone(), value.clone());
            }
        }
    }
}

/// All values that are not tables, with their dotted keys; `/` is in the name of a world with a scene. An empty
/// table counts as a value, so that an unknown empty section is found too. A part of a key that is not a plain word is quoted:
/// `"train.steps" = 1` is not `train.steps`.
pub(super) fn leaves(table: &Table) -> Vec<(String, Value)> {
    let is_plain = |of: char| of.is_ascii_alphanumeric() || "_-/".contains(of);
    flat(table, &|key| {
        if !key.is_empty() && key.chars().all(is_plain) {
            key.to_owned()
        } else {
            format!("{key:?}")
        }
    })
}

/// The same where keys may be dotted: `"train.steps" = 1` is `train.steps`.
pub(super) fn dotted_leaves(table: &Table) -> Vec<(String, Value)> {
    flat(table, &str::to_owned)
}

fn flat(table: &Table, named: &dyn Fn(&str) -> String) -> Vec<(String, Value)> {
    let mut found = Vec::new();
    for (key, value) in table {
        let key = named(key);
        match value {
            Value::Table(inner) if !inner.is_empty() => {
                let inner = flat(inner, named).into_iter();
                found.extend(inner.map(|(rest, value)| (format!("{key}.{rest}"), value)));
            }
            _ => found.push((key, value.clone())),
        }
    }
    found
}

/// The value of a dotted key.
pub(super) fn at<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    match key.split_once('.') {
        None => table.get(key),
        Some((first, rest)) => match table.get(first) {
            Some(Value::Table(inner)) => at(inner, rest),
            _ => None,
        },
    }
}
