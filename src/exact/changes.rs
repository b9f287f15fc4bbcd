//! What single changes of a policy are worth: in one state another action, at all times.
//!
//! A trained policy that falls short of the best CVaR often does so in a few states. Each row says by how much the
//! exact CVaR_alpha of the greedy policy changes if it always takes one other action in one state.

use super::finite::ExactWorld;
use super::law::evaluate;
use super::policy::{Memory, Policy};
use super::table::TablePolicy;
use super::{ExactError, require_eta};
use lava_envs::World;
use serde::Serialize;
use std::fmt::{self, Display, Formatter};

/// Rows that the page shows.
const SHOWN: usize = 20;

/// Gains below this are rounding.
const ROUNDING: f64 = 1e-9;

/// One change.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Change {
    /// Column of the state's cell.
    pub x: usize,
    /// Row, downward.
    pub y: usize,
    /// The actions that the policy takes there, with an action per change over time.
    pub taken: Vec<&'static str>,
    /// The action that it would always take.
    pub action: &'static str,
    /// What the change adds to CVaR_alpha.
    pub gain: f64,
    /// Steps of an episode that begin in the state, on average.
    pub visits: f64,
}

/// All changes of one policy, the largest gain first. Its [`Display`] is a page with the first ones.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Changes {
    /// Name of the world.
    pub env: String,
    /// Budget.
    pub eta: f64,
    /// Risk level 1/eta.
    pub alpha: f64,
    /// CVaR_alpha of the greedy policy.
    pub cvar: f64,
    /// The best attainable.
    pub optimal_cvar: f64,
    /// The changes.
    pub changes: Vec<Change>,
}

/// The changes of the greedy version of a policy, in the states that its episodes visit.
///
/// # Errors
/// If the budget is out of range or the policy does not fit the world.
pub fn changes<W: World>(
    world: &ExactWorld<W>,
    eta: f64,
    optimal_cvar: f64,
    policy: &TablePolicy,
) -> Result<Changes, ExactError> {
    let alpha = require_eta(eta)?;
    let (mdp, model) = (world.mdp(), world.model());
    let greedy = policy.on(world)?.greedy(mdp);
    let own = evaluate(mdp, &greedy);
    let cvar = own.law.cvar(alpha);
    let choice = |time: usize, state: usize| policy.greedy_action(time as u32, state);
    let mut found = Vec::new();
    let running = (0..model.states()).filter(|&state| model.ended(state).is_none());
    for state in running.filter(|&state| own.visits[state] > 0.0) {
        let mut taken: Vec<usize> = match greedy.memory() {
            Memory::Stationary => vec![choice(0, state)],
            _ => (0..mdp.horizon()).map(|time| choice(time, state)).collect(),
        };
        taken.dedup();
        for action in (0..model.actions()).filter(|&action| taken != [action]) {
            let changed =
                match greedy.memory() {
                    Memory::Stationary => Policy::stationary_choice(mdp, |of| {
                        if of == state { action } else { choice(0, of) }
                    }),
                    _ => Policy::timed_choice(mdp, |time, of| {
                        if of == state { action } else { choice(time, of) }
                    }),
                };
            let [x, y] = model.coordinates(state);
            found.push(Change {
                x,
                y,
                taken: taken.iter().map(|&action| model.action_name(action)).collect(),
                action: model.action_name(action),
                gain: evaluate(mdp, &changed).law.cvar(alpha) - cvar,
                visits: own.visits[state],
            });
        }
    }
    found.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    Ok(Changes { env: W::NAME.to_owned(), eta, alpha, cvar, optimal_cvar, changes: found })
}

impl Display for Changes {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Changes { env, eta, alpha, cvar, optimal_cvar, changes } = self;
        writeln!(f, "{env}, budget eta = {eta}, so CVaR at alpha = {alpha}\n")?;
        writeln!(f, "CVaR of the greedy policy {cvar:>9.4}")?;
        writeln!(f, "best attainable           {optimal_cvar:>9.4}")?;
        let better = changes.iter().filter(|change| change.gain > ROUNDING).count();
        writeln!(
            f,
            "\nIn one cell another action, always: {better} of {} such changes are better.\n",
            changes.len()
        )?;
        writeln!(f, "    gain  cell      visits  action  in place of")?;
        for Change { x, y, taken, action, gain, visits } in changes.iter().take(SHOWN) {
            let cell = format!("({x}, {y})");
            let taken = taken.join(", ");
            writeln!(f, "{gain:>+8.4}  {cell:<8}{visits:>8.3}  {action:<6}  {taken}")?;
        }
        Ok(())
    }
}
