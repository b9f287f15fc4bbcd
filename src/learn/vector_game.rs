//! One step of the game in every slot of a batch: the protagonist chooses, chance offers its nominal
//! law, the opponent reweights it within the remaining budget, the outcome is drawn and applied.
//!
//! In the game `joint` the opponent reweights the protagonist's draw as well, before the action, within the
//! same budget: sup delta_A <= eta_t, then sup delta_O <= eta_t / delta_A(a_t), and
//! eta_{t+1} = eta_t / (delta_A(a_t) delta_O(o_t)).
//!
//! Training and evaluation both step through here.

use super::policy::{
    Draw, DrawResponse, DrawSituation, Mode, Noise, Opponent, Policy, Response, Situation, Streams,
};
use crate::game::budget::{Budget, Eta};
use lava_envs::{Law, Outcome, Step, World};

/// What a budget is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spending {
    /// The whole trajectory: what a step spends is gone (Eq. 5 of the paper).
    #[default]
    Trajectory,
    /// Every step anew, sup `delta_t` <= eta: the bounded adversary that the paper argues against.
    Step,
}

/// A batch of games and what happened in its last step; vectors have an entry per slot.
pub struct VectorGame<W: World> {
    /// The world.
    pub world: W,
    /// Random streams.
    pub streams: Vec<Streams>,
    /// Remaining budgets eta_t, after the last step.
    pub budgets: Vec<Budget>,
    /// What the budgets are for.
    pub spending: Spending,
    /// Slots that take no part in the next steps.
    pub idle: Vec<bool>,
    /// Laws of the noise behind the draws of the last step; empty where the opponent left them alone.
    pub noise_laws: Vec<Noise<W>>,
    /// The realised noise; empty likewise.
    pub noise: Vec<<Noise<W> as Law>::Outcome>,
    /// Likelihood ratios delta_A of the draws; 1 where the opponent left them alone.
    pub draw_ratios: Vec<f64>,
    /// Budgets eta_t before the draw.
    pub budgets_at_draw: Vec<Budget>,
    /// Chosen actions.
    pub actions: Vec<W::Action>,
    /// Nominal laws P_t.
    pub laws: Vec<W::Law>,
    /// Budgets before the outcome, eta_t / delta_A(a_t).
    pub budgets_before: Vec<Budget>,
    /// Realised outcomes o_t.
    pub outcomes: Vec<Outcome<W>>,
    /// Likelihood ratios delta_t(o_t).
    pub ratios: Vec<f64>,
    /// Rewards and ends.
    pub steps: Vec<Step>,
}

impl<W: World> VectorGame<W> {
    /// Games in every slot of `world`, each to be started by [`VectorGame::start`].
    pub fn new(world: W, streams: Vec<Streams>) -> Self {
        let slots = world.episodes();
        assert_eq!(streams.len(), slots, "streams per slot");
        let neutral = Budget::start(Eta::NEUTRAL);
        VectorGame {
            world,
            streams,
            budgets: vec![neutral; slots],
            spending: Spending::default(),
            idle: vec![false; slots],
            noise_laws: Vec::new(),
            noise: Vec::new(),
            draw_ratios: vec![1.0; slots],
            budgets_at_draw: vec![neutral; slots],
            actions: Vec::new(),
            laws: Vec::new(),
            budgets_before: vec![neutral; slots],
            outcomes: Vec::new(),
            ratios: vec![1.0; slots],
            steps: vec![Step::IDLE; slots],
        }
    }

    /// Number of slots.
    pub fn slots(&self) -> usize {
        self.budgets.len()
    }

    /// Starts a new game in the slot.
    pub fn start(&mut self, slot: usize, eta: Eta) {
        self.world.reset(slot);
        self.budgets[slot] = Budget::start(eta);
    }

    /// Starts a new game in the slot from anywhere.
    pub fn start_anywhere(&mut self, slot: usize, eta: Eta) {
        self.world.scatter(slot, &mut self.streams[slot].actions);
        self.budgets[slot] = Budget::start(eta);
    }

    /// One step of the game in every slot that is not idle.
    pub fn step(
        &mut self,
        protagonist: &mut dyn Policy<W>,
        mode: Mode,
        opponent: &mut dyn Opponent<W>,
        draw: Draw,
    ) {
        self.choose(protagonist, mode, opponent, draw);
        self.outcomes.clear();
        let VectorGame { world, actions, laws, budgets_before: budgets, outcomes, ratios, .. } =
            self;
        let situation = Situation { world, actions, laws, budgets };
        opponent.respond(&situation, draw, &mut self.streams, Response { outcomes, ratios });
        for (slot, budget) in self.budgets.iter_mut().enumerate() {
            if !self.idle[slot] && self.spending == Spending::Trajectory {
                *budget = self.budgets_before[slot].spend(self.ratios[slot]); // Eq. 5
            }
        }
        self.world.apply(&self.actions, &self.outcomes, &mut self.steps);
    }

    /// The half of a step before the outcome: the protagonist chooses, by a draw that the opponent may
    /// reweight, and chance offers its nominal laws. The budgets stay as they are until the outcome.
    pub fn choose(
        &mut self,
        protagonist: &mut dyn Policy<W>,
        mode: Mode,
        opponent: &mut dyn Opponent<W>,
        draw: Draw,
    ) {
        self.actions.clear();
        self.noise_laws.clear();
        self.noise.clear();
        self.budgets_at_draw.copy_from_slice(&self.budgets);
        self.budgets_before.copy_from_slice(&self.budgets);
        let VectorGame { world, streams, actions, budgets, .. } = self;
        match (mode, protagonist.draws(), opponent.of_draws()) {
            (Mode::Sampled, Some(draws), Some(opponent)) => {
                draws.laws(world, &mut self.noise_laws);
                let (laws, noise, ratios) =
                    (&self.noise_laws, &mut self.noise, &mut self.draw_ratios);
                let situation = DrawSituation { world, laws, budgets };
                let response = DrawResponse { noise, ratios };
                opponent.respond_to_draw(&situation, draw, streams, response);
                draws.realise(noise, actions);
                for (slot, budget) in self.budgets_before.iter_mut().enumerate() {
                    if !self.idle[slot] {
                        *budget = budget.spend(self.draw_ratios[slot]);
                    }
                }
            }
            _ => {
                protagonist.choose(world, mode, streams, actions);
                self.draw_ratios.fill(1.0);
            }
        }
        self.laws.clear();
        let chosen = self.actions.iter().enumerate();
        self.laws.extend(chosen.map(|(slot, &action)| self.world.law(slot, action)));
    }

    /// What the opponent knows after the protagonist has chosen.
    pub fn situation(&self) -> Situation<'_, W> {
        let VectorGame { world, actions, laws, budgets_before: budgets, .. } = self;
        Situation { world, actions, laws, budgets }
    }

    /// delta_t of the slot's last step, delta_A(a_t) delta_O(o_t).
    pub fn likelihood_ratio(&self, slot: usize) -> f64 {
        self.draw_ratios[slot] * self.ratios[slot]
    }
}
