//! The catalogue: the worlds, methods and families that a configuration may name, as plain data.
//!
//! The registry of the program fills it; a world, a method or a family that it does not list has no
//! keys and is refused by name.

use super::annotated::{OptionInfo, Schema, nested};
use super::{ConfigError, one_line};
use crate::experiment::names::{MethodName, WorldName};
use crate::game::budget::Eta;
use crate::learn::options::TrainOptions;
use lava_envs::World;
use lava_envs::map::Map;
use toml::{Table, Value};

/// The part of the annotated default that does not belong to a world or a method.
const GENERAL: &str = include_str!("../../../configs/default.toml");

/// A world's part in configurations.
#[derive(Debug, Clone)]
pub struct WorldInfo {
    /// [`World::NAME`].
    pub name: &'static str,
    /// [`World::DEFAULTS`].
    pub defaults: &'static str,
    /// [`World::TRAINING`].
    pub training: &'static str,
    /// Checks constants and returns them in the order of their type, with defaults for absent ones.
    pub check: fn(Table) -> Result<Table, String>,
    /// [`World::IN_BENCHMARK`].
    pub in_benchmark: bool,
    /// [`World::of_model`].
    pub of_model: fn(&str) -> Result<Table, String>,
    /// [`World::of_map`].
    pub of_map: fn(&Map) -> Result<Table, String>,
    /// For each method, what refuses options with which it cannot train here.
    pub methods: Vec<MethodChecks>,
}

/// What refuses options with which a method cannot train in a world, each with the reason.
#[derive(Debug, Clone, Copy)]
pub struct MethodChecks {
    /// Name of the method.
    pub method: &'static str,
    /// Options of training, and of the method itself, that are each in range and impossible together.
    pub options: fn(&TrainOptions, &Table) -> Result<(), String>,
    /// Options of training that train nothing at a budget.
    pub schedule: fn(&TrainOptions, Eta) -> Result<(), String>,
}

impl WorldInfo {
    /// The entry of a world with these methods.
    pub fn of<W: World>(methods: Vec<MethodChecks>) -> WorldInfo {
        WorldInfo {
            name: W::NAME,
            defaults: W::DEFAULTS,
            training: W::TRAINING,
            in_benchmark: W::IN_BENCHMARK,
            of_model: W::of_model,
            of_map: W::of_map,
            check: |table| {
                let constants = constants_of::<W>(table)?;
                Table::try_from(constants).map_err(|error| one_line(&error.to_string()))
            },
            methods,
        }
    }
}

/// The constants of a world, checked.
pub(super) fn constants_of<W: World>(table: Table) -> Result<W::Constants, String> {
    let constants: W::Constants =
        serde_path_to_error::deserialize(Value::Table(table)).map_err(|error| {
            let place = error.path().to_string();
            let message = one_line(error.into_inner().message());
            // A missing or unknown constant is named by the message itself.
            if place.ends_with(']') { format!("{place}: {message}") } else { message }
        })?;
    W::validate(&constants).map_err(|error| error.to_string())?;
    Ok(constants)
}

/// A method's part in configurations.
#[derive(Debug, Clone)]
pub struct MethodInfo {
    /// Its name.
    pub name: &'static str,
    /// Annotated TOML of its own options, `[method.NAME]`; may be empty.
    pub defaults: &'static str,
}

/// The worlds, methods and families of the program, and the configuration that they make up.
#[derive(Debug)]
pub struct Catalogue {
    /// In the order of tables.
    pub worlds: Vec<WorldInfo>,
    /// In the order of tables.
    pub methods: Vec<MethodInfo>,
    /// Kinds of families of perturbations.
    pub families: Vec<&'static str>,
    annotated: String,
    schema: Schema,
}

