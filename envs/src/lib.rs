//! Worlds in which chance is explicit: two with lava, and any finite Markov decision process.
//!
//! A step of every [`World`] has two halves. [`World::law`] gives the nominal law P_t of what
//! chance may decide after the protagonist has chosen its action; [`World::apply`] carries out one
//! realised outcome o_t. The antagonist of the game reweights chance between the two. The worlds know nothing of learning.

pub mod action;
pub mod conformance;
pub mod error;
pub mod finite;
pub mod grid;
pub mod law;
pub mod map;
pub mod point;
pub mod random;
pub mod scene;
pub mod table;
pub mod world;

pub use action::{Action, Discrete};
pub use error::{ConfigError, NoSuchState};
pub use finite::FiniteModel;
pub use grid::{GridConfig, LavaGrid, Move};
pub use law::{FiniteLaw, GaussianLaw, Law};
pub use point::{Force, LavaPoint, PointConfig};
pub use scene::{Area, AreaKind, Field, Scene};
pub use table::{Table, TableConfig};
pub use world::{End, Outcome, Step, World};
