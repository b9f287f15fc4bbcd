//! What each value may be.
//!
//! The type follows from the default's value; the range of every number is in [`RULES`], apart from
//! the constants of the worlds, which know their ranges themselves.

use super::layers::{canonical, leaves};
use super::{ConfigError, Device, WorldName};
use crate::game::gaussian::MAX_BUMPS;
use std::ops::Bound::{self, Excluded, Included, Unbounded};
use toml::{Table, Value};

/// The worlds, as a value may name them.
pub(super) const WORLDS: [&str; 2] = [WorldName::ALL[0].as_str(), WorldName::ALL[1].as_str()];

/// The devices, in words.
pub(super) const DEVICE: &str = "\"cpu\", \"cuda\" or \"cuda:N\"";

enum Rule {
    /// A whole number within the bounds, both included.
    Whole(i64, i64),
    /// A finite number within the bounds.
    Number(Bound<f64>, Bound<f64>),
    /// One of these words.
    Word(&'static [&'static str]),
    /// A [`Device`].
    Device,
    /// True or false.
    Flag,
}

use Rule::{Flag, Number, Whole, Word};

const POSITIVE: Rule = Number(Excluded(0.0), Unbounded);
const NOT_NEGATIVE: Rule = Number(Included(0.0), Unbounded);
const SHARE: Rule = Number(Included(0.0), Included(1.0));
const COUNT: Rule = Whole(1, i64::MAX);
/// Sizes of what is held in memory: a typing error should be refused, not fill the memory.
const SIZE: Rule = Whole(1, 1_000_000);

const CONSTANT_COUNT: Rule = Whole(0, u32::MAX as i64);

/// The rule of each key; of a list, that of its elements. `PLAYER` stands for both players.
const RULES: &[(&str, Rule)] = &[
    ("eta", Number(Included(1.0), Unbounded)),
    ("seed", Whole(0, i64::MAX)),
    ("gamma", Number(Excluded(0.0), Included(1.0))),
    ("device", Rule::Device),
    ("experiment.envs", Word(&WORLDS)),
    ("experiment.etas", Number(Included(1.0), Unbounded)),
    ("experiment.seeds", Whole(0, i64::MAX)),
    ("train.steps", COUNT),
    ("train.parallel_episodes", SIZE),
    ("train.rollout_steps", SIZE),
    ("train.follower_updates", Whole(1, 1_000)),
    ("train.leader", Word(&["protagonist", "antagonist"])),
    ("train.credit", Word(&["chosen", "executed"])),
    ("train.budget_wait", Number(Included(0.0), Excluded(1.0))),
    ("train.budget_rise", SHARE),
    ("train.response", SHARE),
    ("train.adversary", Word(&["learned", "random"])),
    ("train.hide_budget", Flag),
    ("train.price_budget", Flag),
    ("train.initial_std", POSITIVE),
    ("train.PLAYER.hidden", Whole(1, 65_536)),
    ("train.PLAYER.time_aware", Flag),
    ("train.PLAYER.learning_rate", POSITIVE),
    ("train.PLAYER.learning_rate_final", NOT_NEGATIVE),
    ("train.PLAYER.epochs", Whole(1, 1_000)),
    ("train.PLAYER.minibatch", COUNT),
    ("train.PLAYER.clip", Number(Excluded(0.0), Excluded(1.0))),
    ("train.PLAYER.gae_lambda", SHARE),
    ("train.PLAYER.entropy", NOT_NEGATIVE),
    ("train.PLAYER.entropy_final", NOT_NEGATIVE),
    ("train.PLAYER.value_coefficient", NOT_NEGATIVE),
    ("train.PLAYER.gradient_norm", POSITIVE),
    ("train.bump.count", Whole(1, MAX_BUMPS as i64)),
    ("train.bump.center", Number(Excluded(0.0), Included(100.0))),
    ("train.bump.curvature", Number(Excluded(0.0), Included(1e6))),
    ("checkpoint.every", COUNT),
    ("evaluation.episodes", Whole(1, 100_000_000)),
    ("evaluation.exhibit_episodes", Whole(1, 100_000_000)),
    ("evaluation.oracle", Word(&["shipped", "computed"])),
    ("evaluation.parallel_episodes", SIZE),
    ("evaluation.seed", Whole(0, i64::MAX)),
    ("evaluation.alphas", Number(Excluded(0.0), Included(1.0))),
];

fn rule(key: &str) -> Option<&'static Rule> {
    let player = ["train.protagonist.", "train.antagonist."];
    let key = canonical(key);
    let name = match player.iter().find_map(|prefix| key.strip_prefix(prefix)) {
        Some(rest) => format!("train.PLAYER.{rest}"),
        None => key.to_owned(),
    };
    RULES.iter().find(|(key, _)| *key == name).map(|(_, rule)| rule)
}

/// Refuses a value of another type than the default's `example`, and one out of range.
pub(super) fn check(
    key: &str,
    value: &Value,
    example: &Value,
    origin: &str,
) -> Result<(), ConfigError> {
    if alike(value, example) {
        return match (rule(key), value, example) {
            // Constants of the worlds: lists are points, whole numbers are counts.
            (None, Value::Array(values), Value::Array(point)) if values.len() != point.len() => {
                let allowed = format!("a list of {} numbers, such as {example}", point.len());
                Err(refused(key, value, origin, allowed))
            }
            (None, Value::Integer(_), Value::Integer(_)) if !CONSTANT_COUNT.admits(value) => {
                Err(refused(key, value, origin, CONSTANT_COUNT.allowed()))
            }
            _ => check_range(key, value, origin),
        };
    }
    let allowed = match example {
        Value::Array(_) => format!("a list, such as {example}"),
        Value::Table(_) => format!("a section; set its keys, such as {key}.{}", first_key(example)),
        _ => rule(key).map_or_else(|| kind(example).to_owned(), Rule::allowed),
    };
    Err(refused(key, value, origin, allowed))
}

