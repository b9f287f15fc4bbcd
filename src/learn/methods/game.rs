//! The method `game`: Algorithm 1 of the paper. The two players are updated in turn, each on a fresh
//! rollout. At eta = 1 there is no antagonist, and every turn is the protagonist's.

use crate::game::budget::Eta;
use crate::learn::budget_sensitivity::{LARGEST, LARGEST_IN_JOINT, charge_both};
use crate::learn::family;
use crate::learn::head::HeadOf;
use crate::learn::inputs::Inputs;
use crate::learn::method::{
    Arena, Method, Metric, Players, Progress, Setting, TrainError, Training,
};
use crate::learn::options::{Acts, Adversary, Credit, MOST_UPDATES, Role, TrainOptions};
use crate::learn::pair::Pair;
use crate::learn::policy::Mode;
use crate::learn::ppo::{Losses, Signal};
use crate::learn::price;
use crate::learn::rollout::{Collector, Terms};
use crate::learn::schedule::{Turn, roles, schedule};
use crate::learn::state::{TrainingState, Unfit};
use crate::learn::vector_game::Spending;
use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use lava_envs::{Action, End};

/// The method `game`.
#[derive(Debug, Clone, Copy)]
pub struct Game;

impl Method for Game {
    const NAME: &'static str = "game";

    const METRICS: &'static [Metric] = &[
        Metric { column: "budget", tag: "charts/budget" },
        Metric { column: "mean_return", tag: "charts/episodic_return" },
        Metric { column: "mean_length", tag: "charts/episodic_length" },
        Metric { column: "goal", tag: "charts/goal" },
        Metric { column: "lava", tag: "charts/lava" },
        Metric { column: "learning_rate", tag: "charts/learning_rate" },
        Metric { column: "policy_loss", tag: "losses/policy_loss" },
        Metric { column: "value_loss", tag: "losses/value_loss" },
        Metric { column: "entropy", tag: "losses/entropy" },
        Metric { column: "approx_kl", tag: "losses/approx_kl" },
        Metric { column: "clip_fraction", tag: "losses/clipfrac" },
        Metric { column: "gradient_norm", tag: "losses/gradient_norm" },
        Metric { column: "explained_variance", tag: "losses/explained_variance" },
        Metric { column: "budget_use", tag: "charts/budget_use" },
    ];

    fn check<W: Arena>(options: &TrainOptions, _: &toml::Table) -> Result<(), String> {
        if options.credit == Credit::Executed && !W::OUTCOMES_ARE_ACTIONS {
            return Err(format!(
                "train.credit = \"executed\" needs a world in which chance decides an action, which \
                 {0} is not; set it only for the other worlds, by env.WORLD.train.credit",
                W::NAME
            ));
        }
        if options.antagonist_acts == Acts::Joint {
            if options.credit != Credit::Chosen {
                return Err("train.antagonist_acts = \"joint\" reweights the chosen action; use \
                            train.credit = \"chosen\""
                    .to_owned());
            }
            if options.adversary != Adversary::Learned {
                return Err(
                    "train.antagonist_acts = \"joint\" takes the protagonist's advantages from \
                            the antagonist that learns; use train.adversary = \"learned\""
                        .to_owned(),
                );
            }
        }
        <W::Action as Action>::Kind::check(options)?;
        family::family_within_budget::<W::Law>(&options.family).map(|_| ())
    }

    fn check_schedule(options: &TrainOptions, eta: Eta) -> Result<(), String> {
        let updates = options.updates();
        let trains =
            |updates: u64| roles(options, eta, updates).any(|(role, _)| role == Role::Protagonist);
        if trains(updates) {
            return Ok(());
        }
        // More updates never train it less.
        let (mut too_few, mut enough) = (updates, MOST_UPDATES);
        if !trains(enough) {
            return Err(format!(
                "at eta = {eta} the protagonist is never updated: all updates are the antagonist's \
                 response, train.response = {}; lower it",
                options.response
            ));
        }
        while enough - too_few > 1 {
            let middle = too_few + (enough - too_few) / 2;
            *(if trains(middle) { &mut enough } else { &mut too_few }) = middle;
        }
        let (steps, update) = (options.steps, options.rollout());
        Err(format!(
            "with train.steps = {steps} the protagonist is never updated at eta = {eta}: an update takes \
             {update} steps, and the antagonist is updated first; use at least {}",
            enough * update
        ))
    }

    fn begin<'a, W: Arena>(world: W, setting: &'a Setting<'a>) -> Box<dyn Training<W> + 'a> {
        Box::new(GameTraining::new(world, setting))
    }

    fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Box<dyn Players<W>> {
        Box::new(Pair::new(world, setting))
    }
}

