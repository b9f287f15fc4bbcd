//! Annotated TOML: one text that is the documentation, the default and the rule of every key.

use super::rules::{self, Rule};
use super::{ConfigError, keys, renamed};
use crate::experiment::names::base_of;
use std::borrow::Cow;
use std::collections::BTreeMap;
use toml::{Table, Value};

/// All keys, with their defaults and rules.
#[derive(Debug)]
pub(super) struct Schema {
    /// The defaults.
    pub table: Table,
    /// By dotted key, without the keys of the worlds' own training options.
    options: BTreeMap<String, Documented>,
}

/// What an annotated text says about a key.
#[derive(Debug)]
struct Documented {
    rule: Rule,
    /// Whether a comment line states the rule.
    stated: bool,
    /// How many elements its list has.
    length: Option<usize>,
}

/// One option of the configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct OptionInfo {
    /// The dotted key.
    pub key: String,
    /// The default.
    pub default: Value,
    /// What it may be, in words.
    pub allowed: String,
    /// Whether a comment states what it may be (`Range:`, `One of:`).
    pub stated: bool,
}

impl Schema {
    /// What to write instead of an unknown key: its present name, or the nearest known key by edit
    /// distance of the last part, then of the whole.
    pub(super) fn advice(&self, key: &str) -> String {
        if let Some(present) = renamed::present(&self.canonical(key)) {
            return format!("it was renamed to {present}");
        }
        let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
        let distance = |candidate: &&str| {
            (
                strsim::osa_distance(&last(key), &last(candidate)),
                strsim::osa_distance(key, candidate),
            )
        };
        let nearest = self.keys().min_by_key(|candidate| distance(candidate));
        match nearest {
            Some(nearest) if distance(&nearest).0 <= 1 + last(key).len() / 4 => {
                format!("did you mean {nearest}?")
            }
            _ => "`cvar-game config` lists all keys".to_owned(),
        }
    }

    /// Reads an annotated text.
    ///
    /// # Errors
    /// If it is not TOML, or a comment states a rule that does not fit the key below it.
    pub fn read(text: &str) -> Result<Schema, String> {
        let table: Table = text.parse().map_err(|error: toml::de::Error| error.to_string())?;
        let mut options = BTreeMap::new();
        let (mut section, mut comment) = (String::new(), None);
        for (line, text) in lines(text) {
            match line {
                Line::Section(name) => section = format!("{name}."),
                Line::Key(name) => {
                    let key = format!("{section}{name}");
                    let value = keys::at(&table, &key).ok_or(format!("{key} is not read"))?;
                    let rule = Rule::read(comment, value).map_err(|why| format!("{key}: {why}"))?;
                    let stated = comment.is_some_and(Rule::is_stated);
                    // Lists of numbers in a world or a method are points and have their length; those
                    // of the experiment are sets. A list that is empty by default may have any.
                    let length = match value {
                        Value::Array(of) if of.is_empty() => None,
                        Value::Array(of) if key.starts_with("env.") => Some(of.len()),
                        Value::Array(of) if key.starts_with("method.") => Some(of.len()),
                        _ => None,
                    };
                    if canonical(&table, &key) == key {
                        options.insert(key, Documented { rule, stated, length });
                    }
                }
                _ => {}
            }
            comment = matches!(line, Line::Comment).then_some(text);
        }
        let schema = Schema { table, options };
        for (key, value) in keys::leaves(&schema.table) {
            let known = value.is_table() || schema.options.contains_key(&*schema.canonical(&key));
            known.then_some(()).ok_or(format!("{key} has no line of its own"))?;
        }
        Ok(schema)
    }

    /// All options, by key.
    pub fn options(&self) -> impl Iterator<Item = OptionInfo> {
        self.options.iter().map(|(key, Documented { rule, stated, .. })| OptionInfo {
            key: key.clone(),
            default: keys::at(&self.table, key).expect("it was found there").clone(),
            allowed: rule.allowed(),
            stated: *stated,
        })
    }

    /// All keys, sorted.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.options.keys().map(String::as_str)
    }

    /// The default's value of a key; a world's own `train` section has the keys of `[train]`.
    pub fn lookup(&self, key: &str) -> Option<&Value> {
        keys::at(&self.table, &self.canonical(key))
    }

    /// `train.KEY` for `env.WORLD.train.KEY`, `env.WORLD.KEY` for `env.WORLD/SCENE.KEY`, and any other key itself.
    pub fn canonical<'a>(&self, key: &'a str) -> Cow<'a, str> {
        canonical(&self.table, key)
    }

    /// Whether there is a world of this name, with or without a scene.
    pub fn has_world(&self, name: &str) -> bool {
        has_world(&self.table, name)
    }

    /// Refuses an unknown key, a value of another type than the default's, and one out of range.
    pub fn check(&self, key: &str, value: &Value, origin: &str) -> Result<(), ConfigError> {
        let Some(example) = self.lookup(key) else {
            return Err(ConfigError::UnknownKey {
                key: key.to_owned(),
                origin: origin.to_owned(),
                advice: self.advice(key),
            });
        };
        if rules::alike(value, example) {
            return self.check_range(key, value, origin);
        }
        let allowed = match (example, self.options.get(&*self.canonical(key))) {
            (Value::Array(_), _) => format!("a list, such as {example}"),
            (Value::Table(section), _) => {
                let first = section.keys().next().map_or("", String::as_str);
                format!("a section; set its keys, such as {key}.{first}")
            }
            (_, Some(Documented { rule, .. })) => rule.allowed(),
            (_, None) => Rule::Free.allowed(),
        };
        Err(rules::refused(key, value, origin, allowed))
    }

    /// Refuses a value out of range; a key without a rule may be anything.
    pub fn check_range(&self, key: &str, value: &Value, origin: &str) -> Result<(), ConfigError> {
        self.check_as(&self.canonical(key), key, value, origin)
    }

    /// Checks the value of a key by the rule of another one, `ruling`.
    pub fn check_as(
        &self,
        ruling: &str,
        key: &str,
        value: &Value,
        origin: &str,
    ) -> Result<(), ConfigError> {
        let Some(Documented { rule, length, .. }) = self.options.get(ruling) else {
            return Ok(());
        };
        match (value, length) {
            (Value::Array(of), Some(length)) if of.len() != *length => {
                let example = keys::at(&self.table, ruling).expect("it has a rule");
                let allowed = format!("a list of {length} numbers, such as {example}");
                return Err(rules::refused(key, value, origin, allowed));
            }
            (Value::Array(_), None) if *rule != Rule::Free => rules::check_set(key, value, origin)?,
            _ => {}
        }
        rule.check(key, value, origin)
    }
}

