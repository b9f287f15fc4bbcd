//! Scenes: a map and a few constants, on which a world is played.
//!
//! A scene is a TOML file:
//!
//! ```toml
//! about = "What is special about it, in a sentence."
//! difficulty = "route"            # what makes it hard, in a word or two; may be left out
//! horizon = 60                    # constants that all worlds with such a key take
//! map = """
//! S..L.G
//! ......
//! """
//! [lava-point]                    # constants of one world
//! acceleration = 3.0
//! ```
//!
//! A scene of the world `table` is a CSV file, its transitions ([`lava_envs::table`]).
//!
//! Each world lays itself out as the map ([`lava_envs::World::of_map`]): cells of the grid, or an arena whose lava, walls
//! and goals are those cells in metres.

use super::catalogue::WorldInfo;
use super::layers::{self, Layer};
use super::{Catalogue, ConfigError, keys, one_line};
use crate::experiment::names::WorldName;
use crate::files::read_text;
use lava_envs::map::Map;
use std::ffi::OsStr;
use std::path::Path;
use toml::{Table, Value};

macro_rules! shipped {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../configs/scenes/", $name, ".toml")))
    };
}

/// The scenes of the program, in the order of tables: one file and one line each.
const SHIPPED: &[(&str, &str)] = &[
    shipped!("strait"),
    shipped!("lava-gap-s7"),
    shipped!("lava-crossing-s9n1"),
    shipped!("lava-crossing-s9n2"),
    shipped!("dist-shift-1"),
    shipped!("dist-shift-2"),
    shipped!("detour"),
    shipped!("two-goals"),
    shipped!("cliff-walk"),
    shipped!("island"),
    shipped!("chow-gap"),
    shipped!("risky-point-mass"),
];

/// A map and constants.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Where it was read from.
    origin: String,
    /// What is special about it.
    pub about: String,
    /// What makes it hard, in a word or two.
    pub difficulty: Option<String>,
    /// Its map.
    pub map: Map,
    /// Constants for all worlds.
    common: Table,
    /// Constants by world.
    own: Table,
}

impl Scene {
    /// Reads a scene; `origin` is for messages.
    ///
    /// # Errors
    /// If the text is not a scene.
    pub fn parse(origin: &str, text: &str) -> Result<Scene, ConfigError> {
        let mut table = layers::table(origin, text)?;
        let refused = |message: String| ConfigError::Syntax { origin: origin.to_owned(), message };
        let mut text_of = |key: &str| match table.remove(key) {
            Some(Value::String(text)) => Ok(Some(text)),
            Some(other) => {
                Err(refused(format!("{key} = {} is no text", one_line(&other.to_string()))))
            }
            None => Ok(None),
        };
        let needed = |key: &str| refused(format!("a scene needs the key {key}"));
        let about = text_of("about")?.ok_or_else(|| needed("about"))?;
        let difficulty = text_of("difficulty")?;
        let map = text_of("map")?.ok_or_else(|| needed("map"))?;
        let map = Map::parse(&map).map_err(|error| refused(error.to_string()))?;
        let (own, common) = table.into_iter().partition(|(_, value)| value.is_table());
        Ok(Scene { origin: origin.to_owned(), about, difficulty, map, common, own })
    }

    /// Refuses keys that are a constant of no world.
    fn check(&self, catalogue: &Catalogue) -> Result<(), ConfigError> {
        let known = |key: &String| {
            let schema = catalogue.schema();
            catalogue
                .worlds
                .iter()
                .any(|of| schema.lookup(&format!("env.{}.{key}", of.name)).is_some())
        };
        let message = match self.common.keys().find(|key| !known(key)) {
            Some(key) => format!("no world has a constant {key}"),
            None => match self
                .own
                .keys()
                .find(|name| catalogue.worlds.iter().all(|of| of.name != **name))
            {
                Some(name) => format!("there is no world {name}"),
                None => return Ok(()),
            },
        };
        Err(ConfigError::Syntax { origin: self.origin.clone(), message })
    }

