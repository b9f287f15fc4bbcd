//! What the players of the game see.
//!
//! The protagonist sees the world's observation, and the time if it is time-aware, but not the budget:
//! given the budget it would solve Chow's decomposition, which is not CVaR-optimal. The antagonist
//! sees the situation after the action was chosen, its remaining budget as log eta_t / log eta, and
//! the time if it is time-aware. In the game `joint` its half before the draw sees what the protagonist sees,
//! its budget and the time likewise. Every row ends with the constant 1 of the networks' biases.
//!
//! The protagonist's critic plays no part but in training, and may then see all that its value depends on
//! ([`CriticSees::Game`], an asymmetric actor-critic: Pinto and others 2018): the remaining budget and the time.
//! A critic that sees neither takes a state that is reached late, or after the antagonist has spent its budget,
//! for the same state early, and makes waiting look like progress.
//!
//! As coordinates ([`View::Coordinates`], the paper's) these are a few numbers, in which a small network
//! cannot turn sharply from one place to the next. As features ([`View::Features`]) they are
//!
//! | | protagonist | antagonist |
//! |---|---|---|
//! | finite world | the state, one-hot | state and action together, one-hot |
//! | any other | the observation, and a Fourier basis of its position | the situation likewise |
//! | time | t, and a Fourier basis of it | the same |
//!
//! The Fourier basis of a coordinate c in [-1, 1] is `sin(k pi (c+1)/2), cos(k pi (c+1)/2)` with
//! k = 1, 2, 4: octaves from half a wave per arena (Konidaris, Osentoski & Thomas 2011, with sines beside
//! the cosines, one coordinate at a time).

use super::arena::Arena;
use super::head::HeadOf;
use super::inputs::{Columns, Inputs};
use super::options::{CriticSees, TrainOptions, View};
use super::policy::{DrawSituation, Situation};
use crate::game::budget::{Budget, Eta};
use crate::game::columns::logarithms;
use lava_envs::{Action, World};
use std::f32::consts::FRAC_PI_2;
use std::ops::Range;

/// Octaves of the Fourier basis.
const OCTAVES: usize = 3;

/// Numbers of a coordinate's Fourier basis.
const WAVES: usize = 2 * OCTAVES;

/// What the players of a game see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    view: View,
    /// States and actions of a world that is shown by its states; 0 for any other.
    states: usize,
    actions: usize,
    protagonist_time: bool,
    antagonist_time: bool,
    /// Whether the protagonist's critic sees the time and the budget.
    critic_sees_game: bool,
    /// 1 / log eta, or 0 at eta = 1.
    budget_scale: f64,
    /// The same for the antagonist, or 0 where the budget is hidden from it.
    antagonist_budget_scale: f64,
}

impl Observation {
    /// What the players of a game with these options see of a world.
    pub fn new<W: World>(world: &W, options: &TrainOptions, eta: Eta) -> Self {
        let own = Self::of_view(world, options.observation, options.protagonist.time_aware, eta);
        let antagonist_budget_scale = if options.hide_budget { 0.0 } else { own.budget_scale };
        Observation {
            antagonist_time: options.antagonist.time_aware,
            critic_sees_game: options.critic_sees == CriticSees::Game,
            antagonist_budget_scale,
            ..own
        }
    }

    /// What two players see who both see the time, or do not, and whose critics see the same.
    pub fn of_view<W: World>(world: &W, view: View, time_aware: bool, eta: Eta) -> Self {
        let budget_scale = if eta.is_neutral() { 0.0 } else { 1.0 / eta.get().ln() };
        let finite = match view {
            View::Coordinates => None,
            View::Features => world.finite(),
        };
        Observation {
            view,
            states: finite.map_or(0, |of| of.states()),
            actions: finite.map_or(0, |of| of.actions()),
            protagonist_time: time_aware,
            antagonist_time: time_aware,
            critic_sees_game: false,
            budget_scale,
            antagonist_budget_scale: budget_scale,
        }
    }

    /// Whether the protagonist sees the time.
    pub fn protagonist_sees_time(&self) -> bool {
        self.protagonist_time
    }

    /// Whether the antagonist sees the time.
    pub fn antagonist_sees_time(&self) -> bool {
        self.antagonist_time
    }

