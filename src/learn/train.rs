//! Algorithm 1 of the paper: the two players are updated in turn, each on a fresh rollout.

use crate::arena::Arena;
use crate::checkpoint::{TrainingState, Unfit};
use crate::contest::Choosing;
use crate::pair::Pair;
use crate::ppo::{Losses, Player, Rates};
use crate::price::Spending;
use crate::rollout::Collector;
use cvar_game::game::budget::Eta;
use cvar_game::options::{Adversary, PlayerOptions, Role, TrainOptions};
use lava_envs::End;
use lava_envs::random::{ChaCha8Rng, Purpose, position, stream, stream_from};
use tch::Device;

/// Everything that determines a training run, the world apart.
#[derive(Debug, Clone)]
pub struct Game<'a> {
    /// Budget.
    pub eta: Eta,
    /// Discount factor.
    pub gamma: f64,
    /// Seed of all random streams.
    pub seed: u64,
    /// Device of the networks.
    pub device: Device,
    /// Options of training.
    pub options: &'a TrainOptions,
}

/// What one update of one player reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Index of the update, of both players together, from 1.
    pub update: u64,
    /// Environment steps so far.
    pub steps: u64,
    /// Who was updated.
    pub role: Role,
    /// Budget of the episodes that started in the rollout.
    pub budget: f64,
    /// Mean undiscounted return of the episodes that ended in the rollout, the antagonist playing.
    pub mean_return: f64,
    /// Their share that reached the goal.
    pub goal: f64,
    /// Their share that ended in lava.
    pub lava: f64,
    /// Learning rate.
    pub learning_rate: f64,
    /// Losses of the update.
    pub losses: Losses,
    /// max prod delta / eta over all trajectories so far.
    pub budget_use: f64,
}

/// Why a run stopped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TrainError {
    /// Training left the numbers.
    #[error(
        "training diverged: {quantity} of the {role} is not finite at update {update}; \
         a smaller train.{role}.learning_rate may help"
    )]
    NotFinite {
        /// Index of the update.
        update: u64,
        /// Whose update it was.
        role: Role,
        /// What is not finite.
        quantity: &'static str,
    },
}

/// Trains a pair of players on `world`, whose slots are the parallel episodes.
///
/// `observe` is told of every update.
///
/// # Errors
/// [`TrainError::NotFinite`] at the first quantity that is not a finite number.
pub fn train<W: Arena>(
    world: W,
    game: &Game<'_>,
    mut observe: impl FnMut(&Progress),
) -> Result<Pair<W>, TrainError> {
    let mut training = Training::new(world, game);
    while let Some(progress) = training.update()? {
        observe(&progress);
    }
    Ok(training.pair)
}

/// Training, update by update; between two updates it can be saved and restored.
pub struct Training<'a, W: Arena> {
    game: &'a Game<'a>,
    turns: Vec<Turn>,
    /// Updates done.
    done: usize,
    /// The players.
    pub pair: Pair<W>,
    collector: Collector<W>,
    minibatches: ChaCha8Rng,
}

impl<'a, W: Arena> Training<'a, W> {
    /// Training from its beginning, on `world`, whose slots are the parallel episodes.
    pub fn new(world: W, game: &'a Game<'a>) -> Self {
        let pair = Pair::<W>::new(game.options, game.eta, game.seed, game.device);
        let collector = Collector::new(world, &pair, game.gamma, game.seed);
        Training {
            game,
            turns: schedule(game.options, game.eta),
            done: 0,
            pair,
            collector,
            minibatches: stream(game.seed, Purpose::Minibatches, 0),
        }
    }

    /// The next update; none is left after the last one.
    ///
    /// # Errors
    /// [`TrainError::NotFinite`] at the first quantity that is not a finite number.
    pub fn update(&mut self) -> Result<Option<Progress>, TrainError> {
        let Some(&turn) = self.turns.get(self.done) else { return Ok(None) };
        let Game { gamma, options, .. } = *self.game;
        let Training { pair, collector, minibatches, .. } = self;
        collector.collect(pair, turn.budget, turn.choosing, options);
        let rates = turn.rates;
        let losses = match (turn.role, &mut pair.antagonist) {
            (Role::Antagonist, Some(antagonist)) => {
                let trajectories = &collector.antagonist;
                let spending = options
                    .price_budget
                    .then(|| Spending::of::<W>(antagonist, trajectories, &pair.views));
                antagonist.update(
                    trajectories,
                    spending.as_ref(),
                    gamma,
                    &options.antagonist,
                    rates,
                    minibatches,
                )
            }
            _ => pair.protagonist.update(
                &collector.protagonist,
                None,
                gamma,
                &options.protagonist,
                rates,
                minibatches,
            ),
        };
        let diverged = losses.not_finite().or_else(|| match (turn.role, &pair.antagonist) {
            (Role::Antagonist, Some(antagonist)) => antagonist.not_finite(),
            _ => pair.protagonist.not_finite(),
        });
        if let Some(quantity) = diverged {
            return Err(TrainError::NotFinite { update: turn.update, role: turn.role, quantity });
        }
        self.done += 1;
        Ok(Some(Progress {
            update: turn.update,
            steps: turn.update * options.rollout(),
            role: turn.role,
            budget: turn.budget.get(),
            mean_return: collector.mean_return(),
            goal: collector.share(End::Goal),
            lava: collector.share(End::Lava),
            learning_rate: rates.learning_rate,
            losses,
            budget_use: collector.budget_use,
        }))
    }

