//! Who decides in a game, as evaluation and yardsticks see it: a [`Policy`] chooses actions, an
//! [`Opponent`] reweights chance. Both act on a whole batch at a time. The players of every method, and
//! players of your own, implement these two traits.

use crate::game::budget::Budget;
use lava_envs::action::ActionKind;
use lava_envs::random::ChaCha8Rng;
use lava_envs::{Action, Law, Outcome, World};
use serde::{Deserialize, Serialize};

/// How a protagonist picks its action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// The mode of its policy.
    Greedy,
    /// A draw from its policy.
    Sampled,
}

/// The law that outcomes are drawn from when an opponent responds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Draw {
    /// The perturbed law P_t delta_t.
    Perturbed,
    /// The nominal law P_t; the likelihood ratios are still the opponent's, so that nominal episodes
    /// can be weighted by prod delta.
    Nominal,
}

/// The random streams of one slot.
#[derive(Debug)]
pub struct Streams {
    /// For the protagonist's draws.
    pub actions: ChaCha8Rng,
    /// For the outcomes of chance.
    pub outcomes: ChaCha8Rng,
}

/// The law of the noise behind a policy's draws in a world.
pub type Noise<W> = <<<W as World>::Action as Action>::Kind as ActionKind>::Noise;

/// A protagonist.
pub trait Policy<W: World> {
    /// Chooses an action in every slot of `world`; `streams` and `actions` have an entry per slot.
    fn choose(
        &mut self,
        world: &W,
        mode: Mode,
        streams: &mut [Streams],
        actions: &mut Vec<W::Action>,
    );

    /// The probability of each action in every slot of `world`, shape `[slots, actions]`, where
    /// actions are finitely many. Exact yardsticks need it.
    fn probabilities(&mut self, world: &W) -> Option<Vec<f64>>;

    /// Whether the policy depends on the time.
    fn sees_time(&self) -> bool;

    /// The policy's draw, where an opponent can reweight it.
    fn draws(&mut self) -> Option<&mut dyn Draws<W>> {
        None
    }
}

/// A policy's draw: noise of a known law, and a map from the noise to an action.
pub trait Draws<W: World> {
    /// Appends the law of the noise in every slot of `world`.
    fn laws(&mut self, world: &W, laws: &mut Vec<Noise<W>>);

    /// Appends the action that the noise means in every slot, where [`Draws::laws`] was asked last.
    fn realise(&mut self, noise: &[<Noise<W> as Law>::Outcome], actions: &mut Vec<W::Action>);
}

/// What an opponent knows when it responds; slices have an entry per slot.
#[derive(Debug)]
pub struct Situation<'a, W: World> {
    /// The world, before the step.
    pub world: &'a W,
    /// The chosen actions.
    pub actions: &'a [W::Action],
    /// The nominal laws P_t.
    pub laws: &'a [W::Law],
    /// The remaining budgets eta_t; where the action was drawn by the opponent as well, what is left of
    /// them after that.
    pub budgets: &'a [Budget],
}

/// What an opponent of the protagonist's draw knows before the action; slices have an entry per slot.
#[derive(Debug)]
pub struct DrawSituation<'a, W: World> {
    /// The world, before the step.
    pub world: &'a W,
    /// The laws of the noise.
    pub laws: &'a [Noise<W>],
    /// The remaining budgets eta_t.
    pub budgets: &'a [Budget],
}

/// What an opponent of the protagonist's draw decides; an entry per slot.
#[derive(Debug)]
pub struct DrawResponse<'a, W: World> {
    /// The realised noise, appended slot by slot to an empty list.
    pub noise: &'a mut Vec<<Noise<W> as Law>::Outcome>,
    /// Its likelihood ratios delta_A.
    pub ratios: &'a mut [f64],
}

/// What an opponent decides; an entry per slot.
#[derive(Debug)]
pub struct Response<'a, W: World> {
    /// The realised outcomes o_t, appended slot by slot to an empty list.
    pub outcomes: &'a mut Vec<Outcome<W>>,
    /// Their likelihood ratios delta_t(o_t).
    pub ratios: &'a mut [f64],
}

/// An antagonist, or chance itself.
pub trait Opponent<W: World> {
    /// Draws the outcome of every slot and reports its likelihood ratio.
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    );

    /// The likelihood ratios delta_t of all outcomes in every slot, shape `[slots, outcomes]`, where outcomes
    /// are finitely many and the ratios follow from the situation. Best responses need them.
    fn all_ratios(&mut self, situation: &Situation<'_, W>) -> Option<Vec<f64>> {
        let _ = situation;
        None
    }

    /// Whether its ratios depend on the time.
    fn sees_time(&self) -> bool {
        true
    }

    /// The opponent as one of the protagonist's draw, where it is one: the game `joint`.
    fn of_draws(&mut self) -> Option<&mut dyn DrawOpponent<W>> {
        None
    }

    /// max |`E_P[delta_t]` - 1| over all perturbations so far, for the budget audit.
    fn normalisation_error(&self) -> f64 {
        0.0
    }
}

/// The half of an opponent that reweights the protagonist's draw, before the action.
pub trait DrawOpponent<W: World> {
    /// Draws the noise of every slot, from the streams of the actions, and reports its likelihood ratio.
    fn respond_to_draw(
        &mut self,
        situation: &DrawSituation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: DrawResponse<'_, W>,
    );
}

/// Chance as it is: every likelihood ratio is 1.
#[derive(Debug, Clone, Copy, Default)]
pub struct Nominal;

impl<W: World> Opponent<W> for Nominal {
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        _: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    ) {
        let draws = situation.laws.iter().zip(streams);
        response.outcomes.extend(draws.map(|(law, streams)| law.sample(&mut streams.outcomes)));
        response.ratios.fill(1.0);
    }
}
