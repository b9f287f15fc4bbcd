//! Rollouts: a fixed number of steps of parallel games, recorded for both players.

use super::family::Played;
use super::method::{Arena, Setting};
use super::observation::Observation;
use super::options::{Credit, TrainOptions};
use super::pair::{LearnedOpponent, Pair, PpoPolicy};
use super::policy::{Draw, Mode, Noise, Nominal, Opponent, Policy, Streams};
use super::price::Finished;
use super::state::{GamesState, SlotState, Unfit};
use super::trajectories::Trajectories;
use super::vector_game::{Spending, VectorGame};
use crate::game::budget::{Budget, Eta};
use crate::game::columns::logarithms;
use crate::game::returns::{Atom, ReturnSoFar};
use lava_envs::random::{Purpose, position, stream, stream_from};
use lava_envs::{End, Law, World};
use rand::RngExt;

/// Plays and records.
pub struct Collector<W: World> {
    game: VectorGame<W>,
    /// The budget that each slot's episode started with; it differs while the budget rises.
    start: Vec<Eta>,
    so_far: Vec<ReturnSoFar>,
    /// prod delta of each slot's episode so far.
    products: Vec<f64>,
    gamma: f64,
    /// What the protagonist recorded in the last rollout.
    pub protagonist: Trajectories<(), W::Action>,
    /// What the antagonist recorded; empty if it did not play.
    pub antagonist: Played<W::Law>,
    /// What its half on the protagonist's draw recorded; empty if it did not play.
    pub action_antagonist: Played<Noise<W>>,
    /// The return of each slot's episode before each step, `[steps, slots]`; `None` in one that started anywhere.
    pub before: Vec<Option<ReturnSoFar>>,
    /// Episodes that ended in the last rollout, without those that started anywhere; their masses have no
    /// meaning.
    pub finished: Vec<Atom>,
    /// The same episodes with prod delta.
    pub weighted: Vec<Finished>,
    /// max prod delta / eta over all trajectories so far, at most 1 up to rounding; 0 where budgets are those of
    /// single steps.
    pub budget_use: f64,
}

/// How a rollout is played.
#[derive(Debug, Clone, Copy)]
pub struct Terms {
    /// Budget of the episodes that start in it. At budget 1 it is played without the antagonist.
    pub eta: Eta,
    /// How the protagonist picks its actions.
    pub mode: Mode,
    /// Share of the episodes that start anywhere.
    pub exploring: f64,
}

impl<W: Arena> Collector<W> {
    /// Games in all slots of `world`, not yet started.
    pub fn new(world: W, setting: &Setting<'_>) -> Self {
        let slots = world.episodes();
        let streams = (0..slots as u64)
            .map(|slot| Streams {
                actions: stream(setting.seed, Purpose::Actions, slot),
                outcomes: stream(setting.seed, Purpose::Outcomes, slot),
            })
            .collect();
        let mut game = VectorGame::new(world, streams);
        for slot in 0..slots {
            game.start(slot, Eta::NEUTRAL);
        }
        Collector {
            game,
            start: vec![Eta::NEUTRAL; slots],
            so_far: vec![ReturnSoFar::START; slots],
            products: vec![1.0; slots],
            gamma: setting.gamma,
            protagonist: Trajectories::new(slots),
            antagonist: Trajectories::new(slots),
            action_antagonist: Trajectories::new(slots),
            before: Vec::new(),
            finished: Vec::new(),
            weighted: Vec::new(),
            budget_use: 0.0,
        }
    }

    /// The same, with budgets for this.
    #[must_use]
    pub fn spending(mut self, spending: Spending) -> Self {
        self.game.spending = spending;
        self
    }

    /// Forgets the last rollout, and lets episodes in which no step was made yet begin on these terms as well.
    pub fn open(&mut self, terms: Terms) {
        self.protagonist.clear();
        self.antagonist.clear();
        self.action_antagonist.clear();
        self.before.clear();
        self.finished.clear();
        self.weighted.clear();
        for slot in 0..self.game.slots() {
            if self.game.world.time(slot) == 0 {
                self.begin(slot, terms);
            }
        }
    }

