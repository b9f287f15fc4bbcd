//! Names of worlds, methods, variants and runs, in configurations, folders and tables.

use crate::game::budget::Eta;
use lava_envs::World;
use serde::{Deserialize, Serialize};
use std::borrow::{Borrow, Cow};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The most characters of a name.
const LONGEST: usize = 100;

/// A text that cannot be a name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} cannot be a name; use up to {LONGEST} letters, digits and the characters - . _ +, with a \
     letter or digit first, and not eta- or seed- at the beginning"
)]
pub struct NotAName(String);

/// A name becomes a folder. Without a separator and with a letter or digit first it stays inside the
/// folder above it; `eta-` and `seed-` begin the folders of budgets and seeds.
fn checked(name: &str) -> Result<(), NotAName> {
    let fits = name.len() <= LONGEST
        && name.starts_with(|first: char| first.is_ascii_alphanumeric())
        && name.chars().all(|of| of.is_ascii_alphanumeric() || "-._+".contains(of))
        && !["eta-", "seed-"].iter().any(|prefix| name.starts_with(prefix));
    if fits { Ok(()) } else { Err(NotAName(name.chars().take(LONGEST).collect())) }
}

/// The name of a world without its scene.
pub fn base_of(world: &str) -> &str {
    world.split_once('/').map_or(world, |(base, _)| base)
}

/// The name of a world's folder and files: `lava-grid+detour` for `lava-grid/detour`.
pub fn as_file(world: &str) -> String {
    world.replace('/', "+")
}

/// The name of a world by that of its folder.
pub fn of_file(name: &str) -> String {
    name.replace('+', "/")
}

/// A world's name, and that of its scene after a `/`. In a folder's name that is a `+`.
fn checked_world(name: &str) -> Result<(), NotAName> {
    match name.split_once('/') {
        None => checked(name),
        Some((base, scene)) => checked(base).and_then(|()| checked(scene)),
    }
    .map_err(|_| NotAName(name.chars().take(LONGEST).collect()))
}

macro_rules! name {
    ($(#[$about:meta])* $name:ident, $checked:ident) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(Cow<'static, str>);

        impl $name {
            /// The name as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }

        impl FromStr for $name {
            type Err = NotAName;

            fn from_str(text: &str) -> Result<Self, NotAName> {
                $checked(text).map(|()| $name(text.to_owned().into()))
            }
        }

        impl TryFrom<String> for $name {
            type Error = NotAName;

            fn try_from(text: String) -> Result<Self, NotAName> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(name: $name) -> String {
                name.0.into_owned()
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl AsRef<str> for $name {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl PartialEq<str> for $name {
            fn eq(&self, other: &str) -> bool {
                self.as_str() == other
            }
        }

        impl PartialEq<&str> for $name {
            fn eq(&self, other: &&str) -> bool {
                self.as_str() == *other
            }
        }
    };
}

name! {
    /// The name of a world: `lava-grid`, or on a scene: `lava-grid/detour`.
    WorldName, checked_world
}

name! {
    /// The name of a method of training: `game`.
    MethodName, checked
}

name! {
    /// The name of a variant of an experiment, which differs from it in some options: `k-1`.
    VariantName, checked
}

impl WorldName {
    /// The name of a world of this program.
    pub const fn of<W: World>() -> WorldName {
        WorldName(Cow::Borrowed(W::NAME))
    }

    /// The world's name without its scene.
    pub fn base(&self) -> &str {
        base_of(&self.0)
    }

    /// The name of its scene, if it is not the world's own.
    pub fn scene(&self) -> Option<&str> {
        self.0.split_once('/').map(|(_, scene)| scene)
    }

    /// The same world on a scene.
    ///
    /// # Errors
    /// If that is no name.
    pub fn on(&self, scene: &str) -> Result<WorldName, NotAName> {
        format!("{}/{scene}", self.base()).parse()
    }

    /// The name of its folder and files: `lava-grid+detour`.
    pub fn as_file(&self) -> String {
        as_file(&self.0)
    }
}

impl MethodName {
    /// Algorithm 1 of the paper, the method of all runs of former versions.
    pub const GAME: MethodName = MethodName(Cow::Borrowed("game"));

    /// The method of a `config.toml` of a former version, which has no such key.
    pub(super) fn game() -> MethodName {
        MethodName::GAME
    }
}

/// Names one run of a sweep: `lava-grid/game/eta-25/seed-3`, and with a variant
/// `lava-grid/game/k-1/eta-25/seed-3`, with a scene `lava-grid+detour/game/eta-25/seed-3`.
#[derive(Debug, Clone, PartialEq)]
pub struct RunId {
    /// World.
    pub world: WorldName,
    /// Method of training.
    pub method: MethodName,
    /// Variant, where the experiment has variants.
    pub variant: Option<VariantName>,
    /// Budget.
    pub eta: Eta,
    /// Seed.
    pub seed: u64,
}

impl RunId {
    /// The run's folder in an output folder. Made of checked names and two numbers, it is always
    /// inside that folder.
    pub fn folder(&self, out: &Path) -> PathBuf {
        let folder = out.join(self.to_string());
        // A folder that a former version began keeps its place.
        match self.former_name().map(|name| out.join(name)) {
            Some(former) if former.is_dir() && !folder.is_dir() => former,
            _ => folder,
        }
    }

    /// The name that former versions gave the run, `lava-grid/eta-25/seed-3`; they had one method and
    /// no variants.
    pub fn former_name(&self) -> Option<String> {
        let RunId { world, method, variant, eta, seed } = self;
        let known = *method == MethodName::GAME && variant.is_none();
        let known = known && world.scene().is_none();
        known.then(|| format!("{world}/eta-{eta}/seed-{seed}"))
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let RunId { world, method, variant, eta, seed } = self;
        let world = world.as_file();
        f.pad(&match variant {
            None => format!("{world}/{method}/eta-{eta}/seed-{seed}"),
            Some(variant) => format!("{world}/{method}/{variant}/eta-{eta}/seed-{seed}"),
        })
    }
}

/// A text that is not the name of a run.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} names no run; runs are named like lava-grid/game/eta-25/seed-3")]
pub struct NotARun(String);

/// Reads the names that [`RunId`] displays, and [`RunId::former_name`].
impl FromStr for RunId {
    type Err = NotARun;

    fn from_str(text: &str) -> Result<Self, NotARun> {
        let parse = || {
            let parts: Vec<&str> = text.split('/').collect();
            let (world, method, variant, [eta, seed]) = match parts[..] {
                [world, eta, seed] => (world, None, None, [eta, seed]),
                [world, method, eta, seed] => (world, Some(method), None, [eta, seed]),
                [world, method, variant, eta, seed] => {
                    (world, Some(method), Some(variant), [eta, seed])
                }
                _ => return None,
            };
            let id = RunId {
                world: of_file(world).parse().ok()?,
                method: method.map_or(Ok(MethodName::GAME), str::parse).ok()?,
                variant: variant.map(str::parse).transpose().ok()?,
                eta: eta.strip_prefix("eta-")?.parse().ok()?,
                seed: seed.strip_prefix("seed-")?.parse().ok()?,
            };
            // A run has one name: `eta-25.0` and `seed-03` are not accepted.
            let name = if method.is_some() { Some(id.to_string()) } else { id.former_name() };
            (name.as_deref() == Some(text)).then_some(id)
        };
        parse().ok_or_else(|| NotARun(text.to_owned()))
    }
}
