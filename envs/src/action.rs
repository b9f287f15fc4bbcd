//! What a protagonist chooses.

use crate::law::{FiniteLaw, GaussianLaw, Law};
use rand::{Rng, RngExt};
use std::fmt::Debug;

/// A kind of actions.
pub trait ActionKind {
    /// The nominal law of the noise behind a policy's draw, of which the action is a map.
    type Noise: Law;
}

/// The kind of actions that are `N`. The noise of a draw is the index of the action.
#[derive(Debug, Clone, Copy)]
pub enum Finite<const N: usize> {}

impl<const N: usize> ActionKind for Finite<N> {
    type Noise = FiniteLaw<N>;
}

/// The kind of actions that are pushes in the plane.
#[derive(Debug, Clone, Copy)]
pub enum Plane {}

impl ActionKind for Plane {
    type Noise = GaussianLaw;
}

/// An action of a protagonist.
pub trait Action: Copy + Debug + PartialEq + Send + Sync + 'static {
    /// The kind of the action, [`Finite`] or [`Plane`], which decides the policies that fit.
    type Kind: ActionKind;

    /// A uniformly random action.
    fn uniform(random: &mut impl Rng) -> Self;
}

/// An action out of finitely many.
pub trait Discrete: Action {
    /// Number of actions, that of the kind.
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
