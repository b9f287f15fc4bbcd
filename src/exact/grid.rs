//! The yardsticks on `lava-grid`: its dynamics as a [`FiniteMdp`], and a summary of what is best.
//!
//! States of the MDP are the cells of the map, actions and outcomes are the moves, both by
//! [`Move::index`]. A running episode has accumulated a function of t alone, so every time has one
//! level, see [`super::mdp`].

use super::antagonist::WorstCase;
use super::certificate::{Certificate, Risk};
use super::chow::Chow;
use super::law::forward;
use super::mdp::{FiniteMdp, Node, Outcome, State};
use super::optimum::{Optimum, optimum};
use super::policy::Policy;
use super::{ExactError, require_eta, stationary};
use lava_envs::{End, GridConfig, LavaGrid, Move};
use serde::Serialize;
use std::fmt::{self, Display, Formatter};

/// Name of the world in summaries.
pub const NAME: &str = "lava-grid";

/// The exactly solvable form of a grid.
#[derive(Debug, Clone)]
pub struct ExactGrid {
    grid: LavaGrid,
    mdp: FiniteMdp,
}

impl ExactGrid {
    /// Reads the dynamics of a grid; gamma discounts per step.
    ///
    /// # Errors
    /// If the configuration or gamma is out of range or the map too large.
    pub fn new(config: &GridConfig, gamma: f64) -> Result<Self, ExactError> {
        let grid = LavaGrid::new(config, 1)?;
        let states: Vec<State> = (0..grid.cells())
            .map(|cell| {
                if grid.is_goal(cell) {
                    State::Ended(End::Goal)
                } else if grid.is_lava(cell) {
                    State::Ended(End::Lava)
                } else {
                    State::Running(
                        Move::ALL.iter().map(|&chosen| outcomes(&grid, cell, chosen)).collect(),
                    )
                }
            })
            .collect();
        let mdp = FiniteMdp::new(&states, grid.start(), config.horizon as usize, gamma)?;
        Ok(ExactGrid { grid, mdp })
    }

    /// The grid.
    pub fn grid(&self) -> &LavaGrid {
        &self.grid
    }

    /// The MDP whose states are the cells.
    pub fn mdp(&self) -> &FiniteMdp {
        &self.mdp
    }

    /// The node of a running episode that has taken `time` steps and is in `cell`.
    pub fn node(&self, time: u32, cell: usize) -> Node {
        Node { time: time as usize, level: 0, state: cell }
    }

    /// V*(eta) and a policy that attains it.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite.
    pub fn optimum(&self, eta: f64) -> Result<Optimum, ExactError> {
        optimum(&self.mdp, require_eta(eta)?)
    }

    /// A stationary policy from the probabilities of the four moves in each cell, by
    /// [`Move::index`]; cells in which no move is made are ignored.
    ///
    /// # Errors
    /// If the probabilities of a cell are no law.
    pub fn stationary_policy(
        &self,
        probabilities: impl Fn(usize) -> [f64; 4],
    ) -> Result<Policy, ExactError> {
        Policy::stationary(&self.mdp, |cell, row| row.copy_from_slice(&probabilities(cell)))
    }

    /// A time-aware policy from the probabilities of the four moves at each time in each cell.
    ///
    /// # Errors
    /// If the probabilities of a cell are no law.
    pub fn timed_policy(
        &self,
        probabilities: impl Fn(u32, usize) -> [f64; 4],
    ) -> Result<Policy, ExactError> {
        Policy::timed(&self.mdp, |time, cell, row| {
            row.copy_from_slice(&probabilities(time as u32, cell));
        })
    }

    /// The certificate of a trained policy, whose greedy version takes the likeliest move.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite, or `optimum` is for another budget.
    pub fn certificate(
        &self,
        optimum: &Optimum,
        sampled: &Policy,
        eta: f64,
    ) -> Result<Certificate, ExactError> {
        Certificate::new(&self.mdp, optimum, &sampled.greedy(&self.mdp), sampled, eta)
    }

