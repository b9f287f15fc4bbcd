//! Rollouts: a fixed number of steps of parallel games, recorded for both players.

use crate::arena::Arena;
use crate::checkpoint::{GamesState, Running, SlotState, Unfit};
use crate::contest::{Chance, Choosing, Contest, Streams};
use crate::head::{AntagonistHead, Head};
use crate::pair::Pair;
use crate::trajectories::Trajectories;
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::game::returns::Atom;
use cvar_game::options::{Credit, TrainOptions};
use lava_envs::random::{Purpose, position, stream, stream_from};
use lava_envs::{End, Law};

/// Plays and records.
pub struct Collector<W: Arena> {
    contest: Contest<W>,
    /// The budget that each slot's episode started with; it differs while the budget rises.
    start: Vec<Eta>,
    running: Vec<Running>,
    gamma: f64,
    /// What the protagonist recorded in the last rollout.
    pub protagonist: Trajectories<W::Policy>,
    /// What the antagonist recorded; empty if it took no part.
    pub antagonist: Trajectories<AntagonistHead<W::Family>>,
    /// Episodes that ended in the last rollout, their masses of no meaning.
    pub finished: Vec<Atom>,
    /// max prod delta / eta over all trajectories so far, at most 1 up to rounding.
    pub budget_use: f64,
}

impl<W: Arena> Collector<W> {
    /// Games in all slots of `world`, not yet started.
    pub fn new(world: W, pair: &Pair<W>, gamma: f64, seed: u64) -> Self {
        let slots = world.episodes();
        let streams = (0..slots as u64)
            .map(|slot| Streams {
                actions: stream(seed, Purpose::Actions, slot),
                outcomes: stream(seed, Purpose::Outcomes, slot),
            })
            .collect();
        let mut contest = Contest::new(world, streams, &pair.views);
        for slot in 0..slots {
            contest.start(slot, Eta::NEUTRAL);
        }
        Collector {
            contest,
            start: vec![Eta::NEUTRAL; slots],
            running: vec![Running::START; slots],
            gamma,
            protagonist: Trajectories::new(slots),
            antagonist: Trajectories::new(slots),
            finished: Vec::new(),
            budget_use: 0.0,
        }
    }

    /// Plays the steps of a rollout in every slot; episodes that end are followed by new ones. New
    /// episodes start with budget `eta`; a game at budget 1 is played without the antagonist.
    pub fn collect(
        &mut self,
        pair: &Pair<W>,
        eta: Eta,
        choosing: Choosing,
        options: &TrainOptions,
    ) {
        self.protagonist.clear();
        self.antagonist.clear();
        self.finished.clear();
        let chance = if eta.is_neutral() { Chance::Nominal } else { Chance::Antagonist };
        for slot in 0..self.contest.slots() {
            // No step was made yet: the episode has this budget as well.
            if self.contest.world.time(slot) == 0 {
                self.begin(slot, eta);
            }
        }
        for _ in 0..options.rollout_steps {
            self.contest.step(pair, choosing, &chance);
            self.record_protagonist(pair, options.credit);
            if !eta.is_neutral() {
                self.record_antagonist();
            }
            for slot in 0..self.contest.slots() {
                self.count(slot, eta);
            }
        }
        // The states after the last step. The antagonist's state holds an action: one is drawn for
        // this purpose alone, which leaves its value unbiased.
        self.contest.choose(&pair.protagonist, &pair.views, choosing);
        self.protagonist.inputs.extend_from_slice(&self.contest.protagonist_inputs);
        if !eta.is_neutral() {
            self.contest.show_antagonist(&pair.views);
            self.antagonist.inputs.extend_from_slice(&self.contest.antagonist_inputs);
        }
    }

    fn begin(&mut self, slot: usize, eta: Eta) {
        self.contest.start(slot, eta);
        self.start[slot] = eta;
        self.running[slot] = Running::START;
    }

