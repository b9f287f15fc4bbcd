//! A batch of games of one world, whatever its type: what environments and players of Python step.
//!
//! Outcomes come from the streams of the evaluation: the k-th episode of a slot with seed s meets the chance of
//! episode k of `cvar-game rollout --seed s`.

use crate::adversary::Adversary;
use crate::values::{ActionArray, KindOf, LawArray, Playable, Values};
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::learn::inputs::{Columns, Inputs};
use cvar_game::learn::observation::Observation;
use cvar_game::learn::options::View;
use cvar_game::learn::policy::{Draw, Mode, Policy, Situation, Streams};
use cvar_game::learn::vector_game::VectorGame;
use lava_envs::random::{Purpose, position, restart, stream, stream_from};
use lava_envs::{End, World};
use serde::{Deserialize, Serialize};

/// What happens to an episode that has ended, as in Gymnasium.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Autoreset {
    /// The next step starts a new one.
    NextStep,
    /// The step that ends it starts a new one.
    SameStep,
    /// It waits for a reset.
    Disabled,
}

/// How a batch is made.
#[derive(Debug, Clone, Copy)]
pub struct Setup {
    /// Number of slots.
    pub slots: usize,
    /// How the protagonist sees the world.
    pub view: View,
    /// Whether it sees the time.
    pub time: bool,
    /// Budget.
    pub eta: Eta,
}

/// What a step gave; vectors have an entry, or a row, per slot.
pub struct Stepped {
    /// What the protagonist sees now.
    pub observation: Vec<f32>,
    /// Rewards.
    pub reward: Vec<f64>,
    /// Whether the episode has ended.
    pub terminated: Vec<bool>,
    /// Distance to lava now.
    pub clearance: Vec<f64>,
    /// Slots in which an episode began, if there is one. Their [`Stepped::more`] is 0.
    pub began: Option<Vec<bool>>,
    /// What is told of the step, if it is asked for.
    pub more: Option<More>,
    /// With [`Autoreset::SameStep`], what the ended episodes ended with, if one has; 0 in other slots.
    pub last: Option<Last>,
}

/// What is told of a step.
#[derive(Clone)]
pub struct More {
    /// How the episode has ended: 0 not yet, 1 goal, 2 lava, 3 time limit.
    pub end: Vec<i64>,
    /// The realised outcomes.
    pub outcome: Values,
    /// Nominal probabilities of all outcomes, where they are finitely many.
    pub nominal: Option<Values>,
    /// Likelihood ratios of the outcomes.
    pub ratio: Vec<f64>,
    /// Budgets after the step.
    pub budget: Vec<f64>,
}

impl More {
    /// Puts 0 into the slots that are not to be kept.
    fn keep(&mut self, keep: impl Fn(usize) -> bool) {
        let values = |of: &mut Values, slot: usize| match of {
            Values::Indices(indices) => indices[slot] = 0,
            Values::Rows(rows, width) => rows[slot * *width..][..*width].fill(0.0),
        };
        for slot in (0..self.end.len()).filter(|&slot| !keep(slot)) {
            self.end[slot] = 0;
            values(&mut self.outcome, slot);
            self.nominal.iter_mut().for_each(|nominal| values(nominal, slot));
            self.ratio[slot] = 0.0;
            self.budget[slot] = 0.0;
        }
    }
}

/// The ends of episodes that new ones have followed in the same step.
pub struct Last {
    /// What the protagonist saw at the end.
    pub observation: Vec<f32>,
    /// Distance to lava at the end.
    pub clearance: Vec<f64>,
    /// What is told of the last step, if it is asked for.
    pub more: Option<More>,
}

/// A batch of games.
pub trait AnyGames: Send {
    /// Width of an observation.
    fn observation_size(&self) -> usize;

    /// Width of the antagonist's observation.
    fn situation_size(&self) -> usize;

    /// Number of parameters of a perturbation.
    fn parameters(&self) -> usize;

    /// Starts episodes in some slots: the first ones of these seeds, or each slot's next one.
    fn reset(&mut self, slots: &[usize], seeds: Option<&[u64]>);

    /// What the protagonist sees, shape `[slots, observation_size]`.
    fn observe(&mut self) -> Vec<f32>;