    /// The exact worst-case antagonist of a deterministic policy, to play against.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite, or the policy is not deterministic.
    pub fn worst_case(&self, policy: &Policy, eta: f64) -> Result<WorstCase<'_>, ExactError> {
        WorstCase::new(&self.mdp, policy, eta)
    }

    /// What a deterministic policy meets under its worst-case antagonist, whose budget is above 1.
    pub fn exposure(&self, policy: &Policy, worst: &WorstCase) -> Exposure {
        let cells = self.grid.cells();
        let (mut visits, mut deviations) = (vec![0.0; cells], vec![0.0; cells]);
        let (mut budget, mut running) =
            (vec![0.0; self.mdp.horizon()], vec![0.0; self.mdp.horizon()]);
        let on_visit = |node: Option<Node>, cell: usize, mass: f64| {
            let Some(node) = node else { return };
            let chosen = policy.action(&self.mdp, node);
            let kept = self.grid.law_of(Move::from_index(chosen)).probabilities[chosen]
                * worst.delta(node, chosen, chosen);
            visits[cell] += mass;
            deviations[cell] += mass * (1.0 - kept);
            running[node.time] += mass;
            budget[node.time] += mass * worst.remaining_budget(node).ln();
        };
        forward(&self.mdp, policy, worst, |_, _, _, _, _| {}, on_visit);
        let share = |(sum, mass): (f64, f64)| sum / mass / worst.eta().ln();
        let reached = running.iter().take_while(|mass| **mass > 0.0).count();
        budget.truncate(reached);
        let budget = budget.into_iter().zip(running).map(share).collect();
        Exposure { visits, deviations, budget }
    }

    /// Solves everything at one budget.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite.
    pub fn solve(&self, eta: f64) -> Result<Summary, ExactError> {
        let alpha = require_eta(eta)?;
        let best = optimum(&self.mdp, alpha)?;
        let risk_neutral = optimum(&self.mdp, 1.0)?;
        let found = stationary::search(&self.mdp, alpha, &best.policy)?;
        let risk = Risk::of(&best.evaluation.law, alpha)?;
        let rows = |visits: &[f64]| visits.chunks(self.grid.width()).map(<[f64]>::to_vec).collect();
        Ok(Summary {
            env: NAME.to_owned(),
            eta,
            alpha,
            gamma: self.mdp.gamma(),
            horizon: self.grid.config().horizon,
            slip: self.grid.config().slip,
            step_cost: self.grid.config().step_cost,
            optimal_cvar: best.cvar,
            var: best.var,
            risk_neutral_mean: risk_neutral.evaluation.law.mean(),
            risk_neutral_cvar: risk_neutral.evaluation.law.cvar(alpha),
            optimal_policy_mean: risk.mean,
            lava_probability: risk.lava_probability,
            goal_probability: risk.goal_probability,
            timeout_probability: risk.timeout_probability,
            chow_value: Chow::solve(&self.mdp).value(alpha)?,
            best_stationary_cvar: found.cvar,
            best_stationary_is_local_optimum: found.local_optimum,
            path: self.path(&best.policy),
            visits: rows(&best.evaluation.visits),
            map: self.grid.config().map.split_whitespace().map(str::to_owned).collect(),
        })
    }

    /// Moves of a policy when every chosen move is executed.
    fn path(&self, policy: &Policy) -> Vec<PathStep> {
        let mut path = Vec::new();
        let mut state = self.mdp.start();
        for time in 0..self.mdp.horizon() {
            let action = policy.action(&self.mdp, Node { time, level: 0, state });
            let chosen = Move::from_index(action);
            let (x, y) = self.grid.coordinates(state);
            path.push(PathStep { x, y, chosen });
            state = self.grid.successor(state, chosen).0;
            if self.mdp.ended(state).is_some() {
                break;
            }
        }
        path
    }
}

/// Expectations over the episodes of a policy under its worst-case antagonist.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposure {
    /// Steps that begin in each cell.
    pub visits: Vec<f64>,
    /// Those of them whose executed move is not the chosen one.
    pub deviations: Vec<f64>,
    /// Mean of log eta_t / log eta over the episodes that still run at time t, as long as one does.
    pub budget: Vec<f64>,
}

fn outcomes(grid: &LavaGrid, cell: usize, chosen: Move) -> Vec<Outcome> {
    let law = grid.law_of(chosen);
    Move::ALL
        .iter()
        .map(|&executed| {
            let (next, step) = grid.successor(cell, executed);
            let probability = law.probabilities[executed.index()];
            Outcome { probability, reward: step.reward, next }
        })
        .collect()
}

/// Solves everything on a grid at one budget, see [`ExactGrid::solve`].
///
/// # Errors
/// If the configuration, gamma or eta is out of range or the map too large.
pub fn solve(config: &GridConfig, gamma: f64, eta: f64) -> Result<Summary, ExactError> {
    ExactGrid::new(config, gamma)?.solve(eta)
}

/// A cell and the move chosen there.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PathStep {
    /// Column.
    pub x: usize,
    /// Row, downward.
    pub y: usize,
    /// The move.
    pub chosen: Move,
}

