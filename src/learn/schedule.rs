//! The schedule of training (Algorithm 1): whose turn each update is, at which budget and rates.

use super::options::{Adversary, PlayerOptions, Role, TrainOptions};
use super::policy::Mode;
use super::ppo::Rates;
use crate::game::budget::Eta;

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
    pub mode: Mode,
    /// Share of the rollout's episodes that start anywhere.
    pub exploring: f64,
    /// Rates of the update.
    pub rates: Rates,
}

/// All turns of a run: K of the follower, one of the leader, and so on. While the budget is 1, or the
/// adversary does not learn, every turn is the protagonist's; at the end those of the response to its greedy policy are the
/// antagonist's. Each player's rates fall linearly over its own turns.
pub fn schedule(options: &TrainOptions, eta: Eta) -> Vec<Turn> {
    turns(options, &roles(options, eta, options.updates()).collect::<Vec<_>>())
}

/// The turns of a run in which every turn is the protagonist's.
pub fn alone(options: &TrainOptions, eta: Eta) -> Vec<Turn> {
    let updates = options.updates();
    let budget = |update| budget_at(options, eta, update as f64 / updates as f64);
    let own: Vec<_> = (0..updates).map(|update| (Role::Protagonist, budget(update))).collect();
    turns(options, &own)
}

/// The turns of these roles and budgets.
fn turns(options: &TrainOptions, roles: &[(Role, Eta)]) -> Vec<Turn> {
    let updates = roles.len() as u64;
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
        let response = role == Role::Antagonist && is_response(options, update as u64, updates);
        let mode = if response { Mode::Greedy } else { Mode::Sampled };
        let exploring = exploring_at(options, update as f64 / updates as f64);
        Turn { update: update as u64 + 1, role, budget, mode, exploring, rates }
    };
    roles.iter().enumerate().map(turn).collect()
}

/// Whose turn each of so many updates is, and at which budget.
pub fn roles(
    options: &TrainOptions,
    eta: Eta,
    updates: u64,
) -> impl Iterator<Item = (Role, Eta)> + '_ {
    let round = u64::from(options.follower_updates) + 1;
    let mut played = 0; // turns at a budget above 1
    (0..updates).map(move |update| {
        let budget = budget_at(options, eta, update as f64 / updates as f64);
        if budget.is_neutral() || options.adversary == Adversary::Random {
            return (Role::Protagonist, budget);
        }
        if is_response(options, update, updates) {
            return (Role::Antagonist, budget);
        }
        played += 1;
        let leads = played % round == 0;
        (if leads { options.leader } else { options.leader.other() }, budget)
    })
}

/// Whether an update is one of the antagonist's response at the end of the run.
fn is_response(options: &TrainOptions, update: u64, updates: u64) -> bool {
    (updates - update) as f64 <= options.response * updates as f64
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

/// The share of episodes that start anywhere at a point of the run in [0, 1).
fn exploring_at(options: &TrainOptions, progress: f64) -> f64 {
    let left = 1.0 - progress / options.exploring_until;
    if left > 0.0 { options.exploring_starts * left } else { 0.0 }
}
