//! The best response of a protagonist to an antagonist that no longer learns.
//!
//! Against a fixed antagonist delta the game is an MDP. Its state is the world's state, the time and the
//! remaining budget, on which the antagonist's ratios depend, and its law is P_t(o) delta_t(o):
//!
//!   V_t(s, eta_t) = max_a sum_o P(o) delta_t(o) [r + gamma V_{t+1}(s', eta_t / delta_t(o))],
//!
//! and V_T = 0. The value V_0(s_0, eta) is the most that any protagonist gets, whatever it remembers: it is
//! the second half of exploitability in the sense of the paper's Definition 2 ("A Game-Theoretic Perspective
//! on Risk-Sensitive Reinforcement Learning", arXiv 2109.09470). The paper's protagonists do not see the
//! budget, so for them it is an upper bound. Mean returns add up, so the reward that was accumulated need
//! not be known: worlds with several levels of it are no harder.
//!
//! # The grid of budgets
//! V is kept at [`BUDGETS`] values of b = log eta_t, from 0 to log eta + log [`HEADROOM`], and is linear in b
//! between them. They are dense up to a little above log eta, where most episodes stay.
//!
//! A budget rises when a ratio below 1 is realised, without bound. But with L_t the product of the ratios so
//! far, eta_t = eta / L_t, and 1/L_t is a supermartingale of mean at most 1 under the perturbed law, whatever
//! the protagonist does. By Ville's inequality an episode leaves the grid with a probability of at most
//! 1/[`HEADROOM`]. What leaves it counts with the best return that the world can give from there. So this
//! error is on the upper side, and at most the range of the returns divided by [`HEADROOM`].
//!
//! The error of the interpolation has no sign that is known. [`Response::error`] estimates it by the difference to
//! the value on the grid with every other node, which is the error itself where that falls with the distance of
//! the nodes, and three times the error where it falls with the square of it.
//!
//! # How small it can be
//! At every node the best response is worth at least max_a min_delta of the same sum, which is the programme of
//! [`super::chow`]. So V_0(s_0, eta) is at least the value of that programme for any admissible antagonist, also
//! for a perfect one. Where Chow's value exceeds V*(eta), no antagonist has a second half of 0.

use super::mdp::FiniteMdp;
use super::optimum::optimum;
use super::{ExactError, require_eta};

/// Even steps of the grid from log eta_t = 0 to log eta, from there to log eta + [`NEAR`], and from there to its
/// end. Even numbers of them, so that every other node is a grid, too.
const STEPS: [usize; 3] = [128, 128, 64];

/// Length of the grid's second part. At most one episode in twenty leaves it.
const NEAR: f64 = 3.0;

/// Budgets at which an antagonist is asked.
pub const BUDGETS: usize = STEPS[0] + STEPS[1] + STEPS[2] + 1;

/// How many times eta the largest budget of the grid is.
pub const HEADROOM: f64 = 1e6;

/// The most likelihood ratios that an antagonist is asked for. Beyond that there is no best response.
pub const MAX_RATIOS: usize = 12_000_000;

/// An antagonist that no longer learns, on a finite world.
pub trait Frozen {
    /// Whether its ratios depend on the time.
    fn sees_time(&self) -> bool;

    /// Appends the likelihood ratios delta_t(o) after an action at a time in a state, for each remaining
    /// budget eta_t, shape `[budgets, outcomes]`; `false`, without appending anything, if it has no such
    /// ratios. One that does not see the time is asked only at time 0.
    fn ratios(
        &mut self,
        time: u32,
        state: usize,
        action: usize,
        budgets: &[f64],
        ratios: &mut Vec<f64>,
    ) -> bool;
}

/// What the best response to an antagonist attains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Response {
    /// Its mean return against this antagonist.
    pub value: f64,
    /// Estimate of the error that the grid of budgets leaves.
    pub error: f64,
}

