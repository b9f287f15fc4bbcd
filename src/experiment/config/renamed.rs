//! Keys of former versions. The `config.toml` of a run may still have them; in any other
//! configuration they are refused with the new name.

use super::keys::{self, at, nested};
use toml::{Table, Value};

/// Keys and sections, former and present.
const RENAMED: [(&str, &str); 3] = [
    ("train.price_budget", "train.budget_sensitivity"),
    ("train.bump", "train.family"),
    ("evaluation.exhibit_episodes", "evaluation.figure_episodes"),
];

/// What former versions did not write, by section and key, with the value that it had in them.
fn added() -> [(&'static str, &'static str, Value); 7] {
    [
        ("train.family", "train.family.kind", "auto".into()),
        ("train", "train.observation", "coordinates".into()),
        ("train", "train.policy", "gaussian".into()),
        ("train", "train.antagonist_acts", "outcome".into()),
        ("train", "train.critic_sees", "observation".into()),
        ("train", "train.exploring_starts", 0.0.into()),
        ("train", "train.exploring_until", 0.25.into()),
    ]
}

/// The present name of a former key.
pub(super) fn present(key: &str) -> Option<String> {
    RENAMED.iter().find_map(|(former, present)| {
        let rest = key.strip_prefix(former)?;
        (rest.is_empty() || rest.starts_with('.')).then(|| format!("{present}{rest}"))
    })
}

/// Gives the keys of a run's configuration their present names, and what former versions did not
/// write the value that it had in them.
pub(super) fn update(run: &mut Table) {
    for (former, present) in RENAMED {
        if let Some(value) = take(run, former) {
            insert(run, present, value);
        }
    }
    for (section, key, value) in added() {
        if at(run, section).is_some() && at(run, key).is_none() {
            insert(run, key, value);
        }
    }
}

fn take(table: &mut Table, key: &str) -> Option<Value> {
    match key.split_once('.') {
        None => table.remove(key),
        Some((first, rest)) => take(table.get_mut(first)?.as_table_mut()?, rest),
    }
}

fn insert(table: &mut Table, key: &str, value: Value) {
    let key: Vec<String> = key.split('.').map(str::to_owned).collect();
    keys::merge(table, &nested(&key, value));
}
