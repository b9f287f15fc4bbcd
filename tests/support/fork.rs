//! The counterexample of `docs/game.md`, a world whose equilibria and optima are known.

use lava_envs::action::{Discrete, Finite, uniform_index};
use lava_envs::{
    Action, ConfigError, End, Field, FiniteLaw, FiniteModel, NoSuchState, Scene, Step, World,
};
use rand::Rng;
use serde::{Deserialize, Serialize};

/// The protagonist's choice in s1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bet {
    /// a1.
    Pass,
    /// a2.
    Gamble,
}

impl Action for Bet {
    type Kind = Finite<2>;

    fn uniform(random: &mut impl Rng) -> Bet {
        uniform_index(random)
    }
}

impl Discrete for Bet {
    const COUNT: usize = 2;

    fn index(self) -> usize {
        self as usize
    }

    fn from_index(index: usize) -> Bet {
        [Bet::Pass, Bet::Gamble][index]
    }
}

/// s0 goes to s1 or s2 with probability 1/2 each. In s1 passing pays 0, gambling -1 or 1.5 with
/// probability 1/2 each. s2 pays `safe`. The optimal CVaR_0.5 is 0, by passing.
#[derive(Debug, Clone)]
pub struct Fork {
    constants: Constants,
    slots: Vec<Place>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Constants {
    /// What s2 pays.
    pub safe: f64,
}

/// A state: s0, s1, s2 and the end.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Place {
    state: usize,
    time: u32,
}

const START: Place = Place { state: 0, time: 0 };
const OVER: usize = 3;

impl FiniteModel for Fork {
    fn states(&self) -> usize {
        4
    }
    fn start(&self) -> usize {
        0
    }
    fn actions(&self) -> usize {
        2
    }
    fn outcomes(&self) -> usize {
        2
    }
    fn ended(&self, state: usize) -> Option<End> {
        (state == OVER).then_some(End::Goal)
    }
    fn probabilities(&self, _: usize, _: usize) -> Vec<f64> {
        vec![0.5, 0.5]
    }
    fn successor(&self, state: usize, action: usize, outcome: usize) -> (usize, Step) {
        let pays = |reward| (OVER, Step { reward, end: Some(End::Goal) });
        match (state, action) {
            (0, _) => (1 + outcome, Step { reward: 0.0, end: None }),
            (1, 0) => pays(0.0),
            (1, _) => pays([-1.0, 1.5][outcome]),
            (2, _) => pays(self.constants.safe),
            _ => (OVER, Step::IDLE),
        }
    }
    fn intended_outcome(&self, _: usize) -> Option<usize> {
        None
    }
    fn action_name(&self, action: usize) -> &'static str {
        ["pass", "gamble"][action]
    }
    fn arrow(&self, _: usize) -> [f64; 2] {
        [1.0, 0.0]
    }
    fn coordinates(&self, state: usize) -> [usize; 2] {
        [state, 0]
    }
    fn state(&self, slot: usize) -> usize {
        self.slots[slot].state
    }
    fn is_over(&self, slot: usize) -> bool {
        self.slots[slot].state == OVER
    }
    fn place(&mut self, slot: usize, state: usize, time: u32) {
        assert!(state <= OVER);
        self.slots[slot] = Place { state, time };
    }
}

impl World for Fork {
    type Constants = Constants;
    type Action = Bet;
    type Law = FiniteLaw<2>;
    type Snapshot = Place;
    const NAME: &'static str = "fork";
    const DEFAULTS: &'static str = "# What s2 pays.\nsafe = 0.9\n";
    const OBSERVATION: usize = 2;
    const SITUATION: usize = 3;

    fn new(constants: &Constants, episodes: usize) -> Result<Self, ConfigError> {
        Ok(Fork { constants: constants.clone(), slots: vec![START; episodes] })
    }
    fn constants(&self) -> &Constants {
        &self.constants
    }
    fn validate(_: &Constants) -> Result<(), ConfigError> {
        Ok(())
    }
    fn episodes(&self) -> usize {
        self.slots.len()
    }
    fn return_range(&self, _: f64) -> Option<[f64; 2]> {
        Some([-1.0, self.constants.safe.max(1.5)])
    }
    fn horizon(&self) -> u32 {
        3
    }
    fn reset(&mut self, slot: usize) {
        self.slots[slot] = START;
    }
    fn snapshot(&self, slot: usize) -> Place {
        self.slots[slot]
    }
    fn restore(&mut self, slot: usize, snapshot: Place) -> Result<(), NoSuchState> {
        if snapshot.state > OVER {
            return Err(NoSuchState(snapshot.state.to_string()));
        }
        self.slots[slot] = snapshot;
        Ok(())
    }
    fn time(&self, slot: usize) -> u32 {
        self.slots[slot].time
    }
    fn observe(&self, slot: usize, observation: &mut [f32]) {
        let state = self.slots[slot].state;
        observation.copy_from_slice(&[f32::from(state == 1), f32::from(state == 2)]);
    }
    fn law(&self, _: usize, _: Bet) -> FiniteLaw<2> {
        FiniteLaw { probabilities: [0.5, 0.5] }
    }
    fn situation(&self, slot: usize, action: Bet, situation: &mut [f32]) {
        self.observe(slot, &mut situation[..2]);
        situation[2] = f32::from(action == Bet::Gamble);
    }
    fn clearance(&self, _: usize) -> f64 {
        f64::INFINITY
    }
    fn position(&self, slot: usize) -> [f64; 2] {
        [self.slots[slot].state as f64, 0.0]
    }
    fn scene(&self) -> Scene {
        let (size, start, areas) = ([4.0, 1.0], [0.0, 0.0], Vec::new());
        Scene { size, cells: true, start, areas, rules: String::new() }
    }
    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)> {
        vec![("state", Field::Count(self.slots[slot].state as u64))]
    }
    fn action_columns(action: Bet) -> Vec<(&'static str, Field)> {
        vec![("action", Field::Count(action.index() as u64))]
    }
    fn outcome_columns(outcome: usize) -> Vec<(&'static str, Field)> {
        vec![("outcome", Field::Count(outcome as u64))]
    }
    fn action_arrow(_: Bet) -> [f64; 2] {
        [1.0, 0.0]
    }
    fn outcome_arrow(_: usize) -> [f64; 2] {
        [1.0, 0.0]
    }
    fn finite(&self) -> Option<&dyn FiniteModel> {
        Some(self)
    }
    fn finite_mut(&mut self) -> Option<&mut dyn FiniteModel> {
        Some(self)
    }
    fn apply(&mut self, actions: &[Bet], outcomes: &[usize], steps: &mut [Step]) {
        for slot in 0..self.slots.len() {
            let Place { state, time } = self.slots[slot];
            if state == OVER {
                steps[slot] = Step::IDLE;
                continue;
            }
            let (next, step) = self.successor(state, actions[slot].index(), outcomes[slot]);
            self.slots[slot] = Place { state: next, time: time + 1 };
            steps[slot] = step;
        }
    }
}

/// Forks in so many slots.
pub fn fork(safe: f64, slots: usize) -> Fork {
    Fork::new(&Constants { safe }, slots).unwrap()
}
