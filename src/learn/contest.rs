//! One step of the game in every slot of a batch: the protagonist chooses, chance offers its nominal
//! law, the antagonist reweights it within the remaining budget, the outcome is drawn and applied.
//!
//! Training and evaluation both step through here; this is the only place where what the worlds
//! show becomes the players' inputs.

use crate::arena::Arena;
use crate::head::Policy;
use crate::pair::{Pair, Protagonist, Views};
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::perturbation::{Family, Perturbation};
use cvar_game::options::Adversary;
use lava_envs::random::ChaCha8Rng;
use lava_envs::{Law, Step};
use rand::RngExt;
use rand_distr::StandardNormal;

/// What chance decides in a world.
pub type Outcome<W> = <<W as lava_envs::World>::Law as Law>::Outcome;

/// How the protagonist picks its action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Choosing {
    /// The mode of its policy.
    Greedy,
    /// A draw from its policy.
    Sampled,
}

/// Who decides the law of chance.
pub enum Chance<'a, W: Arena> {
    /// The nominal law.
    Nominal,
    /// The pair's antagonist.
    Antagonist,
    /// The nominal law; but the antagonist's likelihood ratios of what happens are recorded, so that
    /// nominal episodes can be weighted by prod delta.
    Shadowed,
    /// Somebody else.
    Opponent(&'a dyn Opponent<W>),
}

/// An antagonist that is not a pair's own.
pub trait Opponent<W: Arena> {
    /// Draws the outcome of a slot and tells its likelihood ratio delta_t(o_t).
    fn draw(
        &self,
        world: &W,
        slot: usize,
        law: &W::Law,
        random: &mut ChaCha8Rng,
    ) -> (Outcome<W>, f64);
}

/// The random streams of one slot.
#[derive(Debug)]
pub struct Streams {
    /// For the protagonist's draws.
    pub actions: ChaCha8Rng,
    /// For the outcomes of chance.
    pub outcomes: ChaCha8Rng,
}

/// A batch of games and what happened in its last step; vectors have an entry (or a row) per slot.
pub struct Contest<W: Arena> {
    /// The world.
    pub world: W,
    /// Random streams.
    pub streams: Vec<Streams>,
    /// Remaining budgets eta_t, after the last step.
    pub budgets: Vec<Budget>,
    /// Slots that take no part in the next steps.
    pub idle: Vec<bool>,
    /// Inputs of the protagonist, shape `[slots, inputs + 1]`.
    pub protagonist_inputs: Vec<f32>,
    /// Inputs of the antagonist, likewise; zero where it was not asked.
    pub antagonist_inputs: Vec<f32>,
    /// Chosen actions.
    pub actions: Vec<W::Action>,
    /// Actor outputs of the protagonist, shape `[k, slots]`.
    pub protagonist_outputs: Vec<f32>,
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
    /// max |`E_P[delta_t]` - 1| of all steps so far; looked at if `audit` is set.
    pub normalisation_error: f64,
    /// Whether to look at the normalisation, which training has no time for.
    pub audit: bool,
    antagonist_outputs: Vec<f32>,
}

