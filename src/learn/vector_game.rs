//! One step of the game in every slot of a batch: the protagonist chooses, chance offers its nominal
//! law, the opponent reweights it within the remaining budget, the outcome is drawn and applied.
//!
//! Training and evaluation both step through here.

use super::policy::{Draw, Mode, Opponent, Policy, Response, Situation, Streams};
use crate::game::budget::{Budget, Eta};
use lava_envs::{Outcome, Step, World};

/// A batch of games and what happened in its last step; vectors have an entry per slot.
pub struct VectorGame<W: World> {
    /// The world.
    pub world: W,
    /// Random streams.
    pub streams: Vec<Streams>,
    /// Remaining budgets eta_t, after the last step.
    pub budgets: Vec<Budget>,
    /// Slots that take no part in the next steps.
    pub idle: Vec<bool>,
    /// Chosen actions.
    pub actions: Vec<W::Action>,
    /// Nominal laws P_t.
    pub laws: Vec<W::Law>,
    /// Budgets eta_t before the outcome.
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
            idle: vec![false; slots],
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
        protagonist: &mut (impl Policy<W> + ?Sized),
        mode: Mode,
        opponent: &mut (impl Opponent<W> + ?Sized),
        draw: Draw,
    ) {
        self.choose(protagonist, mode);
        self.outcomes.clear();
        let VectorGame { world, actions, laws, budgets, outcomes, ratios, .. } = self;
        let situation = Situation { world, actions, laws, budgets };
        opponent.respond(&situation, draw, &mut self.streams, Response { outcomes, ratios });
        self.budgets_before.copy_from_slice(&self.budgets);
        for (slot, budget) in self.budgets.iter_mut().enumerate() {
            if !self.idle[slot] {
                *budget = budget.spend(self.ratios[slot]); // Eq. 5
            }
        }
        self.world.apply(&self.actions, &self.outcomes, &mut self.steps);
    }

    /// The protagonist's half of a step: it chooses, and chance offers its nominal laws.
    pub fn choose(&mut self, protagonist: &mut (impl Policy<W> + ?Sized), mode: Mode) {
        self.actions.clear();
        protagonist.choose(&self.world, mode, &mut self.streams, &mut self.actions);
        self.laws.clear();
        let chosen = self.actions.iter().enumerate();
        self.laws.extend(chosen.map(|(slot, &action)| self.world.law(slot, action)));
    }

    /// What the opponent knows after the protagonist has chosen.
    pub fn situation(&self) -> Situation<'_, W> {
        let VectorGame { world, actions, laws, budgets, .. } = self;
        Situation { world, actions, laws, budgets }
    }
}
