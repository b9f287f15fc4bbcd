//! The two players of a game, and what each of them sees.

use crate::arena::Arena;
use crate::head::AntagonistHead;
use crate::ppo::Player;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::options::{Adversary, Role, TrainOptions};
use lava_envs::World;
use lava_envs::random::{Purpose, stream};
use tch::Device;

/// The protagonist of a world.
pub type Protagonist<W> = Player<<W as Arena>::Policy>;
/// The antagonist of a world.
pub type Antagonist<W> = Player<AntagonistHead<<W as Arena>::Family>>;

/// The two players of a game.
#[derive(Debug)]
pub struct Pair<W: Arena> {
    /// Chooses the actions.
    pub protagonist: Protagonist<W>,
    /// Reweights chance; absent at eta = 1, where there is nothing it could do.
    pub antagonist: Option<Antagonist<W>>,
    /// What they see.
    pub views: Views,
    /// Whether the antagonist plays what its network says, or at random.
    pub adversary: Adversary,
}

impl<W: Arena> Pair<W> {
    /// Two fresh players.
    pub fn new(options: &TrainOptions, eta: Eta, seed: u64, device: Device) -> Self {
        let views = Views::new(options, eta);
        let protagonist = Player::new(
            W::policy(options),
            views.protagonist_inputs::<W>(),
            options.protagonist.hidden,
            device,
            &mut stream(seed, Purpose::ProtagonistWeights, 0),
        );
        let antagonist = (!eta.is_neutral()).then(|| {
            Player::new(
                AntagonistHead(W::family(options)),
                views.antagonist_inputs::<W>(),
                options.antagonist.hidden,
                device,
                &mut stream(seed, Purpose::AntagonistWeights, 0),
            )
        });
        Pair { protagonist, antagonist, views, adversary: options.adversary }
    }

    /// Parameters of a player; empty for an absent one.
    pub fn parameters(&self, role: Role) -> &[f32] {
        match role {
            Role::Protagonist => self.protagonist.network.parameters(),
            Role::Antagonist => self.antagonist.as_ref().map_or(&[], |a| a.network.parameters()),
        }
    }
}

/// What the players see.
///
/// The protagonist sees the world's observation, and the time if it is time-aware; never the budget:
/// given that it would solve Chow's decomposition, which is not CVaR-optimal. The antagonist sees
/// the situation after the action was chosen, its remaining budget as log eta_t / log eta, and the
/// time if it is time-aware. Every row ends with the constant 1 of the networks' biases.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Views {
    protagonist_time: bool,
    antagonist_time: bool,
    /// 1 / log eta, or 0 where the budget is hidden.
    budget_scale: f64,
}

impl Views {
    /// The views of a game.
    pub fn new(options: &TrainOptions, eta: Eta) -> Self {
        let blind = options.hide_budget || eta.is_neutral();
        Views {
            protagonist_time: options.protagonist.time_aware,
            antagonist_time: options.antagonist.time_aware,
            budget_scale: if blind { 0.0 } else { 1.0 / eta.get().ln() },
        }
    }

    /// Whether the protagonist sees the time.
    pub fn protagonist_sees_time(&self) -> bool {
        self.protagonist_time
    }

    /// Numbers that the protagonist sees.
    pub fn protagonist_inputs<W: World>(&self) -> usize {
        W::OBSERVATION + usize::from(self.protagonist_time)
    }

    /// Numbers that the antagonist sees.
    pub fn antagonist_inputs<W: World>(&self) -> usize {
        W::SITUATION + 1 + usize::from(self.antagonist_time)
    }

    /// Writes the protagonist's row, shape `[protagonist_inputs + 1]`.
    pub fn protagonist<W: World>(&self, world: &W, slot: usize, row: &mut [f32]) {
        world.observe(slot, &mut row[..W::OBSERVATION]);
        close(world, slot, &mut row[W::OBSERVATION..]);
    }

    /// Turns rows of the antagonist into those that it would see with exp(`log_factor`) times the
    /// budget.
    pub fn enrich<W: World>(&self, rows: &mut [f32], log_factor: f64) {
        for row in rows.chunks_exact_mut(self.antagonist_inputs::<W>() + 1) {
            row[W::SITUATION] += (log_factor * self.budget_scale) as f32;
        }
    }

    /// Writes the antagonist's row, shape `[antagonist_inputs + 1]`.
    pub fn antagonist<W: World>(
        &self,
        world: &W,
        slot: usize,
        action: W::Action,
        budget: Budget,
        row: &mut [f32],
    ) {
        world.situation(slot, action, &mut row[..W::SITUATION]);
        row[W::SITUATION] = (budget.get().ln() * self.budget_scale) as f32;
        close(world, slot, &mut row[W::SITUATION + 1..]);
    }
}

/// Writes the time, where there is room for it, and the constant 1.
fn close<W: World>(world: &W, slot: usize, rest: &mut [f32]) {
    if let [time, _] = rest {
        *time = 2.0 * world.time(slot) as f32 / world.horizon() as f32 - 1.0;
    }
    rest[rest.len() - 1] = 1.0;
}
