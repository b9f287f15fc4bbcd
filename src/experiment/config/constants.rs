//! The constants of a world, as configurations have them.

use super::catalogue::constants_of;
use super::{Catalogue, ConfigError};
use crate::experiment::names::WorldName;
use lava_envs::World;
use serde::de::{Deserializer, Error, MapAccess, Visitor};
use serde::ser::{SerializeMap, Serializer};
use serde::{Deserialize, Serialize};
use toml::Table;

/// The constants of a world by their names. Reading them from a file does not check them;
/// [`WorldConstants::of`] does that.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldConstants {
    /// The world.
    pub world: WorldName,
    /// Its constants, in the order of their type where they were checked.
    pub table: Table,
}

impl WorldConstants {
    /// The constants of the world `W`, checked.
    ///
    /// # Errors
    /// If these are another world's, or the world refuses them.
    pub fn of<W: World>(&self) -> Result<W::Constants, ConfigError> {
        if self.world.base() != W::NAME {
            return Err(self.refused(format!("{} was expected", W::NAME)));
        }
        constants_of::<W>(self.table.clone()).map_err(|message| self.refused(message))
    }

    /// The same constants, checked by the catalogue's entry of their world.
    pub(super) fn checked(self, catalogue: &Catalogue) -> Result<WorldConstants, ConfigError> {
        let world = catalogue.world(&self.world)?;
        match (world.check)(self.table.clone()) {
            Ok(table) => Ok(WorldConstants { table, ..self }),
            Err(message) => Err(self.refused(message)),
        }
    }

    fn refused(&self, message: String) -> ConfigError {
        ConfigError::World { world: self.world.clone(), message }
    }
}

/// As a section of the world's name: `[env.lava-grid]`.
impl Serialize for WorldConstants {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(1))?;
        map.serialize_entry(&self.world, &self.table)?;
        map.end()
    }
}

impl<'de> Deserialize<'de> for WorldConstants {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct OneWorld;
        impl<'de> Visitor<'de> for OneWorld {
            type Value = WorldConstants;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a section [env.WORLD] of one world")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<WorldConstants, A::Error> {
                let Some((world, table)) = map.next_entry()? else {
                    return Err(A::Error::invalid_length(0, &self));
                };
                if map.next_key::<String>()?.is_some() {
                    return Err(A::Error::invalid_length(2, &self));
                }
                Ok(WorldConstants { world, table })
            }
        }
        deserializer.deserialize_map(OneWorld)
    }
}