    fn record_protagonist(&mut self, pair: &Pair<W>, credit: Credit) {
        let contest = &self.contest;
        let record = &mut self.protagonist;
        record.inputs.extend_from_slice(&contest.protagonist_inputs);
        for slot in 0..contest.slots() {
            let choice = match credit {
                Credit::Chosen => None,
                Credit::Executed => W::executed(contest.outcomes[slot]),
            }
            .unwrap_or(contest.actions[slot]);
            let parameters = pair.protagonist.parameters_in(&contest.protagonist_outputs, slot);
            let log_probability = pair.protagonist.head.log_probability(&parameters, &(), &choice);
            record.given.push(());
            record.choices.push(choice);
            record.log_probabilities.push(log_probability);
            record.rewards.push(contest.steps[slot].reward as f32);
            record.ended.push(contest.steps[slot].end.is_some());
        }
    }

    fn record_antagonist(&mut self) {
        let contest = &self.contest;
        let record = &mut self.antagonist;
        record.inputs.extend_from_slice(&contest.antagonist_inputs);
        for slot in 0..contest.slots() {
            let (law, outcome) = (contest.laws[slot], contest.outcomes[slot]);
            record.given.push((law, contest.budgets_before[slot]));
            record.choices.push(outcome);
            // The antagonist's law is the perturbed law: log(P_t(o) delta_t(o)).
            record.log_probabilities.push(law.log_density(outcome) + contest.ratios[slot].ln());
            record.rewards.push(-contest.steps[slot].reward as f32);
            record.ended.push(contest.steps[slot].end.is_some());
        }
    }

    /// Books the last step of a slot, and begins anew behind the end of an episode.
    fn count(&mut self, slot: usize, eta: Eta) {
        let step = self.contest.steps[slot];
        let running = &mut self.running[slot];
        running.value += running.discount * step.reward;
        running.undiscounted += step.reward;
        running.discount *= self.gamma;
        running.steps += 1;
        running.product *= self.contest.ratios[slot];
        if let Some(end) = step.end {
            let Running { value, undiscounted, steps, product, .. } = *running;
            self.finished.push(Atom { value, undiscounted, steps, end, mass: 1.0 });
            self.budget_use = self.budget_use.max(product / self.start[slot].get());
            self.begin(slot, eta);
        }
    }

    /// All that the next rollouts depend on beside the players.
    pub fn state(&self) -> GamesState<W::Snapshot> {
        let slot = |slot: usize| SlotState {
            episode: self.contest.world.snapshot(slot),
            budget: self.contest.budgets[slot].get(),
            start: self.start[slot].get(),
            running: self.running[slot],
            actions: position(&self.contest.streams[slot].actions),
            outcomes: position(&self.contest.streams[slot].outcomes),
        };
        let slots = (0..self.contest.slots()).map(slot).collect();
        GamesState { slots, budget_use: self.budget_use }
    }

    /// Goes on from a state of a run with this seed.
    ///
    /// # Errors
    /// If the state is of other games; part of it may be in place then.
    pub fn restore(&mut self, state: &GamesState<W::Snapshot>, seed: u64) -> Result<(), Unfit> {
        if state.slots.len() != self.contest.slots() {
            return Err(Unfit("the games'"));
        }
        for (slot, there) in state.slots.iter().enumerate() {
            let restored = self.contest.world.restore(slot, there.episode);
            restored.map_err(|_| Unfit("the world's"))?;
            let refused = |_| Unfit("the budget's");
            self.contest.budgets[slot] = Budget::remaining(there.budget).map_err(refused)?;
            self.start[slot] = Eta::new(there.start).map_err(refused)?;
            self.running[slot] = there.running;
            let index = slot as u64;
            self.contest.streams[slot] = Streams {
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

    /// Share of the ended episodes that ended so.
    pub fn share(&self, end: End) -> f64 {
        let count = self.finished.iter().filter(|e| e.end == end).count();
        count as f64 / self.finished.len() as f64
    }
}