    /// Distance to lava in each slot.
    fn clearance(&self) -> Vec<f64>;

    /// Position in each slot, shape `[slots, 2]`.
    fn positions(&self) -> Vec<f64>;

    /// The index of each slot's state in a finite world.
    fn states(&self) -> Option<Vec<i64>>;

    /// Steps since each slot's reset.
    fn times(&self) -> Vec<i64>;

    /// What the antagonist sees once these actions are chosen, shape `[slots, situation_size]`.
    ///
    /// # Errors
    /// If the actions are none.
    fn situation(&mut self, actions: &Values) -> Result<Vec<f32>, String>;

    /// One step of every slot. `parameters` are those of the perturbations, shape `[slots, parameters]`, where
    /// Python plays the antagonist; `tells` asks for [`Stepped::more`].
    ///
    /// # Errors
    /// If the actions or parameters are none, or an episode has ended and waits for a reset.
    fn step(
        &mut self,
        actions: &Values,
        parameters: Option<&[f32]>,
        autoreset: Autoreset,
        tells: bool,
    ) -> Result<Stepped, String>;

    /// All that the rest of a slot's episode depends on.
    fn snapshot(&self, slot: usize) -> Vec<u8>;

    /// Puts a slot where a snapshot was taken.
    ///
    /// # Errors
    /// If it is no snapshot of this world.
    fn restore(&mut self, slot: usize, snapshot: &[u8]) -> Result<(), String>;
}

/// A batch of games in the world `W`.
pub struct Games<W: Playable> {
    game: VectorGame<W>,
    eyes: Observation,
    inputs: Inputs,
    adversary: Adversary<W>,
    eta: Eta,
    /// Seed and number of the current episode, by slot.
    episodes: Vec<(u64, u64)>,
    /// Slots whose episode has ended.
    over: Vec<bool>,
}

/// The protagonist of a step: actions that are chosen elsewhere.
struct Chosen<'a, A>(&'a [A]);

impl<W: World> Policy<W> for Chosen<'_, W::Action> {
    fn choose(&mut self, _: &W, _: Mode, _: &mut [Streams], actions: &mut Vec<W::Action>) {
        actions.extend_from_slice(self.0);
    }

    fn probabilities(&mut self, _: &W) -> Option<Vec<f64>> {
        None
    }

    fn sees_time(&self) -> bool {
        true
    }
}

/// A slot's snapshot.
#[derive(Serialize, Deserialize)]
struct Snapshot<S> {
    world: String,
    state: S,
    budget: f64,
    episode: (u64, u64),
    position: u128,
    over: bool,
}

impl<W: Playable> Games<W> {
    /// Games in a world with these constants, each slot with its number as its seed.
    ///
    /// # Errors
    /// If a constant is out of range.
    pub fn new(
        constants: &W::Constants,
        setup: Setup,
        adversary: Adversary<W>,
    ) -> Result<Self, String> {
        let Setup { slots, view, time, eta } = setup;
        let world = W::new(constants, slots).map_err(|error| error.to_string())?;
        let eyes = Observation::of_view(&world, view, time, eta);
        let streams = (0..slots as u64).map(|seed| streams(seed, 0)).collect();
        let mut games = Games {
            game: VectorGame::new(world, streams),
            eyes,
            inputs: Inputs::default(),
            adversary,
            eta,
            episodes: (0..slots as u64).map(|seed| (seed, 0)).collect(),
            over: vec![false; slots],
        };
        (0..slots).for_each(|slot| games.game.start(slot, eta));
        Ok(games)
    }

    fn start(&mut self, slot: usize, seed: u64) {
        self.episodes[slot] = (seed, 0);
        self.game.start(slot, self.eta);
        self.game.streams[slot].outcomes = stream(seed, Purpose::EvaluationOutcomes, 0);
        self.over[slot] = false;
    }

    fn start_next(&mut self, slot: usize) {
        let (_, episode) = &mut self.episodes[slot];
        *episode += 1;
        self.game.start(slot, self.eta);
        restart(&mut self.game.streams[slot].outcomes, Purpose::EvaluationOutcomes, *episode);
        self.over[slot] = false;
    }
}

