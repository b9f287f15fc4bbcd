//! A world with the heads of its two players.

use crate::head::{CategoricalPolicy, GaussianPolicy, Policy};
use cvar_game::game::finite::FiniteFamily;
use cvar_game::game::gaussian::GaussianFamily;
use cvar_game::game::perturbation::Family;
use cvar_game::options::TrainOptions;
use lava_envs::{LavaGrid, LavaPoint, Law, Move, World};

/// What the game needs to know of a world beside its dynamics.
pub trait Arena: World {
    /// The protagonist's head.
    type Policy: Policy<Choice = Self::Action>;
    /// The antagonist's perturbations.
    type Family: Family<Law = Self::Law>;

    /// The protagonist's head with these options.
    fn policy(options: &TrainOptions) -> Self::Policy;

    /// The antagonist's family with these options.
    fn family(options: &TrainOptions) -> Self::Family;

    /// The action that the outcome amounts to, where outcomes are executed actions.
    fn executed(outcome: <Self::Law as Law>::Outcome) -> Option<Self::Action>;
}

impl Arena for LavaGrid {
    type Policy = CategoricalPolicy;
    type Family = FiniteFamily;

    fn policy(_: &TrainOptions) -> CategoricalPolicy {
        CategoricalPolicy
    }

    fn family(_: &TrainOptions) -> FiniteFamily {
        FiniteFamily
    }

    fn executed(outcome: usize) -> Option<Move> {
        Some(Move::ALL[outcome])
    }
}

impl Arena for LavaPoint {
    type Policy = GaussianPolicy;
    type Family = GaussianFamily;

    fn policy(options: &TrainOptions) -> GaussianPolicy {
        GaussianPolicy { initial_std: options.initial_std }
    }

    fn family(options: &TrainOptions) -> GaussianFamily {
        GaussianFamily {
            bumps: options.bump.count,
            center_bound: options.bump.center,
            curvature_bound: options.bump.curvature,
        }
    }

    fn executed(_: nalgebra::Vector2<f64>) -> Option<lava_envs::Force> {
        None
    }
}