/// The best response to an antagonist whose budget is eta. `None` if the antagonist does not give its ratios or
/// gives some that are not finite, or if the world is so large that it would be asked for more than
/// [`MAX_RATIOS`] of them.
///
/// # Errors
/// If `eta` is below 1 or not finite.
pub fn best_response(
    mdp: &FiniteMdp,
    eta: f64,
    antagonist: &mut dyn Frozen,
) -> Result<Option<Response>, ExactError> {
    require_eta(eta)?;
    if eta == 1.0 {
        // Every ratio is 1.
        let value = optimum(mdp, 1.0)?.evaluation.law.mean();
        return Ok(Some(Response { value, error: 0.0 }));
    }
    let times = if antagonist.sees_time() { mdp.horizon() } else { 1 };
    let outcomes: usize = pairs(mdp).map(|(state, action)| mdp.outcome_count(state, action)).sum();
    if outcomes.saturating_mul(BUDGETS).saturating_mul(times) > MAX_RATIOS {
        return Ok(None);
    }
    Ok(programme(mdp, eta, antagonist)
        .map(|[value, coarse]| Response { value, error: (value - coarse).abs() }))
}

/// The value on the whole grid and on that with every other node.
fn programme(mdp: &FiniteMdp, eta: f64, antagonist: &mut dyn Frozen) -> Option<[f64; 2]> {
    let mut layers = [1, 2].map(|stride| Layer::new(mdp, eta, stride));
    let whole = layers[0].grid;
    let budgets: Vec<f64> = (0..BUDGETS).map(|node| whole.log(node).exp()).collect();
    let mut best = vec![0.0; mdp.states()];
    let mut ratios = Vec::new();
    for time in (0..mdp.horizon()).rev() {
        if antagonist.sees_time() || time + 1 == mdp.horizon() {
            let asked = if antagonist.sees_time() { time as u32 } else { 0 };
            layers.iter_mut().for_each(|layer| layer.steps.clear());
            for (state, action) in pairs(mdp) {
                ratios.clear();
                let answered = antagonist.ratios(asked, state, action, &budgets, &mut ratios);
                if !answered || ratios.iter().any(|ratio| !ratio.is_finite()) {
                    return None;
                }
                layers.iter_mut().for_each(|layer| layer.add(mdp, state, action, &ratios));
            }
        }
        layers.iter_mut().for_each(|layer| layer.back(mdp, &best));
        best = best_returns(mdp, &best);
    }
    Some(layers.map(|layer| layer.values[mdp.start() * layer.grid.len() + layer.grid.eta()]))
}

/// States in which the episode continues, with their actions.
fn pairs(mdp: &FiniteMdp) -> impl Iterator<Item = (usize, usize)> + '_ {
    (0..mdp.states()).flat_map(|state| (0..mdp.actions(state)).map(move |action| (state, action)))
}

/// The best return to go in each state, by the luckiest outcome of the best action; `after` is the same one
/// step later.
fn best_returns(mdp: &FiniteMdp, after: &[f64]) -> Vec<f64> {
    let mut best: Vec<f64> = vec![0.0; mdp.states()];
    for state in (0..mdp.states()).filter(|&state| mdp.ended(state).is_none()) {
        let outcomes = (0..mdp.actions(state)).flat_map(|action| {
            (0..mdp.outcome_count(state, action)).map(move |of| mdp.outcome(state, action, of))
        });
        best[state] = outcomes
            .filter(|of| of.probability > 0.0)
            .map(|of| of.reward + mdp.gamma() * after[of.next])
            .fold(f64::NEG_INFINITY, f64::max);
    }
    best
}

/// Values of b = log eta_t: some even steps after others.
#[derive(Debug, Clone, Copy)]
struct Grid {
    parts: [Part; 3],
}

#[derive(Debug, Clone, Copy)]
struct Part {
    /// Number of its first node.
    first: usize,
    /// b there.
    start: f64,
    /// Steps, and the length of each.
    steps: usize,
    length: f64,
}

impl Grid {
    /// The grid with every `stride`-th node.
    fn new(eta: f64, stride: usize) -> Self {
        let (mut first, mut start) = (0, 0.0);
        let ends = [eta.ln(), eta.ln() + NEAR, eta.ln() + HEADROOM.ln()];
        let parts = std::array::from_fn(|part| {
            let steps = STEPS[part] / stride;
            let length = (ends[part] - start) / steps as f64;
            let this = Part { first, start, steps, length };
            (first, start) = (first + steps, ends[part]);
            this
        });
        Grid { parts }
    }