impl Catalogue {
    /// The catalogue of these entries.
    ///
    /// # Panics
    /// If the annotated text of an entry is not what [`super`] describes.
    pub fn new(
        worlds: Vec<WorldInfo>,
        methods: Vec<MethodInfo>,
        families: Vec<&'static str>,
    ) -> Catalogue {
        let words = |words: &mut dyn Iterator<Item = &'static str>| {
            words.map(|word| format!("{word:?}")).collect::<Vec<_>>().join(", ")
        };
        let names: Vec<&str> = worlds.iter().map(|of| of.name).collect();
        let usual: Vec<&str> =
            worlds.iter().filter(|of| of.in_benchmark).map(|of| of.name).collect();
        let with_scenes = names.iter().map(|name| format!("{name}/SCENE"));
        let listed_worlds: Vec<String> = names
            .iter()
            .map(|&name| name.to_owned())
            .chain(with_scenes)
            .map(|name| format!("{name:?}"))
            .collect();
        let listed_worlds = listed_worlds.join(", ");
        let first: Vec<&str> = methods.iter().map(|of| of.name).take(1).collect();
        let mut annotated = GENERAL
            .replace("envs = [\"lava-grid\", \"lava-point\"]", &format!("envs = {usual:?}"))
            .replace("methods = [\"game\"]", &format!("methods = {first:?}"))
            .replace("the worlds of the program", &listed_worlds)
            .replace("the methods of the program", &words(&mut methods.iter().map(|of| of.name)))
            .replace("the families of the program", &words(&mut families.iter().copied()));
        for method in methods.iter().filter(|method| !method.defaults.is_empty()) {
            let MethodInfo { name, defaults, .. } = method;
            annotated += "\n";
            annotated +=
                &nested(&format!("method.{name}"), &format!("# The method {name}."), defaults);
        }
        for world in &worlds {
            let WorldInfo { name, training, .. } = world;
            annotated += &format!("\n{}\n", annotated_constants(world));
            annotated += &nested(
                &format!("env.{name}.train"),
                "# Training options of this world only, with the keys of [train].",
                training,
            );
        }
        let schema = Schema::read(&annotated)
            .unwrap_or_else(|problem| panic!("the annotated default is wrong: {problem}"));
        Catalogue { worlds, methods, families, annotated, schema }
    }

    /// All options with their documentation, defaults and ranges: the text that every configuration
    /// begins with.
    pub fn annotated_default(&self) -> &str {
        &self.annotated
    }

    /// All options but the worlds' own training options, by key.
    pub fn options(&self) -> impl Iterator<Item = OptionInfo> {
        self.schema.options()
    }

    /// A world by its name, whatever its scene.
    ///
    /// # Errors
    /// If there is no such name.
    pub fn world(&self, name: &WorldName) -> Result<&WorldInfo, ConfigError> {
        self.worlds.iter().find(|world| name.base() == world.name).ok_or_else(|| {
            let names: Vec<&str> = self.worlds.iter().map(|world| world.name).collect();
            ConfigError::UnknownName {
                kind: "world",
                name: name.to_string(),
                known: listed(&names),
            }
        })
    }

    /// A method by its name.
    ///
    /// # Errors
    /// If there is no such name.
    pub fn method(&self, name: &MethodName) -> Result<&MethodInfo, ConfigError> {
        self.methods.iter().find(|method| *name == method.name).ok_or_else(|| {
            let names: Vec<&str> = self.methods.iter().map(|method| method.name).collect();
            ConfigError::UnknownName {
                kind: "method",
                name: name.to_string(),
                known: listed(&names),
            }
        })
    }

    pub(super) fn schema(&self) -> &Schema {
        &self.schema
    }
}

/// The section `[env.WORLD]` with its documentation.
pub fn annotated_constants(world: &WorldInfo) -> String {
    let WorldInfo { name, defaults, .. } = world;
    nested(&format!("env.{name}"), &format!("# The world {name}."), defaults)
}

fn listed(names: &[&str]) -> String {
    match names {
        [] => "none".to_owned(),
        [only] => (*only).to_owned(),
        [rest @ .., last] => format!("{} and {last}", rest.join(", ")),
    }
}