fn streams(seed: u64, episode: u64) -> Streams {
    Streams {
        actions: stream(seed, Purpose::EvaluationActions, episode),
        outcomes: stream(seed, Purpose::EvaluationOutcomes, episode),
    }
}

/// What a player sees as rows of numbers: cells as their one-hot code, without what only a critic sees.
pub fn dense(inputs: &Inputs, columns: Columns) -> Vec<f32> {
    let Columns { cells, numbers, critic_only } = columns;
    let seen = numbers - critic_only;
    let width = cells + seen;
    let mut rows = vec![0.0; inputs.numbers.len() / (numbers + 1) * width];
    let pairs = rows.chunks_exact_mut(width).zip(inputs.numbers.chunks_exact(numbers + 1));
    for (slot, (row, numbers)) in pairs.enumerate() {
        if let Some(&cell) = inputs.cells.get(slot) {
            row[cell as usize] = 1.0;
        }
        row[cells..].copy_from_slice(&numbers[..seen]);
    }
    rows
}

/// The inverse of [`dense`], with 0 for what only a critic sees.
///
/// # Errors
/// If the rows are of another width, not finite, or of no cell.
pub fn sparse(rows: &[f32], width: usize, columns: Columns) -> Result<Inputs, String> {
    let Columns { cells, numbers, critic_only } = columns;
    let expected = cells + numbers - critic_only;
    if width != expected {
        return Err(format!("observations must have width {expected}, got {width}"));
    }
    if rows.iter().any(|number| !number.is_finite()) {
        return Err("an observation is not finite".to_owned());
    }
    let mut inputs = Inputs::default();
    for row in rows.chunks_exact(width) {
        let (code, seen) = row.split_at(cells);
        if cells > 0 {
            let cell = code.iter().position(|&entry| entry == 1.0);
            let one_hot = code.iter().sum::<f32>() == 1.0;
            let cell = cell.filter(|_| one_hot).ok_or_else(|| {
                format!("the first {cells} numbers of an observation must be one-hot: the state")
            })?;
            inputs.cells.push(cell as u32);
        }
        inputs.numbers.extend_from_slice(seen);
        inputs.numbers.extend(std::iter::repeat_n(0.0, critic_only).chain([1.0]));
    }
    Ok(inputs)
}

impl<W: Playable> AnyGames for Games<W> {
    fn observation_size(&self) -> usize {
        let Columns { cells, numbers, critic_only } = self.eyes.protagonist_columns::<W>();
        cells + numbers - critic_only
    }

    fn situation_size(&self) -> usize {
        let Columns { cells, numbers, .. } = self.eyes.antagonist_columns::<W>();
        cells + numbers
    }

    fn parameters(&self) -> usize {
        self.adversary.parameters()
    }

    fn reset(&mut self, slots: &[usize], seeds: Option<&[u64]>) {
        for (i, &slot) in slots.iter().enumerate() {
            match seeds {
                Some(seeds) => self.start(slot, seeds[i]),
                None => self.start_next(slot),
            }
        }
    }

    fn observe(&mut self) -> Vec<f32> {
        self.eyes.protagonist(&self.game.world, &mut self.inputs);
        dense(&self.inputs, self.eyes.protagonist_columns::<W>())
    }

    fn clearance(&self) -> Vec<f64> {
        (0..self.over.len()).map(|slot| self.game.world.clearance(slot)).collect()
    }

    fn positions(&self) -> Vec<f64> {
        (0..self.over.len()).flat_map(|slot| self.game.world.position(slot)).collect()
    }

    fn states(&self) -> Option<Vec<i64>> {
        let model = self.game.world.finite()?;
        Some((0..self.over.len()).map(|slot| model.state(slot) as i64).collect())
    }

    fn times(&self) -> Vec<i64> {
        (0..self.over.len()).map(|slot| i64::from(self.game.world.time(slot))).collect()
    }

    fn situation(&mut self, actions: &Values) -> Result<Vec<f32>, String> {
        let actions = KindOf::<W>::read(actions, self.over.len())?;
        let world = &self.game.world;
        let laws: Vec<W::Law> =
            actions.iter().enumerate().map(|(slot, &action)| world.law(slot, action)).collect();
        let budgets = &self.game.budgets;
        let situation = Situation { world, actions: &actions, laws: &laws, budgets };
        self.eyes.antagonist(&situation, &mut self.inputs);
        Ok(dense(&self.inputs, self.eyes.antagonist_columns::<W>()))
    }

