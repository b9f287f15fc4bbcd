//! Two worlds with lava in which chance is explicit.
//!
//! A step of every [`World`] has two halves. [`World::law`] answers with the nominal law P_t of what
//! chance may decide once the protagonist has chosen its action; [`World::apply`] carries out one
//! realised outcome o_t. Whoever wants to reweight chance (the antagonist of the game) stands
//! between the two. The worlds know nothing of learning.

pub mod error;
pub mod grid;
pub mod law;
pub mod map;
pub mod point;
pub mod random;
pub mod world;

pub use error::{ConfigError, NoSuchState};
pub use grid::{GridConfig, LavaGrid, Move};
pub use law::{FiniteLaw, GaussianLaw, Law};
pub use point::{Force, LavaPoint, PointConfig};
pub use world::{End, Step, World};
