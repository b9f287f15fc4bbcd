//! A policy on a finite world as a table of action probabilities: what exact yardsticks take, from any
//! method or program.

use super::ExactError;
use super::finite::ExactWorld;
use super::policy::{Policy, likeliest};
use lava_envs::{ConfigError, World};

/// Action probabilities by state, or by time and state.
#[derive(Debug, Clone, PartialEq)]
pub struct TablePolicy {
    states: usize,
    actions: usize,
    /// Shape `[times, states, actions]`; a policy that does not see the time has one.
    probabilities: Vec<f64>,
    timed: bool,
}

impl TablePolicy {
    /// A policy that does not see the time, from probabilities of shape `[states, actions]`. Rows of
    /// states in which the episode has ended are ignored.
    ///
    /// # Panics
    /// If the list is not as long as its shape says.
    pub fn stationary(states: usize, actions: usize, probabilities: Vec<f64>) -> Self {
        assert_eq!(probabilities.len(), states * actions, "a row of probabilities per state");
        TablePolicy { states, actions, probabilities, timed: false }
    }

    /// A policy that sees the time, from probabilities of shape `[times, states, actions]` with an
    /// entry for every time below the time limit.
    ///
    /// # Panics
    /// If the list is not a whole number of times long.
    pub fn timed(states: usize, actions: usize, probabilities: Vec<f64>) -> Self {
        let whole = probabilities.len().is_multiple_of(states * actions);
        assert!(whole, "a row of probabilities per time and state");
        TablePolicy { states, actions, probabilities, timed: true }
    }

    /// The table of a policy that is given as a function of time and state, shape `[actions]`; a
    /// policy that does not see the time is asked only at time 0.
    pub fn from_fn(
        [states, actions]: [usize; 2],
        times: Option<u32>,
        mut probabilities: impl FnMut(u32, usize) -> Vec<f64>,
    ) -> Self {
        let mut all = Vec::new();
        for time in 0..times.unwrap_or(1) {
            for state in 0..states {
                let row = probabilities(time, state);
                assert_eq!(row.len(), actions, "a probability per action");
                all.extend(row);
            }
        }
        TablePolicy { states, actions, probabilities: all, timed: times.is_some() }
    }

    /// The table of a policy that looks at worlds. `ask` receives a world with one slot per state, each
    /// slot in its state, and answers with the probabilities of the actions in every slot, shape
    /// `[slots, actions]`; a policy that sees the time is asked once for each time, another one once.
    /// `None` if the world is not finite or `ask` has no answer.
    ///
    /// # Errors
    /// If a constant is out of range.
    pub fn ask<W: World>(
        constants: &W::Constants,
        sees_time: bool,
        mut ask: impl FnMut(&W) -> Option<Vec<f64>>,
    ) -> Result<Option<TablePolicy>, ConfigError> {
        let one = W::new(constants, 1)?;
        let Some([states, actions]) = one.finite().map(|model| [model.states(), model.actions()])
        else {
            return Ok(None);
        };
        let mut world = W::new(constants, states)?;
        let mut probabilities = Vec::new();
        for time in 0..if sees_time { world.horizon() } else { 1 } {
            let Some(model) = world.finite_mut() else { return Ok(None) };
            (0..states).for_each(|state| model.place(state, state, time));
            let Some(answer) = ask(&world) else { return Ok(None) };
            assert_eq!(answer.len(), states * actions, "a row of probabilities per slot");
            probabilities.extend(answer);
        }
        Ok(Some(TablePolicy { states, actions, probabilities, timed: sees_time }))
    }

    /// Whether the policy sees the time.
    pub fn sees_time(&self) -> bool {
        self.timed
    }

    /// The probabilities of the actions at a time in a state, shape `[actions]`.
    ///
    /// # Panics
    /// If there is no such time or state.
    pub fn probabilities(&self, time: u32, state: usize) -> &[f64] {
        assert!(state < self.states, "state {state} of {}", self.states);
        let time = if self.timed { time as usize } else { 0 };
        &self.probabilities[(time * self.states + state) * self.actions..][..self.actions]
    }

    /// The likeliest action at a time in a state, the first one among equals.
    ///
    /// # Panics
    /// If there is no such time or state.
    pub fn greedy_action(&self, time: u32, state: usize) -> usize {
        likeliest(self.probabilities(time, state))
    }

    /// The same policy on an exact world.
    ///
    /// # Errors
    /// If the table does not have the world's shape, or a row is no law.
    pub fn on<W: World>(&self, world: &ExactWorld<W>) -> Result<Policy, ExactError> {
        let [states, actions] = [world.mdp().states(), world.model().actions()];
        let times = if self.timed { world.mdp().horizon() } else { 1 };
        let here = [self.probabilities.len() / (self.states * self.actions).max(1), self.states];
        if here != [times, states] || self.actions != actions {
            return Err(ExactError::Table {
                found: [here[0], self.states, self.actions],
                expected: [times, states, actions],
            });
        }
        if self.timed {
            world.timed_policy(|time, state| self.probabilities(time, state))
        } else {
            world.stationary_policy(|state| self.probabilities(0, state))
        }
    }
}