/// Training of a pair, update by update.
pub struct GameTraining<'a, W: Arena> {
    setting: Setting<'a>,
    turns: Vec<Turn>,
    /// Updates done.
    done: usize,
    /// The players.
    pub pair: Pair<W>,
    collector: Collector<W>,
    minibatches: ChaCha8Rng,
}

impl<'a, W: Arena> GameTraining<'a, W> {
    /// Training from its beginning, on `world`, whose slots are the parallel episodes.
    pub fn new(world: W, setting: &Setting<'a>) -> Self {
        GameTraining {
            turns: schedule(setting.options, setting.eta),
            done: 0,
            pair: Pair::new(&world, setting),
            collector: Collector::new(world, setting),
            minibatches: stream(setting.seed, Purpose::Minibatches, 0),
            setting: setting.clone(),
        }
    }

    /// The same, with budgets for this.
    #[must_use]
    pub fn spending(self, spending: Spending) -> Self {
        let (pair, collector) = (self.pair.spending(spending), self.collector.spending(spending));
        GameTraining { pair, collector, ..self }
    }

    /// A rollout and the update of one player on it.
    fn turn(&mut self, turn: &Turn) -> Losses {
        let Setting { gamma, options, .. } = self.setting;
        // A budget of single steps is the same after whatever was spent.
        let charged = options.budget_sensitivity && self.pair.spending == Spending::Trajectory;
        let GameTraining { pair, collector, minibatches, .. } = self;
        collector.collect(
            pair,
            Terms { eta: turn.budget, mode: turn.mode, exploring: turn.exploring },
            options,
        );
        match (turn.role, &mut pair.antagonist, &mut pair.action_antagonist) {
            (Role::Antagonist, Some(outcomes), Some(draws)) if turn.mode == Mode::Sampled => {
                let (drawn, played) = (&collector.action_antagonist, &collector.antagonist);
                let (its, rates, observation) = (&options.antagonist, turn.rates, pair.observation);
                let mut by_draws = draws.estimates(drawn, gamma, its).advantages;
                let mut by_outcomes = outcomes.estimates(played, gamma, its).advantages;
                if charged {
                    let more =
                        |inputs: &mut Inputs, by| observation.with_more_budget::<W>(inputs, by);
                    let of_outcomes = outcomes.budget_sensitivity(played, &more, LARGEST_IN_JOINT);
                    let more = |inputs: &mut Inputs, by| {
                        observation.with_more_budget_at_draw::<W>(inputs, by);
                    };
                    let of_draws = draws.budget_sensitivity(drawn, &more, LARGEST_IN_JOINT);
                    charge_both(
                        (&of_draws, &mut by_draws),
                        (&of_outcomes, &mut by_outcomes),
                        &played.ended,
                        gamma,
                    );
                }
                let signal = Signal::Given(&by_draws);
                let of_draws = draws.update(drawn, signal, gamma, its, rates, minibatches);
                let signal = Signal::Given(&by_outcomes);
                let of_outcomes = outcomes.update(played, signal, gamma, its, rates, minibatches);
                Losses::mean([of_draws, of_outcomes])
            }
            (Role::Antagonist, Some(antagonist), _) => {
                let played = &collector.antagonist;
                let observation = pair.observation;
                let more = |inputs: &mut Inputs, by| observation.with_more_budget::<W>(inputs, by);
                let sensitivity =
                    charged.then(|| antagonist.budget_sensitivity(played, &more, LARGEST));
                let signal = sensitivity.as_ref().map_or(Signal::Own, Signal::Charged);
                let its = &options.antagonist;
                antagonist.update(played, signal, gamma, its, turn.rates, minibatches)
            }
            (_, _, draws) => {
                let (played, its) = (&collector.protagonist, &options.protagonist);
                let drawn = &collector.action_antagonist;
                let priced = draws.as_ref().filter(|_| !drawn.choices.is_empty()).map(|draws| {
                    price::advantages(
                        &draws.estimates(drawn, gamma, &options.antagonist),
                        &draws.ratios(drawn),
                        &collector.before,
                        price::value_at_risk(&collector.weighted, turn.budget),
                    )
                });
                let signal = priced.as_deref().map_or(Signal::Own, Signal::Uncentred);
                pair.protagonist.update(played, signal, gamma, its, turn.rates, minibatches)
            }
        }
    }