    /// What it gives a world: the constants that its map makes, and the others.
    ///
    /// # Errors
    /// If the world cannot be laid out as the map, or has no constant of such a name.
    fn constants(&self, world: &WorldInfo) -> Result<(Table, Table), ConfigError> {
        let refused =
            |message: String| ConfigError::Syntax { origin: self.origin.clone(), message };
        let map = (world.of_map)(&self.map)
            .map_err(|why| refused(format!("{} cannot be played here: {why}", world.name)))?;
        let defaults = world.defaults.parse::<Table>().expect("the registry has read it");
        let mut others = self.common.clone();
        others.retain(|key, _| defaults.contains_key(key));
        if let Some(Value::Table(own)) = self.own.get(world.name) {
            let unknown = own.keys().find(|key| !defaults.contains_key(*key));
            if let Some(key) = unknown {
                return Err(refused(format!("{} has no constant {key}", world.name)));
            }
            others.extend(own.clone());
        }
        Ok((map, others))
    }
}

/// The scenes of the program, with their names.
pub fn all() -> impl Iterator<Item = (&'static str, Scene)> {
    SHIPPED.iter().map(|&(name, text)| {
        let scene = Scene::parse(&format!("configs/scenes/{name}.toml"), text);
        (name, scene.unwrap_or_else(|error| panic!("a shipped scene is wrong: {error}")))
    })
}

/// A scene of the program.
pub fn shipped(name: &str) -> Option<Scene> {
    all().find(|(known, _)| *known == name).map(|(_, scene)| scene)
}

/// The default constants of a world, with those of its scene where it is one of the program's; `None` where that cannot
/// be.
pub fn defaults(world: &WorldInfo, name: &WorldName) -> Option<Table> {
    let mut table: Table = world.defaults.parse().ok()?;
    if let Some(scene) = name.scene().and_then(shipped) {
        let (map, others) = scene.constants(world).ok()?;
        table.extend(others);
        table.extend(map);
    }
    Some(table)
}

/// The constants of a world: its defaults, those that a scene of the program sets, `[env.WORLD]` of files and
/// options, the scene's map, and `[env."WORLD/SCENE"]`.
pub(super) fn constants(
    catalogue: &Catalogue,
    stack: &[Layer],
    world: &WorldName,
) -> Result<Table, ConfigError> {
    let Some(name) = world.scene() else {
        return Ok(layers::constants(&layers::merged(stack), world.base()));
    };
    let (default, given) = stack.split_first().expect("the default is the first layer");
    let given = layers::merged(given);
    let own = layers::constants(&given, world.as_str());
    let (map, others) = match shipped(name) {
        Some(scene) => scene.constants(catalogue.world(world)?)?,
        None if own.is_empty() => return Err(unknown(name)),
        None => (Table::new(), Table::new()),
    };
    let mut table = layers::constants(&default.table, world.base());
    for over in [others, layers::constants(&given, world.base()), map, own] {
        keys::merge(&mut table, &over);
    }
    Ok(table)
}

/// The refusal of a scene that is not there.
fn unknown(name: &str) -> ConfigError {
    let names: Vec<&str> = SHIPPED.iter().map(|(name, _)| *name).collect();
    ConfigError::UnknownName { kind: "scene", name: name.to_owned(), known: names.join(", ") }
}

/// Puts every world on each of these scenes, which are names or files; returns the layer of the files' scenes, each by
/// the name of its file.
pub(super) fn place(
    scenes: &[String],
    worlds: &mut Vec<WorldName>,
    catalogue: &Catalogue,
) -> Result<Layer, ConfigError> {
    let mut placed = Vec::new();
    let mut sections = Table::new();
    for world in &*worlds {
        for scene in scenes {
            let path = Path::new(scene);
            let is_file = shipped(scene).is_none() && path.extension().is_some();
            let name =
                if is_file { path.file_stem().and_then(OsStr::to_str) } else { Some(&**scene) };
            let on = name.ok_or_else(|| unknown(scene)).and_then(|name| {
                world.on(name).map_err(|error| ConfigError::Conflict(error.to_string()))
            })?;
            if is_file {
                let text = read_text(path)
                    .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
                if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("csv")) {
                    let constants = (catalogue.world(world)?.of_model)(&text).map_err(|why| {
                        let message = format!("{world} cannot be played here: {why}");
                        ConfigError::Syntax { origin: scene.clone(), message }
                    })?;
                    sections.insert(on.to_string(), constants.into());
                    placed.push(on);
                    continue;
                }
                let of_file = Scene::parse(scene, &text)?;
                of_file.check(catalogue)?;
                let (map, mut constants) = of_file.constants(catalogue.world(world)?)?;
                constants.extend(map);
                sections.insert(on.to_string(), constants.into());
            }
            placed.push(on);
        }
    }
    *worlds = placed;
    Ok(Layer::new("--scene", Table::from_iter([("env".to_owned(), sections.into())])))
}