impl<W: Arena> Contest<W> {
    /// Games in every slot of `world`, which are to be started by [`Contest::start`].
    pub fn new(world: W, streams: Vec<Streams>, views: &Views) -> Self {
        let slots = world.episodes();
        assert_eq!(streams.len(), slots, "streams per slot");
        let neutral = Budget::start(Eta::NEUTRAL);
        Contest {
            world,
            streams,
            budgets: vec![neutral; slots],
            idle: vec![false; slots],
            protagonist_inputs: vec![0.0; slots * (views.protagonist_inputs::<W>() + 1)],
            antagonist_inputs: vec![0.0; slots * (views.antagonist_inputs::<W>() + 1)],
            actions: Vec::new(),
            protagonist_outputs: Vec::new(),
            laws: Vec::new(),
            budgets_before: vec![neutral; slots],
            outcomes: Vec::new(),
            ratios: vec![1.0; slots],
            steps: vec![Step::IDLE; slots],
            normalisation_error: 0.0,
            audit: false,
            antagonist_outputs: Vec::new(),
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

    /// One step of the game in every slot that is not idle.
    pub fn step(&mut self, pair: &Pair<W>, choosing: Choosing, chance: &Chance<'_, W>) {
        self.choose(&pair.protagonist, &pair.views, choosing);
        self.decide(pair, chance);
        self.world.apply(&self.actions, &self.outcomes, &mut self.steps);
    }

    /// The protagonist sees and chooses.
    pub fn choose(&mut self, protagonist: &Protagonist<W>, views: &Views, choosing: Choosing) {
        let row = views.protagonist_inputs::<W>() + 1;
        for (slot, row) in self.protagonist_inputs.chunks_exact_mut(row).enumerate() {
            views.protagonist(&self.world, slot, row);
        }
        protagonist.network.act(&self.protagonist_inputs, &mut self.protagonist_outputs);
        self.actions.clear();
        for slot in 0..self.slots() {
            let parameters = protagonist.parameters_in(&self.protagonist_outputs, slot);
            let head = &protagonist.head;
            self.actions.push(match choosing {
                Choosing::Greedy => head.greedy(&parameters),
                Choosing::Sampled => head.draw(&parameters, &mut self.streams[slot].actions),
            });
        }
        self.laws.clear();
        let laws = self.actions.iter().enumerate().map(|(slot, &a)| self.world.law(slot, a));
        self.laws.extend(laws);
    }

    /// Writes the antagonist's inputs, the actions being chosen.
    pub fn show_antagonist(&mut self, views: &Views) {
        let row = views.antagonist_inputs::<W>() + 1;
        for (slot, row) in self.antagonist_inputs.chunks_exact_mut(row).enumerate() {
            let (action, budget) = (self.actions[slot], self.budgets[slot]);
            views.antagonist(&self.world, slot, action, budget, row);
        }
    }

    /// Chance decides, reweighted or not, and the budgets are spent.
    fn decide(&mut self, pair: &Pair<W>, chance: &Chance<'_, W>) {
        let learned = match chance {
            Chance::Antagonist | Chance::Shadowed => pair.antagonist.as_ref(),
            Chance::Nominal | Chance::Opponent(_) => None,
        };
        if let Some(antagonist) = learned {
            self.show_antagonist(&pair.views);
            antagonist.network.act(&self.antagonist_inputs, &mut self.antagonist_outputs);
        }
        self.outcomes.clear();
        for slot in 0..self.slots() {
            let law = self.laws[slot];
            let budget = self.budgets[slot];
            let random = &mut self.streams[slot].outcomes;
            let (outcome, ratio) = match (chance, learned) {
                (Chance::Opponent(opponent), _) => opponent.draw(&self.world, slot, &law, random),
                (_, Some(antagonist)) => {
                    let parameters = match pair.adversary {
                        Adversary::Learned => {
                            antagonist.parameters_in(&self.antagonist_outputs, slot)
                        }
                        Adversary::Random => std::array::from_fn(|_| random.sample(StandardNormal)),
                    };
                    let perturbation = antagonist.head.0.perturbation(&parameters, &law, budget);
                    if self.audit {
                        let error = perturbation.normalisation_error();
                        self.normalisation_error = self.normalisation_error.max(error);
                    }
                    let outcome = match chance {
                        Chance::Shadowed => law.sample(random),
                        _ => perturbation.sample(random),
                    };
                    (outcome, perturbation.likelihood_ratio(outcome))
                }
                _ => (law.sample(random), 1.0),
            };
            self.outcomes.push(outcome);
            self.ratios[slot] = ratio;
            self.budgets_before[slot] = budget;
            if !self.idle[slot] {
                self.budgets[slot] = budget.spend(ratio);
            }
        }
    }
}
