//! What each value may be: the rules, as the last comment line above a key states them.
//!
//! ```toml
//! # Range: [1, 1000]               an interval; ( and ) leave a bound out, inf is no bound
//! # One of: "chosen", "executed"   these words; "cuda:N" allows any whole number N, "lava-grid/SCENE" any scene
//! ```
//!
//! Without such a line, the type of the default's value is the rule. Whether a range is one of whole
//! numbers follows from that type too. The rule of a list is that of its elements.

use super::{ConfigError, one_line};
use std::ops::Bound::{self, Excluded, Included, Unbounded};
use std::ops::RangeBounds;
use toml::Value;

/// What a value, or each element of a list, may be.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Rule {
    /// A whole number within the bounds, both included.
    Whole(i64, i64),
    /// A finite number within the bounds.
    Number(Bound<f64>, Bound<f64>),
    /// One of these words.
    Word(Vec<String>),
    /// Any text.
    Text,
    /// True or false.
    Flag,
    /// Checked elsewhere.
    Free,
}

impl Rule {
    /// The rule that the last comment line above a key states, or that follows from the key's
    /// default.
    ///
    /// # Errors
    /// If the line is not a rule, or does not fit the default.
    pub fn read(comment: Option<&str>, default: &Value) -> Result<Rule, String> {
        let example = element(default);
        if let Some(range) = stated(comment, "Range:") {
            let bounds = interval(range).ok_or_else(|| format!("{range:?} is no interval"))?;
            return match example {
                Value::Integer(_) => whole(bounds),
                Value::Float(_) => Ok(Rule::Number(bounds.0, bounds.1)),
                _ => Err(format!("{default} has no range")),
            };
        }
        if let Some(words) = stated(comment, "One of:") {
            let unquoted = |word: &str| {
                let word = word.trim().strip_prefix('"')?.strip_suffix('"')?;
                (!word.contains(['"', '\\'])).then(|| word.to_owned())
            };
            let words: Option<Vec<String>> = words.split(',').map(unquoted).collect();
            let words = words.filter(|_| matches!(example, Value::String(_)));
            return words.map(Rule::Word).ok_or_else(|| format!("{default} has no such choice"));
        }
        Ok(match example {
            Value::Integer(_) => Rule::Whole(i64::MIN, i64::MAX),
            Value::Float(_) => Rule::Number(Unbounded, Unbounded),
            Value::String(_) => Rule::Text,
            Value::Boolean(_) => Rule::Flag,
            _ => Rule::Free,
        })
    }

    /// Whether the comment line states a rule.
    pub fn is_stated(comment: &str) -> bool {
        ["Range:", "One of:"].iter().any(|word| stated(Some(comment), word).is_some())
    }

    /// Refuses a value, or a list with an element, that breaks the rule.
    pub fn check(&self, key: &str, value: &Value, origin: &str) -> Result<(), ConfigError> {
        match value {
            Value::Array(elements) if *self != Rule::Free => {
                if elements.iter().all(|element| self.admits(element)) {
                    return Ok(());
                }
                let allowed = format!("a list, each element {}", self.allowed());
                Err(refused(key, value, origin, allowed))
            }
            _ if self.admits(value) => Ok(()),
            _ => Err(refused(key, value, origin, self.allowed())),
        }
    }

    fn admits(&self, value: &Value) -> bool {
        match (self, value) {
            (Rule::Free, _) => true,
            (Rule::Whole(least, most), Value::Integer(value)) => (least..=most).contains(&value),
            (Rule::Number(from, to), Value::Integer(_) | Value::Float(_)) => number(value)
                .is_some_and(|value| value.is_finite() && (*from, *to).contains(&value)),
            (Rule::Word(words), Value::String(word)) => {
                let rest = |name: &str, mark: char| word.strip_prefix(name)?.strip_prefix(mark);
                words.iter().any(|known| {
                    if let Some(name) = known.strip_suffix(":N") {
                        rest(name, ':').is_some_and(|number| number.parse::<usize>().is_ok())
                    } else if let Some(name) = known.strip_suffix("/SCENE") {
                        rest(name, '/').is_some_and(|scene| !scene.is_empty())
                    } else {
                        known == word
                    }
                })
            }
            (Rule::Text, Value::String(_)) | (Rule::Flag, Value::Boolean(_)) => true,
            _ => false,
        }
    }

    /// What is allowed, in words.
    pub fn allowed(&self) -> String {
        match self {
            Rule::Whole(i64::MIN, i64::MAX) => "a whole number".to_owned(),
            Rule::Whole(least, i64::MAX) => format!("a whole number of at least {least}"),
            Rule::Whole(least, most) => format!("a whole number from {least} to {most}"),
            Rule::Number(from, to) => {
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
                format!("a finite number {}", bounds.join(" and ")).trim_end().to_owned()
            }
            Rule::Word(words) => {
                let quoted: Vec<String> = words.iter().map(|word| format!("{word:?}")).collect();
                match quoted.split_last() {
                    Some((last, rest)) if !rest.is_empty() => {
                        format!("{} or {last}", rest.join(", "))
                    }
                    _ => quoted.concat(),
                }
            }
            Rule::Text => "a text".to_owned(),
            Rule::Flag => "true or false".to_owned(),
            Rule::Free => "a value as in `cvar-game config --default`".to_owned(),
        }
    }
}