    /// Sizes of what the protagonist sees.
    pub fn protagonist_columns<W: World>(&self) -> Columns {
        let place = self.place_columns::<W>(W::OBSERVATION);
        let critic_only = self.critic_columns();
        let numbers = place + self.time_columns(self.protagonist_time) + critic_only;
        Columns { cells: self.states, numbers, critic_only }
    }

    /// Numbers that only the protagonist's critic sees: the budget, and the time unless the protagonist sees
    /// it as well.
    fn critic_columns(&self) -> usize {
        let game = self.critic_sees_game;
        usize::from(game) + self.time_columns(game && !self.protagonist_time)
    }

    /// Sizes of what the antagonist sees.
    pub fn antagonist_columns<W: World>(&self) -> Columns {
        let numbers = self.place_columns::<W>(W::SITUATION) + 1;
        let cells = self.states * self.actions;
        let numbers = numbers + self.time_columns(self.antagonist_time);
        Columns { cells, numbers, critic_only: 0 }
    }

    /// Sizes of what the antagonist of the protagonist's draw sees.
    pub fn draw_columns<W: World>(&self) -> Columns {
        let numbers = self.place_columns::<W>(W::OBSERVATION) + 1;
        let numbers = numbers + self.time_columns(self.antagonist_time);
        Columns { cells: self.states, numbers, critic_only: 0 }
    }

    /// Writes what the protagonist sees in every slot. Where its critic sees the budget, that is 1 until
    /// [`Observation::show_budgets`].
    pub fn protagonist<W: World>(&self, world: &W, inputs: &mut Inputs) {
        let place = self.place_columns::<W>(W::OBSERVATION);
        let width = self.protagonist_columns::<W>().numbers + 1;
        self.show_states(world, width, inputs);
        for (slot, row) in inputs.numbers.chunks_exact_mut(width).enumerate() {
            let rest = &mut row[place..];
            let (time, budget) = self.time_and_budget(rest.len() - 1);
            rest[budget].fill(0.0);
            show_time(world, slot, &mut rest[time]);
            row[width - 1] = 1.0;
        }
    }

    /// Shows the budgets to the protagonist's critic, in rows with a slot each.
    pub fn show_budgets<W: World>(&self, budgets: &[Budget], rows: &mut [f32]) {
        let place = self.place_columns::<W>(W::OBSERVATION);
        let width = self.protagonist_columns::<W>().numbers + 1;
        let (_, at) = self.time_and_budget(width - 1 - place);
        if at.is_empty() {
            return;
        }
        let logs = logarithms(budgets.iter().map(|budget| budget.get()));
        for (row, log) in rows.chunks_exact_mut(width).zip(logs) {
            row[place..][at.clone()].fill((log * self.budget_scale) as f32);
        }
    }

    /// Where time and budget are among so many numbers of the protagonist that follow those of the place:
    /// what the critic alone sees comes last.
    fn time_and_budget(&self, numbers: usize) -> (Range<usize>, Range<usize>) {
        let budget = usize::from(self.critic_sees_game);
        if self.protagonist_time {
            (0..numbers - budget, numbers - budget..numbers)
        } else {
            (budget..numbers, 0..budget)
        }
    }

    /// Writes what the antagonist of the protagonist's draw sees in every slot: the state, and its budget.
    pub fn draw<W: World>(&self, of: &DrawSituation<'_, W>, inputs: &mut Inputs) {
        let place = self.place_columns::<W>(W::OBSERVATION);
        let width = self.draw_columns::<W>().numbers + 1;
        self.show_states(of.world, width, inputs);
        let logs = logarithms(of.budgets.iter().map(|budget| budget.get()));
        for (slot, row) in inputs.numbers.chunks_exact_mut(width).enumerate() {
            row[place] = (logs[slot] * self.antagonist_budget_scale) as f32;
            close(of.world, slot, &mut row[place + 1..]);
        }
    }

    /// Writes the state at the beginning of every row.
    fn show_states<W: World>(&self, world: &W, width: usize, inputs: &mut Inputs) {
        let place = self.place_columns::<W>(W::OBSERVATION);
        inputs.cells.clear();
        inputs.numbers.resize(world.episodes() * width, 0.0);
        for (slot, row) in inputs.numbers.chunks_exact_mut(width).enumerate() {
            if let (1.., Some(model)) = (self.states, world.finite()) {
                inputs.cells.push(model.state(slot) as u32);
            } else {
                let (observation, waves) = row[..place].split_at_mut(W::OBSERVATION);
                world.observe(slot, observation);
                fourier(observation, waves);
            }
        }
    }