    /// The first quantity of a player that is not a finite number after its update.
    fn not_finite(&self, role: Role, losses: &Losses) -> Option<&'static str> {
        losses.not_finite().or_else(|| match (role, &self.pair.antagonist) {
            (Role::Antagonist, Some(antagonist)) => antagonist
                .not_finite()
                .or_else(|| self.pair.action_antagonist.as_ref().and_then(|of| of.not_finite())),
            _ => self.pair.protagonist.not_finite(),
        })
    }

    /// All that the later updates depend on.
    pub fn state(&self) -> TrainingState<W::Snapshot> {
        TrainingState {
            update: self.updates(),
            minibatches: position(&self.minibatches),
            protagonist: self.pair.protagonist.state(),
            antagonist: self.pair.antagonist.as_ref().map(|antagonist| antagonist.state()),
            action_antagonist: self.pair.action_antagonist.as_ref().map(|of| of.state()),
            games: self.collector.state(),
        }
    }

    /// Continues from a state of training with the same setting.
    ///
    /// # Errors
    /// If the state is of another setting; part of it may be in place then.
    pub fn restore(&mut self, state: TrainingState<W::Snapshot>) -> Result<(), Unfit> {
        let done = usize::try_from(state.update).ok().filter(|&done| done <= self.turns.len());
        let done = done.ok_or(Unfit("the schedule's"))?;
        self.pair.protagonist.restore(state.protagonist)?;
        match (&mut self.pair.antagonist, state.antagonist) {
            (Some(antagonist), Some(state)) => antagonist.restore(state)?,
            (None, None) => {}
            _ => return Err(Unfit("a player's")),
        }
        match (&mut self.pair.action_antagonist, state.action_antagonist) {
            (Some(antagonist), Some(state)) => antagonist.restore(state)?,
            (None, None) => {}
            _ => return Err(Unfit("a player's")),
        }
        let seed = self.setting.seed;
        self.collector.restore(&state.games, seed)?;
        self.minibatches = stream_from(seed, Purpose::Minibatches, 0, state.minibatches);
        self.done = done;
        Ok(())
    }
}

impl<W: Arena> Training<W> for GameTraining<'_, W> {
    fn update(&mut self) -> Result<Option<Progress>, TrainError> {
        let Some(&turn) = self.turns.get(self.done) else { return Ok(None) };
        let losses = self.turn(&turn);
        let (update, player) = (turn.update, turn.role.name());
        if let Some(quantity) = self.not_finite(turn.role, &losses) {
            return Err(TrainError::NotFinite { update, player, quantity });
        }
        self.done += 1;
        let collector = &self.collector;
        let mean_return = collector.mean_return();
        let values = vec![
            turn.budget.get(),
            mean_return,
            collector.mean_length(),
            collector.share(End::Goal),
            collector.share(End::Lava),
            turn.rates.learning_rate,
            losses.policy_loss,
            losses.value_loss,
            losses.entropy,
            losses.approx_kl,
            losses.clip_fraction,
            losses.gradient_norm,
            losses.explained_variance,
            collector.budget_use,
        ];
        Ok(Some(Progress { update, steps: self.steps(), player, mean_return, values }))
    }

    fn updates(&self) -> u64 {
        self.done as u64
    }

    fn steps(&self) -> u64 {
        self.updates() * self.setting.options.rollout()
    }

    fn state(&self) -> Vec<u8> {
        postcard::to_allocvec(&GameTraining::state(self)).expect("memory takes every byte")
    }

    fn restore(&mut self, state: &[u8]) -> Result<(), Unfit> {
        match postcard::take_from_bytes(state) {
            Ok((state, [])) => GameTraining::restore(self, state),
            _ => Err(Unfit("the method's")),
        }
    }

    fn players(&self) -> &dyn Players<W> {
        &self.pair
    }
}