    fn len(&self) -> usize {
        let [.., last] = self.parts;
        last.first + last.steps + 1
    }

    /// The node of log eta.
    fn eta(&self) -> usize {
        self.parts[1].first
    }

    fn log(&self, node: usize) -> f64 {
        let inside = |part: &&Part| node >= part.first;
        let part = self.parts.iter().rev().find(inside).expect("the first part begins at 0");
        part.start + (node - part.first) as f64 * part.length
    }

    /// The node below a value and the share of the next one; `None` beyond the end.
    fn place(&self, log: f64) -> Option<(u32, f64)> {
        let inside = |part: &&Part| log >= part.start;
        let part = self.parts.iter().rev().find(inside).unwrap_or(&self.parts[0]);
        // Rounding may lead a little below 0 or beyond the end.
        let steps = ((log - part.start) / part.length).max(0.0);
        let below = (steps as usize).min(part.steps - 1);
        let share = steps - below as f64;
        (share <= 1.0 + 1e-9).then_some(((part.first + below) as u32, share.min(1.0)))
    }
}

/// What an outcome does: its perturbed probability, and where the budget is after it.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// P(o) delta(o).
    probability: f64,
    /// `None` beyond the grid.
    place: Option<(u32, f64)>,
}

/// The programme on one grid.
struct Layer {
    grid: Grid,
    stride: usize,
    /// By pair, node and outcome.
    steps: Vec<Step>,
    /// V at the present time, by state and node.
    values: Vec<f64>,
    /// Room for V one step earlier.
    earlier: Vec<f64>,
}

impl Layer {
    fn new(mdp: &FiniteMdp, eta: f64, stride: usize) -> Self {
        let grid = Grid::new(eta, stride);
        let values = vec![0.0; mdp.states() * grid.len()];
        Layer { grid, stride, steps: Vec::new(), earlier: values.clone(), values }
    }

    /// Takes the ratios after an action in a state, shape `[budgets, outcomes]` on the whole grid.
    fn add(&mut self, mdp: &FiniteMdp, state: usize, action: usize, ratios: &[f64]) {
        let outcomes = mdp.outcome_count(state, action);
        let rows = ratios.chunks_exact(outcomes).step_by(self.stride);
        for (node, ratios) in rows.enumerate() {
            let log = self.grid.log(node);
            self.steps.extend(ratios.iter().enumerate().map(|(outcome, &ratio)| Step {
                probability: mdp.outcome(state, action, outcome).probability * ratio,
                place: self.grid.place(log - ratio.ln()),
            }));
        }
    }

    /// One step back in time; `best` is the best return to go at the present time.
    fn back(&mut self, mdp: &FiniteMdp, best: &[f64]) {
        let nodes = self.grid.len();
        let mut steps = self.steps.iter();
        for state in 0..mdp.states() {
            let row = &mut self.earlier[state * nodes..][..nodes];
            row.fill(if mdp.actions(state) > 0 { f64::NEG_INFINITY } else { 0.0 });
            for action in 0..mdp.actions(state) {
                let outcomes: Vec<_> = (0..mdp.outcome_count(state, action))
                    .map(|outcome| mdp.outcome(state, action, outcome))
                    .collect();
                for value in row.iter_mut() {
                    let mut mean = 0.0;
                    for (outcome, step) in outcomes.iter().zip(&mut steps) {
                        let after = match step.place {
                            Some((below, share)) => {
                                let at = outcome.next * nodes + below as usize;
                                self.values[at] + share * (self.values[at + 1] - self.values[at])
                            }
                            None => best[outcome.next],
                        };
                        // What cannot happen may have an infinite budget after it.
                        if step.probability != 0.0 {
                            mean += step.probability * (outcome.reward + mdp.gamma() * after);
                        }
                    }
                    *value = f64::max(*value, mean);
                }
            }
        }
        std::mem::swap(&mut self.values, &mut self.earlier);
    }
}
