//! Algorithm 1 of the paper: the two players are updated in turn, each on a fresh rollout.

use crate::arena::Arena;
use crate::pair::Pair;
use crate::ppo::{Losses, Rates};
use crate::rollout::Collector;
use cvar_game::game::budget::Eta;
use cvar_game::options::{PlayerOptions, Role, TrainOptions};
use lava_envs::End;
use lava_envs::random::{Purpose, stream};
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
/// `observe` is told of every update and shown the pair as it is then.
///
/// # Errors
/// [`TrainError::NotFinite`] at the first quantity that is not a finite number.
pub fn train<W: Arena>(
    world: W,
    game: &Game<'_>,
    mut observe: impl FnMut(&Progress, &Pair<W>),
) -> Result<Pair<W>, TrainError> {
    let options = game.options;
    let mut pair = Pair::<W>::new(options, game.eta, game.seed, game.device);
    let mut collector = Collector::new(world, &pair, game.gamma, game.seed);
    let mut minibatches = stream(game.seed, Purpose::Minibatches, 0);
    for turn in schedule(options, game.eta) {
        collector.collect(&pair, turn.budget, options.rollout_steps, options.credit);
        let rates = turn.rates;
        let losses = match (turn.role, &mut pair.antagonist) {
            (Role::Antagonist, Some(antagonist)) => antagonist.update(
                &collector.antagonist,
                game.gamma,
                &options.antagonist,
                rates,
                &mut minibatches,
            ),
            _ => pair.protagonist.update(
                &collector.protagonist,
                game.gamma,
                &options.protagonist,
                rates,
                &mut minibatches,
            ),
        };
        let diverged = losses.not_finite().or_else(|| {
            let finite = pair.parameters(turn.role).iter().all(|p| p.is_finite());
            (!finite).then_some("a weight")
        });
        if let Some(quantity) = diverged {
            return Err(TrainError::NotFinite { update: turn.update, role: turn.role, quantity });
        }
        let progress = Progress {
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
        };
        observe(&progress, &pair);
    }
    Ok(pair)
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
    /// Rates of the update.
    pub rates: Rates,
}

/// All turns of a run: K of the follower, one of the leader, and so on. While the budget is 1 every
/// turn is the protagonist's. Each player's rates fall linearly over its own turns.
pub fn schedule(options: &TrainOptions, eta: Eta) -> Vec<Turn> {
    let updates = options.steps.div_ceil(options.rollout());
    let round = u64::from(options.follower_updates) + 1;
    let mut played = 0; // turns at a budget above 1
    let roles: Vec<(Role, Eta)> = (0..updates)
        .map(|update| {
            let budget = budget_at(options, eta, update as f64 / updates as f64);
            if budget.is_neutral() {
                return (Role::Protagonist, budget);
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
        Turn { update: update as u64 + 1, role, budget, rates }
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