    fn step(
        &mut self,
        actions: &Values,
        parameters: Option<&[f32]>,
        autoreset: Autoreset,
        tells: bool,
    ) -> Result<Stepped, String> {
        let actions = KindOf::<W>::read(actions, self.over.len())?;
        if let (Autoreset::Disabled, Some(slot)) =
            (autoreset, self.over.iter().position(|over| *over))
        {
            return Err(format!("the episode of slot {slot} has ended; reset it first"));
        }
        let Games { game, adversary, over, .. } = self;
        game.idle.copy_from_slice(over);
        adversary.act(parameters, over.len(), |opponent| {
            game.step(&mut Chosen(&actions), Mode::Greedy, opponent, Draw::Perturbed);
        })?;
        let waited = over.clone();
        let end = |end: Option<End>| match end {
            None => 0,
            Some(End::Goal) => 1,
            Some(End::Lava) => 2,
            Some(End::Timeout) => 3,
        };
        let steps = self.game.steps.iter();
        let reward = steps.clone().map(|step| step.reward).collect();
        let terminated: Vec<bool> = steps.clone().map(|step| step.end.is_some()).collect();
        let mut more = tells.then(|| More {
            end: steps.map(|step| end(step.end)).collect(),
            outcome: W::Law::outcomes(&self.game.outcomes),
            nominal: W::Law::probabilities(&self.game.laws),
            ratio: self.game.ratios.clone(),
            budget: self.game.budgets.iter().map(|budget| budget.get()).collect(),
        });
        self.over.copy_from_slice(&terminated);
        let mut last = None;
        let began = match autoreset {
            Autoreset::SameStep => terminated.clone(),
            Autoreset::NextStep | Autoreset::Disabled => waited,
        };
        let began = began.contains(&true).then_some(began);
        if let Some(began) = &began {
            if autoreset == Autoreset::SameStep {
                let mut clearance = self.clearance();
                clearance
                    .iter_mut()
                    .zip(began)
                    .filter(|(_, ends)| !**ends)
                    .for_each(|(of, _)| *of = 0.0);
                let observation = self.observe();
                let mut more = more.clone();
                more.iter_mut().for_each(|more| more.keep(|slot| began[slot]));
                last = Some(Last { observation, clearance, more });
            }
            more.iter_mut().for_each(|more| more.keep(|slot| !began[slot]));
            for slot in (0..began.len()).filter(|&slot| began[slot]) {
                self.start_next(slot);
            }
        }
        let (observation, clearance) = (self.observe(), self.clearance());
        Ok(Stepped { observation, reward, terminated, clearance, began, more, last })
    }

    fn snapshot(&self, slot: usize) -> Vec<u8> {
        let snapshot = Snapshot {
            world: W::NAME.to_owned(),
            state: self.game.world.snapshot(slot),
            budget: self.game.budgets[slot].get(),
            episode: self.episodes[slot],
            position: position(&self.game.streams[slot].outcomes),
            over: self.over[slot],
        };
        postcard::to_stdvec(&snapshot).expect("plain data has bytes")
    }

    fn restore(&mut self, slot: usize, snapshot: &[u8]) -> Result<(), String> {
        let foreign = || format!("not a snapshot of a slot of {} with these constants", W::NAME);
        let snapshot: Snapshot<W::Snapshot> =
            postcard::from_bytes(snapshot).map_err(|_| foreign())?;
        let budget = Budget::remaining(snapshot.budget).map_err(|_| foreign())?;
        if snapshot.world != W::NAME {
            return Err(foreign());
        }
        self.game.world.restore(slot, snapshot.state).map_err(|_| foreign())?;
        let (seed, episode) = snapshot.episode;
        self.game.budgets[slot] = budget;
        self.game.streams[slot].outcomes =
            stream_from(seed, Purpose::EvaluationOutcomes, episode, snapshot.position);
        self.episodes[slot] = (seed, episode);
        self.over[slot] = snapshot.over;
        Ok(())
    }
}
