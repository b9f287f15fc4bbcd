//! Shifts of constants: what trained policies are judged under besides the world of their training.

use super::ConfigError;
use super::annotated::Schema;
use serde::{Deserialize, Serialize};
use std::str::FromStr;
use toml::Value;

/// Values of a constant of a world, of which each takes the place of that of training in turn.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Shift {
    /// Name of the world.
    pub world: String,
    /// Name of the constant.
    pub constant: String,
    /// Its values.
    pub values: Vec<f64>,
}

impl FromStr for Shift {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || {
            format!(
                "{text:?} is no WORLD.CONSTANT=VALUE,VALUE.., such as \"lava-grid.slip=0.01,0.1\""
            )
        };
        let (key, values) = text.split_once('=').ok_or_else(wrong)?;
        let (world, constant) = key.trim().split_once('.').ok_or_else(wrong)?;
        let value = |text: &str| text.trim().parse().ok().filter(|value: &f64| value.is_finite());
        let values: Option<Vec<f64>> = values.split(',').map(value).collect();
        let values = values.ok_or_else(wrong)?;
        Ok(Shift { world: world.to_owned(), constant: constant.to_owned(), values })
    }
}

impl From<Shift> for String {
    fn from(Shift { world, constant, values }: Shift) -> String {
        let values: Vec<String> = values.iter().map(f64::to_string).collect();
        format!("{world}.{constant}={}", values.join(","))
    }
}

impl TryFrom<String> for Shift {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl Shift {
    /// Refuses a world or a constant that there is not, and values out of range.
    pub(super) fn check(&self, schema: &Schema) -> Result<(), ConfigError> {
        let key = format!("env.{}.{}", self.world, self.constant);
        let mut values = self.values.iter().copied().map(as_toml);
        values.try_for_each(|value| schema.check(&key, &value, "experiment.shifts"))
    }
}

/// A value of a constant: one that is whole as an integer, which real constants take as well.
pub fn as_toml(value: f64) -> Value {
    if value.fract() == 0.0 && value.abs() < 1e15 {
        Value::Integer(value as i64)
    } else {
        Value::Float(value)
    }
}