    /// Updates done.
    pub fn updates(&self) -> u64 {
        self.done as u64
    }

    /// All that the updates to come depend on.
    pub fn state(&self) -> TrainingState<W::Snapshot> {
        TrainingState {
            update: self.updates(),
            minibatches: position(&self.minibatches),
            protagonist: self.pair.protagonist.state(),
            antagonist: self.pair.antagonist.as_ref().map(Player::state),
            games: self.collector.state(),
        }
    }

    /// Goes on from a state of training in the same game.
    ///
    /// # Errors
    /// If the state is of another game; part of it may be in place then.
    pub fn restore(&mut self, state: TrainingState<W::Snapshot>) -> Result<(), Unfit> {
        let done = usize::try_from(state.update).ok().filter(|&done| done <= self.turns.len());
        let done = done.ok_or(Unfit("the schedule's"))?;
        self.pair.protagonist.restore(state.protagonist)?;
        match (&mut self.pair.antagonist, state.antagonist) {
            (Some(antagonist), Some(state)) => antagonist.restore(state)?,
            (None, None) => {}
            _ => return Err(Unfit("a player's")),
        }
        self.collector.restore(&state.games, self.game.seed)?;
        let seed = self.game.seed;
        self.minibatches = stream_from(seed, Purpose::Minibatches, 0, state.minibatches);
        self.done = done;
        Ok(())
    }
}

/// One update of one player.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Index, from 1.
    pub update: u64,
    /// Whose turn it is.
    pub role: Role,
    /// Budget of the rollout.
    pub budget: Eta,
    /// How the protagonist picks its actions in the rollout.
    pub choosing: Choosing,
    /// Rates of the update.
    pub rates: Rates,
}

/// All turns of a run: K of the follower, one of the leader, and so on. While the budget is 1, or the
/// adversary does not learn, every turn is the protagonist's; at the end those of the response to its greedy policy are the
/// antagonist's. Each player's rates fall linearly over its own turns.
pub fn schedule(options: &TrainOptions, eta: Eta) -> Vec<Turn> {
    let updates = options.steps.div_ceil(options.rollout());
    let round = u64::from(options.follower_updates) + 1;
    let responds = |update: u64| (updates - update) as f64 <= options.response * updates as f64;
    let mut played = 0; // turns at a budget above 1
    let roles: Vec<(Role, Eta)> = (0..updates)
        .map(|update| {
            let budget = budget_at(options, eta, update as f64 / updates as f64);
            if budget.is_neutral() || options.adversary == Adversary::Random {
                return (Role::Protagonist, budget);
            }
            if responds(update) {
                return (Role::Antagonist, budget);
            }
            played += 1;
            let leads = played % round == 0;
            (if leads { options.leader } else { options.leader.other() }, budget)
        })
        .collect();
    let count = |wanted: Role| roles.iter().filter(|(role, _)| *role == wanted).count();
    let totals = [Role::Protagonist, Role::Antagonist].map(count);
    let mut done = [0usize; 2];
    let turn = |(update, &(role, budget)): (usize, &(Role, Eta))| {
        let (player, index): (&PlayerOptions, usize) = match role {
            Role::Protagonist => (&options.protagonist, 0),
            Role::Antagonist => (&options.antagonist, 1),
        };
        let progress = done[index] as f64 / (totals[index] as f64 - 1.0).max(1.0);
        done[index] += 1;
        let between = |first: f64, last: f64| first * (1.0 - progress) + last * progress;
        let rates = Rates {
            learning_rate: between(player.learning_rate, player.learning_rate_final),
            entropy: between(player.entropy, player.entropy_final),
        };
        let response = role == Role::Antagonist && responds(update as u64);
        let choosing = if response { Choosing::Greedy } else { Choosing::Sampled };
        Turn { update: update as u64 + 1, role, budget, choosing, rates }
    };
    roles.iter().enumerate().map(turn).collect()
}

/// The budget at a point of the run in [0, 1): 1 for `budget_wait`, then rising linearly in log eta
/// for `budget_rise`, then eta.
fn budget_at(options: &TrainOptions, eta: Eta, progress: f64) -> Eta {
    let since = progress - options.budget_wait;
    if since < 0.0 {
        Eta::NEUTRAL
    } else if since < options.budget_rise {
        Eta::new(eta.get().powf(since / options.budget_rise)).unwrap_or(Eta::NEUTRAL)
    } else {
        eta
    }
}