/// The rest of a comment line that begins with the word.
fn stated<'a>(comment: Option<&'a str>, word: &str) -> Option<&'a str> {
    comment?.trim_start_matches('#').trim().strip_prefix(word).map(str::trim)
}

/// An interval such as `[1, 1000]` or `(0, inf)`.
fn interval(text: &str) -> Option<(Bound<f64>, Bound<f64>)> {
    let (lower, upper) = text.split_once(',')?;
    let bound = |text: &str, included: bool| {
        let bound: f64 = text.trim().parse().ok().filter(|bound: &f64| !bound.is_nan())?;
        Some(match (bound.is_infinite(), included) {
            (true, true) => return None,
            (true, false) => Unbounded,
            (false, true) => Included(bound),
            (false, false) => Excluded(bound),
        })
    };
    let end = |text: &str, brackets: [char; 2]| {
        let included = text.contains(brackets[0]);
        (included != text.contains(brackets[1]))
            .then(|| bound(text.trim_matches(&brackets[..]), included))
            .flatten()
    };
    Some((end(lower.trim(), ['[', '('])?, end(upper.trim(), [']', ')'])?))
}

/// The whole numbers within the bounds.
fn whole((from, to): (Bound<f64>, Bound<f64>)) -> Result<Rule, String> {
    let exact = |bound: f64| {
        // Beyond 2^53 a bound could not be read exactly.
        let exact = bound.fract() == 0.0 && bound.abs() <= 9_007_199_254_740_992.0;
        exact.then_some(bound as i64).ok_or_else(|| format!("{bound} is no bound of whole numbers"))
    };
    let least = match from {
        Included(bound) => exact(bound)?,
        Excluded(bound) => exact(bound)? + 1,
        Unbounded => i64::MIN,
    };
    let most = match to {
        Included(bound) => exact(bound)?,
        Excluded(bound) => exact(bound)? - 1,
        Unbounded => i64::MAX,
    };
    Ok(Rule::Whole(least, most))
}

/// The first element of a list, and any other value itself.
fn element(value: &Value) -> &Value {
    match value {
        Value::Array(elements) => elements.first().map_or(value, element),
        _ => value,
    }
}

/// Refuses an empty list, and one with the same element twice.
pub(super) fn check_set(key: &str, value: &Value, origin: &str) -> Result<(), ConfigError> {
    let Value::Array(elements) = value else { return Ok(()) };
    if elements.is_empty() {
        return Err(refused(key, value, origin, "a list of at least one value".into()));
    }
    for (index, element) in elements.iter().enumerate() {
        if elements[..index].iter().any(|earlier| equal(earlier, element)) {
            let allowed = format!("without duplicates ({} is there twice)", shown(element));
            return Err(refused(key, value, origin, allowed));
        }
    }
    Ok(())
}

/// Whether the types agree; a whole number is allowed where any number is.
pub(super) fn alike(value: &Value, example: &Value) -> bool {
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

/// A value on one line.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => format!("{text:?}"),
        _ => one_line(&value.to_string()),
    }
}

pub(super) fn refused(key: &str, value: &Value, origin: &str, allowed: String) -> ConfigError {
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
    fn rules_are_read_from_comments() {
        let (one, half) = (Value::Integer(1), Value::Float(0.5));
        let read = |line: &str, default: &Value| Rule::read(Some(line), default);
        assert_eq!(read("# Range: [1, 1000]", &one), Ok(Rule::Whole(1, 1000)));
        assert_eq!(read("# Range: (0, inf)", &one), Ok(Rule::Whole(1, i64::MAX)));
        assert_eq!(read("# Range: (0, 1]", &half), Ok(Rule::Number(Excluded(0.0), Included(1.0))));
        assert_eq!(read("# Range: (-inf, inf)", &half), Ok(Rule::Number(Unbounded, Unbounded)));
        let list = Value::Array(vec![half.clone()]);
        assert_eq!(read("# Range: [0, inf)", &list), Ok(Rule::Number(Included(0.0), Unbounded)));
        let words = read("# One of: \"a\", \"b:N\"", &Value::String("a".into())).unwrap();
        assert!(words.admits(&Value::String("b:7".into())));
        assert!(!words.admits(&Value::String("b:".into())));
        assert_eq!(words.allowed(), "\"a\" or \"b:N\"");
        for refused in ["[1, 2", "1, 2", "[1; 2]", "[nan, 1]", "[0, inf]", "[0.5, 1]", "[(0, 1]"] {
            let read = read(&format!("# Range: {refused}"), &one);
            assert!(read.is_err(), "{refused} was read as {read:?}");
        }
        assert!(read("# One of: a, b", &Value::String("a".into())).is_err());
        assert!(read("# One of: \"a\"", &one).is_err());
    }
}