/// What is best on a grid at one budget. Its [`Display`] is a readable page with the map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the world.
    pub env: String,
    /// Budget.
    pub eta: f64,
    /// Risk level 1/eta.
    pub alpha: f64,
    /// Discount per step.
    pub gamma: f64,
    /// Time limit T in steps.
    pub horizon: u32,
    /// Probability that another than the chosen move is executed.
    pub slip: f64,
    /// Cost of a step.
    pub step_cost: f64,
    /// V*(eta): the best attainable CVaR_alpha(J).
    pub optimal_cvar: f64,
    /// VaR_alpha(J) of the optimal policy.
    pub var: f64,
    /// The best attainable `E[J]`.
    pub risk_neutral_mean: f64,
    /// CVaR_alpha(J) of the policy that attains it.
    pub risk_neutral_cvar: f64,
    /// `E[J]` of the optimal policy.
    pub optimal_policy_mean: f64,
    /// Probability that the optimal policy ends in lava.
    pub lava_probability: f64,
    /// Probability that the optimal policy reaches the goal.
    pub goal_probability: f64,
    /// Probability that the optimal policy reaches the time limit.
    pub timeout_probability: f64,
    /// Value of Chow's budget-augmented programme, an overestimate of `optimal_cvar`.
    pub chow_value: f64,
    /// CVaR_alpha(J) of the best stationary deterministic policy found by local search; not proven
    /// to be the best.
    pub best_stationary_cvar: f64,
    /// Whether that search ended where no change in a single cell improves; if not, its limit of
    /// evaluations stopped it.
    pub best_stationary_is_local_optimum: bool,
    /// The optimal policy's moves when none slips.
    pub path: Vec<PathStep>,
    /// Expected visits of the optimal policy per cell, row by row; in goal and lava the probability
    /// of ending there.
    pub visits: Vec<Vec<f64>>,
    /// The map, row by row.
    pub map: Vec<String>,
}

impl Display for Summary {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Summary { eta, alpha, gamma, horizon, slip, step_cost, .. } = self;
        writeln!(
            f,
            "{}, budget eta = {eta}, so CVaR at alpha = {}",
            self.env,
            significant(*alpha)
        )?;
        writeln!(f, "slip {slip}, step cost {step_cost}, T = {horizon}, gamma = {gamma}\n")?;
        let mut line = |label: &str, value: f64, note: &str| {
            let text = format!("{label:<24}{value:>9.4}  {note}");
            writeln!(f, "{}", text.trim_end())
        };
        line("best attainable CVaR", self.optimal_cvar, "V*(eta), over all policies")?;
        line("  its VaR", self.var, "")?;
        line("  its mean return", self.optimal_policy_mean, "")?;
        line("risk-neutral policy", self.risk_neutral_cvar, "CVaR")?;
        line("  its mean return", self.risk_neutral_mean, "the best attainable")?;
        let searched = if self.best_stationary_is_local_optimum {
            "CVaR; found by local search, not proven"
        } else {
            "CVaR; found by local search, which was cut short; not proven"
        };
        line("stationary policy", self.best_stationary_cvar, searched)?;
        let chow = if self.chow_value > self.optimal_cvar + 1e-9 {
            "an overestimate, attained by no policy"
        } else {
            "in general an overestimate, here none"
        };
        line("Chow's programme", self.chow_value, chow)?;
        writeln!(
            f,
            "\nThe optimal policy ends in lava with probability {}, at the goal {}, by timeout {}.",
            significant(self.lava_probability),
            significant(self.goal_probability),
            significant(self.timeout_probability),
        )?;
        writeln!(f, "Its expected visits per cell, and its path where no move slips:\n")?;
        self.draw(f)?;
        writeln!(
            f,
            "\nS start, G goal (both with the number), ~ lava, # wall; nothing: below 0.005"
        )
    }
}

impl Summary {
    /// One cell is seven characters wide: its kind, the first move of the path there, the visits.
    fn draw(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let rule = "-".repeat(7 * self.visits.first().map_or(0, Vec::len));
        writeln!(f, "+{rule}+")?;
        for (y, (row, tiles)) in self.visits.iter().zip(&self.map).enumerate() {
            let mut line = String::from("|");
            for (x, (visits, tile)) in row.iter().zip(tiles.chars()).enumerate() {
                let arrow =
                    self.path.iter().find(|step| (step.x, step.y) == (x, y)).map_or(' ', |step| {
                        match step.chosen {
                            Move::Up => '↑',
                            Move::Down => '↓',
                            Move::Right => '→',
                            Move::Left => '←',
                        }
                    });
                let kind = match tile {
                    'L' => '~',
                    '.' => ' ',
                    other => other,
                };
                let number = match tile {
                    '#' => "####".to_owned(),
                    _ if *visits >= 0.005 => format!("{visits:4.2}"),
                    'L' => "~~~~".to_owned(),
                    _ => "   .".to_owned(),
                };
                line.push_str(&format!("{kind}{arrow}{number} "));
            }
            writeln!(f, "{line}|")?;
        }
        writeln!(f, "+{rule}+")
    }
}

/// Three significant digits, also of small probabilities.
fn significant(value: f64) -> String {
    if value == 0.0 || value >= 0.001 {
        let text = format!("{value:.4}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{value:.2e}")
    }
}
