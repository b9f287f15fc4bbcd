//! A trained opponent as the fixed antagonist of a best response ([`crate::exact::response`]).
//!
//! It is asked for its ratios at many budgets in one state: each slot of a batch is put into the state and
//! given one of the budgets.

use crate::exact::response::{BUDGETS, Frozen};
use crate::game::budget::{Budget, Eta};
use crate::learn::head::HeadOf;
use crate::learn::method::Arena;
use crate::learn::policy::{Opponent, Situation};
use lava_envs::{Action, ConfigError};

/// An opponent that no longer learns.
pub struct FrozenOpponent<'a, W: Arena> {
    opponent: &'a mut dyn Opponent<W>,
    /// A slot for each budget.
    world: W,
}

impl<'a, W: Arena> FrozenOpponent<'a, W> {
    /// The opponent in a world with these constants.
    ///
    /// # Errors
    /// If a constant is out of range.
    pub fn new(
        constants: &W::Constants,
        opponent: &'a mut dyn Opponent<W>,
    ) -> Result<Self, ConfigError> {
        Ok(FrozenOpponent { opponent, world: W::new(constants, BUDGETS)? })
    }

    /// The ratios at budgets of at most one for each slot; `None` if the opponent does not give them.
    fn ask(&mut self, time: u32, state: usize, action: usize, budgets: &[f64]) -> Option<Vec<f64>> {
        let action = <W::Action as Action>::Kind::from_index(action)?;
        let slots = self.world.episodes();
        let model = self.world.finite_mut()?;
        (0..slots).for_each(|slot| model.place(slot, state, time));
        let outcomes = model.outcomes();
        let law = self.world.law(0, action);
        let mut remaining = vec![Budget::start(Eta::NEUTRAL); slots];
        for (remaining, &budget) in remaining.iter_mut().zip(budgets) {
            *remaining = Budget::remaining(budget).ok()?;
        }
        let situation = Situation {
            world: &self.world,
            actions: &vec![action; slots],
            laws: &vec![law; slots],
            budgets: &remaining,
        };
        let mut ratios = self.opponent.all_ratios(&situation)?;
        ratios.truncate(budgets.len() * outcomes);
        Some(ratios)
    }
}

impl<W: Arena> Frozen for FrozenOpponent<'_, W> {
    fn sees_time(&self) -> bool {
        self.opponent.sees_time()
    }

    fn ratios(
        &mut self,
        time: u32,
        state: usize,
        action: usize,
        budgets: &[f64],
        ratios: &mut Vec<f64>,
    ) -> bool {
        let before = ratios.len();
        for budgets in budgets.chunks(self.world.episodes()) {
            let Some(more) = self.ask(time, state, action, budgets) else {
                ratios.truncate(before);
                return false;
            };
            ratios.extend(more);
        }
        true
    }
}
