//! What a protagonist chooses.

use rand::{Rng, RngExt};
use std::fmt::Debug;

/// The kind of actions that are finitely many.
#[derive(Debug, Clone, Copy)]
pub enum Finite {}

/// The kind of actions that are pushes in the plane.
#[derive(Debug, Clone, Copy)]
pub enum Plane {}

/// An action of a protagonist.
pub trait Action: Copy + Debug + PartialEq + Send + Sync + 'static {
    /// The kind of the action, [`Finite`] or [`Plane`], which decides the policies that fit.
    type Kind;

    /// A uniformly random action.
    fn uniform(random: &mut impl Rng) -> Self;
}

/// An action out of finitely many.
pub trait Discrete: Action {
    /// Number of actions.
    const COUNT: usize;

    /// Position of the action, below [`Discrete::COUNT`].
    fn index(self) -> usize;

    /// The action of an index.
    ///
    /// # Panics
    /// If the index is not below [`Discrete::COUNT`].
    fn from_index(index: usize) -> Self;
}

/// A uniformly random action out of finitely many, for [`Action::uniform`].
pub fn uniform_index<A: Discrete>(random: &mut impl Rng) -> A {
    A::from_index(random.random_range(0..A::COUNT))
}