    /// Writes what the antagonist sees in every slot.
    pub fn antagonist<W: Arena>(&self, of: &Situation<'_, W>, inputs: &mut Inputs) {
        let width = self.antagonist_columns::<W>().numbers + 1;
        let place = self.place_columns::<W>(W::SITUATION);
        inputs.cells.clear();
        inputs.numbers.resize(of.world.episodes() * width, 0.0);
        let logs = logarithms(of.budgets.iter().map(|budget| budget.get()));
        for (slot, row) in inputs.numbers.chunks_exact_mut(width).enumerate() {
            let action = of.actions[slot];
            if let (1.., Some(model)) = (self.states, of.world.finite()) {
                let index = <W::Action as Action>::Kind::index(action);
                inputs.cells.push((model.state(slot) * self.actions + index) as u32);
            } else {
                let (situation, waves) = row[..place].split_at_mut(W::SITUATION);
                of.world.situation(slot, action, situation);
                fourier(situation, waves);
            }
            row[place] = (logs[slot] * self.antagonist_budget_scale) as f32;
            close(of.world, slot, &mut row[place + 1..]);
        }
    }

    /// Turns rows of the antagonist into those that it would see with exp(`log_factor`) times the
    /// budget.
    pub fn with_more_budget<W: World>(&self, inputs: &mut Inputs, log_factor: f64) {
        let place = self.place_columns::<W>(W::SITUATION);
        self.add_budget(inputs, self.antagonist_columns::<W>(), place, log_factor);
    }

    /// The same for rows of the antagonist of the protagonist's draw.
    pub fn with_more_budget_at_draw<W: World>(&self, inputs: &mut Inputs, log_factor: f64) {
        let place = self.place_columns::<W>(W::OBSERVATION);
        self.add_budget(inputs, self.draw_columns::<W>(), place, log_factor);
    }

    fn add_budget(&self, inputs: &mut Inputs, columns: Columns, place: usize, log_factor: f64) {
        for row in inputs.numbers.chunks_exact_mut(columns.numbers + 1) {
            row[place] += (log_factor * self.antagonist_budget_scale) as f32;
        }
    }

    /// Numbers that show where the protagonist is, made from so many of the world's.
    fn place_columns<W: World>(&self, own: usize) -> usize {
        match self.view {
            View::Coordinates => own,
            View::Features if self.states > 0 => 0,
            View::Features => own + W::POSITIONS * WAVES,
        }
    }

    /// Numbers that show the time.
    fn time_columns(&self, aware: bool) -> usize {
        match (aware, self.view) {
            (false, _) => 0,
            (true, View::Coordinates) => 1,
            (true, View::Features) => 1 + WAVES,
        }
    }
}

/// Writes the time and the constant 1.
fn close<W: World>(world: &W, slot: usize, rest: &mut [f32]) {
    let (one, time) = rest.split_last_mut().expect("there is room for the constant 1");
    *one = 1.0;
    show_time(world, slot, time);
}

/// Writes the time, where there is room for it, and its waves, where there is room for them.
fn show_time<W: World>(world: &W, slot: usize, room: &mut [f32]) {
    if let Some((time, waves)) = room.split_first_mut() {
        *time = 2.0 * world.time(slot) as f32 / world.horizon() as f32 - 1.0;
        fourier(&[*time], waves);
    }
}

/// The Fourier basis of as many of the first coordinates as there is room for.
fn fourier(coordinates: &[f32], waves: &mut [f32]) {
    for (waves, coordinate) in waves.chunks_exact_mut(WAVES).zip(coordinates) {
        let (mut sin, mut cos) = (FRAC_PI_2 * (coordinate + 1.0)).sin_cos();
        for pair in waves.chunks_exact_mut(2) {
            pair.copy_from_slice(&[sin, cos]);
            (sin, cos) = (2.0 * sin * cos, 1.0 - 2.0 * sin * sin); // of twice the phase
        }
    }
}