    /// Plays a step of any policy under nominal chance in every slot, for `record` to see before episodes that ended
    /// with it are followed by new ones.
    pub fn step<P: Policy<W>>(
        &mut self,
        policy: &mut P,
        terms: Terms,
        record: impl FnOnce(&P, &VectorGame<W>),
    ) {
        self.game.step(policy, terms.mode, &mut Nominal, Draw::Perturbed);
        record(policy, &self.game);
        for slot in 0..self.game.slots() {
            self.count(slot, terms);
        }
    }

    /// Plays the steps of a rollout in every slot; an episode that ends is followed by a new one.
    pub fn collect(&mut self, pair: &Pair<W>, terms: Terms, options: &TrainOptions) {
        self.open(terms);
        let mut policy = PpoPolicy::new(&pair.protagonist, pair.observation);
        let mut opponent = if terms.eta.is_neutral() { None } else { pair.opponent(false) };
        for _ in 0..options.rollout_steps {
            let chance: &mut dyn Opponent<W> = match &mut opponent {
                Some(opponent) => opponent,
                None => &mut Nominal,
            };
            self.game.step(&mut policy, terms.mode, chance, Draw::Perturbed);
            self.record_protagonist(&policy, pair.observation, options.credit);
            if let Some(opponent) = &opponent {
                self.record_antagonist(opponent);
                self.record_draws(opponent);
            }
            for slot in 0..self.game.slots() {
                self.count(slot, terms);
            }
        }
        // The states after the last step. The antagonist's state holds an action: one is drawn for
        // this purpose only, which leaves its value unbiased.
        let chance: &mut dyn Opponent<W> = match &mut opponent {
            Some(opponent) => opponent,
            None => &mut Nominal,
        };
        self.game.choose(&mut policy, terms.mode, chance, Draw::Perturbed);
        self.record_view(&policy, pair.observation);
        if let Some(opponent) = &mut opponent {
            opponent.look(&self.game.situation());
            self.antagonist.inputs.extend(opponent.inputs.rows());
            if !self.game.noise.is_empty() {
                self.action_antagonist.inputs.extend(opponent.draw_inputs.rows());
            }
        }
    }

    fn begin(&mut self, slot: usize, Terms { eta, exploring, .. }: Terms) {
        if exploring > 0.0 && self.game.streams[slot].actions.random_bool(exploring) {
            self.game.start_anywhere(slot, eta);
        } else {
            self.game.start(slot, eta);
        }
        self.start[slot] = eta;
        self.so_far[slot] = ReturnSoFar::START;
        self.products[slot] = 1.0;
    }

    fn record_protagonist(
        &mut self,
        policy: &PpoPolicy<'_, super::pair::HeadIn<W>>,
        observation: Observation,
        credit: Credit,
    ) {
        self.record_view(policy, observation);
        let (game, record) = (&self.game, &mut self.protagonist);
        for slot in 0..game.slots() {
            let choice = match credit {
                Credit::Chosen => None,
                Credit::Executed => W::executed(game.outcomes[slot]),
            }
            .unwrap_or(game.actions[slot]);
            record.given.push(());
            record.choices.push(choice);
            record.rewards.push(game.steps[slot].reward as f32);
            record.ended.push(game.steps[slot].end.is_some());
            // The world counts this step already.
            let explored = game.world.time(slot) != self.so_far[slot].steps + 1;
            self.before.push((!explored).then_some(self.so_far[slot]));
        }
        let chosen = record.choices.len() - game.slots();
        policy.log_probabilities(&record.choices[chosen..], &mut record.log_probabilities);
    }

    /// Records what the protagonist saw, and its critic besides.
    fn record_view(
        &mut self,
        policy: &PpoPolicy<'_, super::pair::HeadIn<W>>,
        observation: Observation,
    ) {
        let inputs = &mut self.protagonist.inputs;
        let start = inputs.numbers.len();
        inputs.extend(policy.inputs.rows());
        observation.show_budgets::<W>(&self.game.budgets_at_draw, &mut inputs.numbers[start..]);
    }

    fn record_antagonist(&mut self, opponent: &LearnedOpponent<'_, W>) {
        let (game, record) = (&self.game, &mut self.antagonist);
        record.inputs.extend(opponent.inputs.rows());
        let log_ratios = logarithms(game.ratios.iter().copied());
        for (slot, log_ratio) in log_ratios.into_iter().enumerate() {
            let (law, outcome) = (game.laws[slot], game.outcomes[slot]);
            record.given.push((law, game.budgets_before[slot]));
            record.choices.push(outcome);
            // The antagonist's law is the perturbed law: log(P_t(o) delta_t(o)).
            record.log_probabilities.push(law.log_density(outcome) + log_ratio);
            record.rewards.push(-game.steps[slot].reward as f32);
            record.ended.push(game.steps[slot].end.is_some());
        }
    }

