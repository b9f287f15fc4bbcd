//! A protagonist that trains without an antagonist: rollouts under nominal chance, each followed by a PPO update
//! towards an [`Objective`]. Methods that aim at the CVaR of the return by its law alone are such objectives.
//!
//! They share the schedule of the budget with the game: where the game has eta_t, they have the risk level 1/eta_t.
//! It falls from 1 to alpha, the soft risk of Greenberg and others (NeurIPS 2022), without which a method that looks
//! at the tail of a beginner's returns does not see success.

use super::head::HeadOf;
use super::method::{Arena, Metric, Players, Progress, Setting, TrainError, Training};
use super::options::{Credit, TrainOptions};
use super::pair::Pair;
use super::ppo::{Losses, Signal};
use super::rollout::{Collector, Terms};
use super::schedule::{self, Turn};
use super::state::{GamesState, PlayerState, Unfit};
use crate::game::budget::Eta;
use crate::game::returns::{Atom, ReturnSoFar};
use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use lava_envs::{Action, End, World};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// What a rollout tells of the returns. Time-major: index `t * slots + slot`.
pub struct Returns<'a> {
    /// Risk level of this update.
    pub alpha: f64,
    /// Discount factor.
    pub gamma: f64,
    /// Number of slots.
    pub slots: usize,
    /// The return of each slot's episode before each step, `[steps, slots]`; `None` in one that started anywhere.
    pub before: &'a [Option<ReturnSoFar>],
    /// Whether the episode ended with this step, `[steps, slots]`.
    pub ended: &'a [bool],
    /// The episodes that ended in the rollout.
    pub finished: &'a [Atom],
}

impl Returns<'_> {
    /// `VaR_alpha` of the episodes that ended: the lower quantile. `None` if none did.
    pub fn value_at_risk(&self) -> Option<f64> {
        let mut values: Vec<f64> = self.finished.iter().map(|episode| episode.value).collect();
        let rank = (self.alpha * values.len() as f64).ceil() as usize;
        let last = values.len().checked_sub(1)?;
        let at = rank.saturating_sub(1).min(last);
        Some(*values.select_nth_unstable_by(at, f64::total_cmp).1)
    }

    /// The return of a step's episode after it.
    pub fn after(&self, before: &ReturnSoFar, reward: f32) -> ReturnSoFar {
        let mut after = *before;
        after.add(reward.into(), self.gamma);
        after
    }
}

/// What a protagonist maximises.
pub trait Objective: Clone + Serialize + DeserializeOwned + Send {
    /// The objective at the beginning of training.
    fn new(own: &toml::Table) -> Self;

    /// Replaces the rewards of a rollout, `[steps, slots]`, by those that the critic and the advantages shall be
    /// of; or answers with what the choices are reinforced by instead of advantages, `[steps, slots]`.
    fn judge(&mut self, returns: &Returns<'_>, rewards: &mut [f32]) -> Option<Vec<f32>>;

    /// The level of the return that it looks at, for the progress; NaN if there is none.
    fn threshold(&self) -> f64 {
        f64::NAN
    }
}

/// What training reports.
pub const METRICS: &[Metric] = &[
    Metric { column: "budget", tag: "charts/budget" },
    Metric { column: "threshold", tag: "charts/threshold" },
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
];

/// Checks that such a method can train in a world with these options.
///
/// # Errors
/// If one does not fit; the error says in one line why and what to do.
pub fn check<W: Arena>(options: &TrainOptions) -> Result<(), String> {
    if options.credit != Credit::Chosen {
        return Err(
            "this method credits the action that was chosen; use train.credit = \"chosen\""
                .to_owned(),
        );
    }
    <W::Action as Action>::Kind::check(options)
}

/// The players of such a method: a pair without an antagonist.
pub fn players<W: Arena>(world: &W, setting: &Setting<'_>) -> Pair<W> {
    Pair::new(world, &Setting { eta: Eta::NEUTRAL, ..setting.clone() })
}

/// Training of a protagonist, update by update.
pub struct Solo<'a, W: Arena, O> {
    setting: Setting<'a>,
    turns: Vec<Turn>,
    /// Updates done.
    done: usize,
    pair: Pair<W>,
    collector: Collector<W>,
    minibatches: ChaCha8Rng,
    objective: O,
}

/// All that later updates depend on.
#[derive(Serialize, Deserialize)]
struct State<S, O> {
    update: u64,
    minibatches: u128,
    protagonist: PlayerState,
    games: GamesState<S>,
    objective: O,
}

impl<'a, W: Arena, O: Objective> Solo<'a, W, O> {
    /// Training from its beginning, on `world`, whose slots are the parallel episodes.
    pub fn new(world: W, setting: &Setting<'a>) -> Self {
        Solo {
            turns: schedule::alone(setting.options, setting.eta),
            done: 0,
            pair: players(&world, setting),
            collector: Collector::new(world, setting),
            minibatches: stream(setting.seed, Purpose::Minibatches, 0),
            objective: O::new(setting.own),
            setting: setting.clone(),
        }
    }

    /// A rollout and an update on it.
    fn turn(&mut self, turn: &Turn) -> Losses {
        let Setting { gamma, options, .. } = self.setting;
        let Solo { pair, collector, objective, .. } = self;
        let terms = Terms { eta: Eta::NEUTRAL, mode: turn.mode, exploring: turn.exploring };
        collector.collect(pair, terms, options);
        let Collector { protagonist: record, before, finished, .. } = collector;
        let returns = Returns {
            alpha: turn.budget.alpha(),
            gamma,
            slots: record.slots,
            before,
            ended: &record.ended,
            finished,
        };
        let given = objective.judge(&returns, &mut record.rewards);
        let signal = given.as_deref().map_or(Signal::Own, Signal::Uncentred);
        let random = &mut self.minibatches;
        pair.protagonist.update(record, signal, gamma, &options.protagonist, turn.rates, random)
    }
}

impl<W: Arena, O: Objective> Training<W> for Solo<'_, W, O> {
    fn update(&mut self) -> Result<Option<Progress>, TrainError> {
        let Some(&turn) = self.turns.get(self.done) else { return Ok(None) };
        let losses = self.turn(&turn);
        let (update, player) = (turn.update, turn.role.name());
        if let Some(quantity) = losses.not_finite().or_else(|| self.pair.protagonist.not_finite()) {
            return Err(TrainError::NotFinite { update, player, quantity });
        }
        self.done += 1;
        let collector = &self.collector;
        let mean_return = collector.mean_return();
        let values = vec![
            turn.budget.get(),
            self.objective.threshold(),
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
        let state = State {
            update: self.updates(),
            minibatches: position(&self.minibatches),
            protagonist: self.pair.protagonist.state(),
            games: self.collector.state(),
            objective: self.objective.clone(),
        };
        postcard::to_allocvec(&state).expect("memory takes every byte")
    }

    fn restore(&mut self, state: &[u8]) -> Result<(), Unfit> {
        let read = postcard::take_from_bytes::<State<<W as World>::Snapshot, O>>(state);
        let Ok((state, [])) = read else { return Err(Unfit("the method's")) };
        let done = usize::try_from(state.update).ok().filter(|&done| done <= self.turns.len());
        let done = done.ok_or(Unfit("the schedule's"))?;
        self.pair.protagonist.restore(state.protagonist)?;
        let seed = self.setting.seed;
        self.collector.restore(&state.games, seed)?;
        self.minibatches = stream_from(seed, Purpose::Minibatches, 0, state.minibatches);
        self.objective = state.objective;
        self.done = done;
        Ok(())
    }

    fn players(&self) -> &dyn Players<W> {
        &self.pair
    }
}
