//! Worlds that can be trained in.

use super::family::Perturbed;
use super::head::HeadOf;
use lava_envs::World;
use lava_envs::action::{Action, ActionKind};

/// A world that can be trained in: its actions have a policy, its law of chance has a family of
/// perturbations. Every world is one whose action and law are of a known kind.
pub trait Arena:
    World<
        Action: Action<Kind: HeadOf<<Self as World>::Action> + ActionKind<Noise: Perturbed>>,
        Law: Perturbed,
    >
{
}

impl<W> Arena for W where
    W: World<
            Action: Action<Kind: HeadOf<<W as World>::Action> + ActionKind<Noise: Perturbed>>,
            Law: Perturbed,
        >
{
}