    /// Records the draws of the last step, if the antagonist reweighted them.
    fn record_draws(&mut self, opponent: &LearnedOpponent<'_, W>) {
        let (game, record) = (&self.game, &mut self.action_antagonist);
        if game.noise.is_empty() {
            return;
        }
        record.inputs.extend(opponent.draw_inputs.rows());
        for (slot, (law, &noise)) in game.noise_laws.iter().zip(&game.noise).enumerate() {
            record.given.push((*law, game.budgets_at_draw[slot]));
            record.choices.push(noise);
            let log_probability = law.log_density(noise) + game.draw_ratios[slot].ln();
            record.log_probabilities.push(log_probability);
            record.rewards.push(-game.steps[slot].reward as f32);
            record.ended.push(game.steps[slot].end.is_some());
        }
    }

    /// Accumulates the last step of a slot, and starts a new episode when its own has ended.
    fn count(&mut self, slot: usize, terms: Terms) {
        let step = self.game.steps[slot];
        self.so_far[slot].add(step.reward, self.gamma);
        self.products[slot] *= self.game.likelihood_ratio(slot);
        if let Some(end) = step.end {
            let explored = self.game.world.time(slot) != self.so_far[slot].steps;
            if !explored {
                self.finished.push(self.so_far[slot].ended(end));
                let (value, likelihood_ratio) = (self.so_far[slot].value, self.products[slot]);
                self.weighted.push(Finished { value, likelihood_ratio });
            }
            if self.game.spending == Spending::Trajectory {
                let used = self.products[slot] / self.start[slot].get();
                self.budget_use = self.budget_use.max(used);
            }
            self.begin(slot, terms);
        }
    }

    /// All that the next rollouts depend on besides the players.
    pub fn state(&self) -> GamesState<W::Snapshot> {
        let slot = |slot: usize| SlotState {
            episode: self.game.world.snapshot(slot),
            budget: self.game.budgets[slot].get(),
            start: self.start[slot].get(),
            so_far: self.so_far[slot],
            product: self.products[slot],
            actions: position(&self.game.streams[slot].actions),
            outcomes: position(&self.game.streams[slot].outcomes),
        };
        let slots = (0..self.game.slots()).map(slot).collect();
        GamesState { slots, budget_use: self.budget_use }
    }

    /// Continues from a state of a run with this seed.
    ///
    /// # Errors
    /// If the state is of other games; part of it may be in place then.
    pub fn restore(&mut self, state: &GamesState<W::Snapshot>, seed: u64) -> Result<(), Unfit> {
        if state.slots.len() != self.game.slots() {
            return Err(Unfit("the games'"));
        }
        for (slot, there) in state.slots.iter().enumerate() {
            let restored = self.game.world.restore(slot, there.episode);
            restored.map_err(|_| Unfit("the world's"))?;
            let refused = |_| Unfit("the budget's");
            self.game.budgets[slot] = Budget::remaining(there.budget).map_err(refused)?;
            self.start[slot] = Eta::new(there.start).map_err(refused)?;
            self.so_far[slot] = there.so_far;
            self.products[slot] = there.product;
            let index = slot as u64;
            self.game.streams[slot] = Streams {
                actions: stream_from(seed, Purpose::Actions, index, there.actions),
                outcomes: stream_from(seed, Purpose::Outcomes, index, there.outcomes),
            };
        }
        self.budget_use = state.budget_use;
        Ok(())
    }

    /// Mean undiscounted return of the episodes that ended in the last rollout; NaN if none did.
    pub fn mean_return(&self) -> f64 {
        self.finished.iter().map(|e| e.undiscounted).sum::<f64>() / self.finished.len() as f64
    }

    /// Mean length in steps of the episodes that ended in the last rollout; NaN if none did.
    pub fn mean_length(&self) -> f64 {
        self.finished.iter().map(|e| f64::from(e.steps)).sum::<f64>() / self.finished.len() as f64
    }

    /// Share of the finished episodes with this end.
    pub fn share(&self, end: End) -> f64 {
        let count = self.finished.iter().filter(|e| e.end == end).count();
        count as f64 / self.finished.len() as f64
    }
}