/// Refuses every value of the table that is out of range.
pub(super) fn check_all(table: &Table, origin: &str) -> Result<(), ConfigError> {
    leaves(table).iter().try_for_each(|(key, value)| check_range(key, value, origin))
}

fn check_range(key: &str, value: &Value, origin: &str) -> Result<(), ConfigError> {
    let Some(rule) = rule(key) else {
        return match value {
            Value::Float(number) if !number.is_finite() => {
                Err(refused(key, value, origin, "a finite number".into()))
            }
            _ => Ok(()),
        };
    };
    let Value::Array(elements) = value else {
        return if rule.admits(value) {
            Ok(())
        } else {
            Err(refused(key, value, origin, rule.allowed()))
        };
    };
    if elements.is_empty() {
        return Err(refused(key, value, origin, "a list of at least one value".into()));
    }
    for (index, element) in elements.iter().enumerate() {
        if !rule.admits(element) {
            let allowed = format!("a list, each element {}", rule.allowed());
            return Err(refused(key, value, origin, allowed));
        }
        if elements[..index].iter().any(|earlier| equal(earlier, element)) {
            let allowed = format!("without duplicates ({} is there twice)", shown(element));
            return Err(refused(key, value, origin, allowed));
        }
    }
    Ok(())
}

impl Rule {
    fn admits(&self, value: &Value) -> bool {
        match (self, value) {
            (Whole(least, most), Value::Integer(value)) => (least..=most).contains(&value),
            (Number(from, to), Value::Integer(_) | Value::Float(_)) => {
                number(value).is_some_and(|value| {
                    value.is_finite() && std::ops::RangeBounds::contains(&(*from, *to), &value)
                })
            }
            (Word(words), Value::String(word)) => words.contains(&word.as_str()),
            (Rule::Device, Value::String(device)) => device.parse::<Device>().is_ok(),
            (Flag, Value::Boolean(_)) => true,
            _ => false,
        }
    }

    /// What is allowed, in words.
    fn allowed(&self) -> String {
        match self {
            Whole(least, i64::MAX) => format!("a whole number of at least {least}"),
            Whole(least, most) => format!("a whole number from {least} to {most}"),
            Number(from, to) => {
                let lower = match from {
                    Included(bound) => Some(format!("at least {bound}")),
                    Excluded(bound) => Some(format!("above {bound}")),
                    Unbounded => None,
                };
                let upper = match to {
                    Included(bound) => Some(format!("at most {bound}")),
                    Excluded(bound) => Some(format!("below {bound}")),
                    Unbounded => None,
                };
                let bounds: Vec<String> = lower.into_iter().chain(upper).collect();
                format!("a finite number {}", bounds.join(" and "))
            }
            Word(words) => {
                let quoted: Vec<String> = words.iter().map(|word| format!("{word:?}")).collect();
                quoted.join(" or ")
            }
            Rule::Device => DEVICE.to_owned(),
            Flag => "true or false".to_owned(),
        }
    }
}

/// Whether the types agree; a whole number may stand where any number may.
fn alike(value: &Value, example: &Value) -> bool {
    match (value, example) {
        (Value::Integer(_), Value::Float(_)) => true,
        (Value::Array(values), Value::Array(examples)) => {
            examples.first().is_none_or(|example| values.iter().all(|value| alike(value, example)))
        }
        (Value::Table(table), Value::Table(_)) => table.is_empty(),
        _ => value.same_type(example),
    }
}

fn equal(a: &Value, b: &Value) -> bool {
    match (number(a), number(b)) {
        (Some(a), Some(b)) => a == b,
        _ => a == b,
    }
}

fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Integer(value) => Some(*value as f64),
        Value::Float(value) => Some(*value),
        _ => None,
    }
}

fn kind(example: &Value) -> &'static str {
    match example {
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a finite number",
        Value::Boolean(_) => "true or false",
        Value::String(_) => "a text",
        _ => "a value as in configs/default.toml",
    }
}

fn first_key(section: &Value) -> &str {
    section.as_table().and_then(|table| table.keys().next()).map_or("", String::as_str)
}

/// A value on one line.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => format!("{text:?}"),
        _ => super::one_line(&value.to_string()),
    }
}

fn refused(key: &str, value: &Value, origin: &str, allowed: String) -> ConfigError {
    ConfigError::Value {
        key: key.to_owned(),
        value: shown(value),
        origin: origin.to_owned(),
        allowed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_of_the_default_has_a_range() {
        let default: Table = super::super::DEFAULT.parse().unwrap();
        for (key, _) in leaves(&default) {
            if key.starts_with("env.") && canonical(&key).starts_with("env.")
                || key.ends_with(".train")
            {
                continue; // the worlds check their constants; a world may have no options of its own
            }
            assert!(rule(&key).is_some(), "{key} has no rule");
        }
    }

    #[test]
    fn every_rule_is_of_a_key() {
        let default: Table = super::super::DEFAULT.parse().unwrap();
        let known: Vec<String> = leaves(&default).into_iter().map(|(key, _)| key).collect();
        for (key, _) in RULES {
            let key = key.replace("PLAYER", "protagonist");
            let of_a_run = ["eta", "seed"].contains(&key.as_str());
            assert!(of_a_run || known.contains(&key), "{key} is no key");
        }
    }
}