fn has_world(table: &Table, name: &str) -> bool {
    table.get("env").and_then(|worlds| worlds.get(base_of(name))).is_some()
}

fn canonical<'a>(table: &Table, key: &'a str) -> Cow<'a, str> {
    let parts = key.strip_prefix("env.").and_then(|rest| rest.split_once('.'));
    let Some((world, rest)) = parts.filter(|(world, _)| has_world(table, world)) else {
        return key.into();
    };
    match world.split_once('/') {
        _ if rest == "train" || rest.starts_with("train.") => rest.into(),
        Some((base, _)) => format!("env.{base}.{rest}").into(),
        None => key.into(),
    }
}

/// A kind of line of annotated TOML.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Line<'a> {
    Blank,
    Comment,
    /// `[NAME]`.
    Section(&'a str),
    /// The first line of `KEY = VALUE`.
    Key(&'a str),
    /// A further line of a value.
    Value,
}

/// The lines of an annotated text. Keys and names of sections begin their lines; a
/// value of several lines is a text in triple quotes.
fn lines(text: &str) -> impl Iterator<Item = (Line<'_>, &str)> {
    let mut in_text = false;
    text.lines().map(move |line| {
        let within = in_text;
        in_text ^= line.matches("\"\"\"").count() % 2 == 1;
        let kind = if within {
            Line::Value
        } else if line.trim().is_empty() {
            Line::Blank
        } else if line.starts_with('#') {
            Line::Comment
        } else if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            Line::Section(name)
        } else {
            line.split_once('=').map_or(Line::Value, |(key, _)| Line::Key(key.trim()))
        };
        (kind, line)
    })
}

/// The text of a separate section as the section `[NAME]` of a larger text. A first paragraph
/// with only comments is the section's heading; without one, `heading` is.
pub(super) fn nested(name: &str, heading: &str, text: &str) -> String {
    let first = text.split("\n\n").next().unwrap_or_default();
    let has_heading = !first.is_empty() && lines(first).all(|(line, _)| line == Line::Comment);
    let (heading, rest) = if has_heading { (first, &text[first.len()..]) } else { (heading, text) };
    let mut nested = format!("{heading}\n[{name}]\n");
    let rest = rest.trim_matches('\n');
    if !rest.is_empty() {
        nested += "\n";
    }
    for (line, text) in lines(rest) {
        match line {
            Line::Section(inner) => nested += &format!("[{name}.{inner}]\n"),
            _ => nested += &format!("{text}\n"),
        }
    }
    nested
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# A place.\n\n# Words.\nmap = \"\"\"\n[x]\n# no comment\n\"\"\"\n\n# A share.\n\
                        # Range: [0, 1]\nshare = 0.5\n\n# A part.\n[part]\n\n# A point.\nat = [1.0, 2.0]\n";

    #[test]
    fn a_text_becomes_a_section() {
        let nested = nested("env.place", "# none", TEXT);
        assert!(nested.starts_with("# A place.\n[env.place]\n\n# Words.\nmap ="), "{nested}");
        assert!(nested.contains("\n[x]\n# no comment\n"), "{nested}");
        assert!(nested.contains("# A part.\n[env.place.part]\n\n# A point."), "{nested}");
        let schema = Schema::read(&nested).unwrap();
        let keys: Vec<&str> = schema.keys().collect();
        assert_eq!(keys, ["env.place.map", "env.place.part.at", "env.place.share"]);
        let stated: Vec<bool> = schema.options().map(|option| option.stated).collect();
        assert_eq!(stated, [false, false, true]);
    }

    #[test]
    fn a_text_without_a_heading_gets_one() {
        assert_eq!(
            nested("a.b", "# Heading.", "# X.\nx = 1\n"),
            "# Heading.\n[a.b]\n\n# X.\nx = 1\n"
        );
        assert_eq!(nested("a.b", "# Heading.", ""), "# Heading.\n[a.b]\n");
    }

    #[test]
    fn a_rule_that_does_not_fit_is_refused() {
        let refused = |text: &str| Schema::read(text).unwrap_err();
        assert!(refused("# Range: [0, 1]\na = \"b\"\n").contains("a: \"b\" has no range"));
        assert!(refused("# Range: 0 to 1\na = 0.5\n").contains("no interval"));
    }
}
