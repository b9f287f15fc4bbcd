//! The yardsticks of every world of finitely many states: its dynamics as a [`FiniteMdp`], and a
//! summary of what is best.
//!
//! States, actions and outcomes are the indices of the world's [`FiniteModel`]. In most worlds a
//! running episode has accumulated a function of only t, so every time has one level, see
//! [`super::mdp`].

use super::antagonist::WorstCase;
use super::certificate::{Certificate, Risk};
use super::chow::Chow;
use super::law::{evaluate, forward};
use super::mdp::{FiniteMdp, Node, Outcome, State};
use super::optimum::{Optimum, optimum};
use super::policy::Policy;
use super::{ExactError, require_eta, stationary};
use lava_envs::{AreaKind, FiniteModel, Scene, World};
use serde::Serialize;
use std::fmt::{self, Display, Formatter};

/// The MDP of a finite world with time limit `horizon`; gamma discounts per step.
///
/// # Errors
/// As [`FiniteMdp::new`].
pub fn mdp_of(model: &dyn FiniteModel, horizon: u32, gamma: f64) -> Result<FiniteMdp, ExactError> {
    build(model, horizon, gamma, |state, action| model.probabilities(state, action))
}

/// The MDP with other laws of chance, `law(state, action)`.
fn build(
    model: &dyn FiniteModel,
    horizon: u32,
    gamma: f64,
    law: impl Fn(usize, usize) -> Vec<f64>,
) -> Result<FiniteMdp, ExactError> {
    let outcomes = |state: usize, action: usize| -> Vec<Outcome> {
        let probabilities = law(state, action).into_iter().enumerate();
        probabilities
            .map(|(outcome, probability)| {
                let (next, step) = model.successor(state, action, outcome);
                Outcome { probability, reward: step.reward, next }
            })
            .collect()
    };
    let states: Vec<State> = (0..model.states())
        .map(|state| match model.ended(state) {
            Some(end) => State::Ended(end),
            None => {
                State::Running((0..model.actions()).map(|action| outcomes(state, action)).collect())
            }
        })
        .collect();
    FiniteMdp::new(&states, model.start(), horizon as usize, gamma)
}

/// The exactly solvable form of a finite world.
#[derive(Debug)]
pub struct ExactWorld<W> {
    world: W,
    mdp: FiniteMdp,
}

impl<W: World> ExactWorld<W> {
    /// Reads the dynamics of the world with these constants; gamma discounts per step.
    ///
    /// # Errors
    /// If the world is not finite, a constant or gamma is out of range, or the world is too large.
    pub fn new(constants: &W::Constants, gamma: f64) -> Result<Self, ExactError> {
        let world = W::new(constants, 1)?;
        let model = world.finite().ok_or(ExactError::NotFinite(W::NAME))?;
        let mdp = mdp_of(model, world.horizon(), gamma)?;
        Ok(ExactWorld { world, mdp })
    }

    /// The world.
    pub fn world(&self) -> &W {
        &self.world
    }

    /// The world's states, actions and outcomes by their indices.
    pub fn model(&self) -> &dyn FiniteModel {
        self.world.finite().expect("checked when it was built")
    }

    /// The MDP whose states, actions and outcomes are those of [`ExactWorld::model`].
    pub fn mdp(&self) -> &FiniteMdp {
        &self.mdp
    }

    /// The node of a running episode that has taken `time` steps and is in `state`, where the time
    /// says what has been accumulated ([`FiniteMdp::one_level`]).
    pub fn node(&self, time: u32, state: usize) -> Node {
        Node { time: time as usize, level: 0, state }
    }

    /// V*(eta) and a policy that attains it.
    ///
    /// # Errors
    /// If `eta` is below 1 or not finite.
    pub fn optimum(&self, eta: f64) -> Result<Optimum, ExactError> {
        optimum(&self.mdp, require_eta(eta)?)
    }

    /// A stationary policy from the probabilities of the actions in each state, shape `[actions]`;
    /// states in which no action is taken are ignored.
    ///
    /// # Errors
    /// If the probabilities of a state are no law over the actions.
    pub fn stationary_policy<R: AsRef<[f64]>>(
        &self,
        probabilities: impl Fn(usize) -> R,
    ) -> Result<Policy, ExactError> {
        Policy::stationary(&self.mdp, |state, row| fill(row, probabilities(state).as_ref()))
    }

    /// A time-aware policy from the probabilities of the actions at each time in each state, shape
    /// `[actions]`.
    ///
    /// # Errors
    /// If the probabilities of a state are no law over the actions.
    pub fn timed_policy<R: AsRef<[f64]>>(
        &self,
        probabilities: impl Fn(u32, usize) -> R,
    ) -> Result<Policy, ExactError> {
        Policy::timed(&self.mdp, |time, state, row| {
            fill(row, probabilities(time as u32, state).as_ref());
        })
    }

    /// The certificate of a trained policy, whose greedy version takes the likeliest action.
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
        let states = self.mdp.states();
        let model = self.model();
        let (mut visits, mut deviations) = (vec![0.0; states], vec![0.0; states]);
        let (mut budget, mut running) =
            (vec![0.0; self.mdp.horizon()], vec![0.0; self.mdp.horizon()]);
        let on_visit = |node: Option<Node>, state: usize, mass: f64| {
            let Some(node) = node else { return };
            let chosen = policy.action(&self.mdp, node);
            visits[state] += mass;
            if let Some(intended) = model.intended_outcome(chosen) {
                let kept = self.mdp.outcome(state, chosen, intended).probability
                    * worst.delta(node, chosen, intended);
                deviations[state] += mass * (1.0 - kept);
            }
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

    /// Expected visits of each state, ends included, when every action is carried out as it was
    /// chosen; under nominal chance where the world has actions that no outcome carries out.
    ///
    /// # Errors
    /// If the world is too large.
    pub fn occupancy(&self, policy: &Policy) -> Result<Vec<f64>, ExactError> {
        let model = self.model();
        let intended: Option<Vec<usize>> =
            (0..model.actions()).map(|action| model.intended_outcome(action)).collect();
        let Some(intended) = intended else { return Ok(evaluate(&self.mdp, policy).visits) };
        let steady = build(model, self.world.horizon(), self.mdp.gamma(), |_, action| {
            let mut law = vec![0.0; model.outcomes()];
            law[intended[action]] = 1.0;
            law
        })?;
        Ok(evaluate(&steady, policy).visits)
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
        let map = picture(&self.world.scene());
        Ok(Summary {
            env: W::NAME.to_owned(),
            eta,
            alpha,
            gamma: self.mdp.gamma(),
            horizon: self.world.horizon(),
            constants: serde_json::to_value(self.world.constants())
                .expect("constants have a JSON form"),
            headline: self.world.headline(),
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
            visits: self.by_cell(&best.evaluation.visits, &map),
            map,
        })
    }

    /// Numbers of the states added up by their cell on the map, row by row.
    fn by_cell(&self, of_states: &[f64], map: &[String]) -> Vec<Vec<f64>> {
        let mut rows: Vec<Vec<f64>> = map.iter().map(|row| vec![0.0; row.len()]).collect();
        for (state, number) in of_states.iter().enumerate() {
            let [x, y] = self.model().coordinates(state);
            if let Some(cell) = rows.get_mut(y).and_then(|row| row.get_mut(x)) {
                *cell += number;
            }
        }
        rows
    }

    /// Actions of a policy when every action is carried out as it was chosen, until one that no
    /// outcome carries out.
    fn path(&self, policy: &Policy) -> Vec<PathStep> {
        let model = self.model();
        let mut path = Vec::new();
        let mut next = Some(self.mdp.start_node());
        while let Some(node) = next {
            let action = policy.action(&self.mdp, node);
            let [x, y] = model.coordinates(node.state);
            path.push(PathStep {
                x,
                y,
                chosen: model.action_name(action),
                arrow: arrow(model.arrow(action)),
            });
            next = model
                .intended_outcome(action)
                .and_then(|outcome| self.mdp.successor(node, action, outcome));
        }
        path
    }
}

/// Copies the probabilities of a policy; a row of another length is no law.
fn fill(row: &mut [f64], probabilities: &[f64]) {
    if probabilities.len() == row.len() {
        row.copy_from_slice(probabilities);
    } else {
        row.fill(f64::NAN);
    }
}

/// The scene as characters, row by row: `S` start, `G` goal, `L` lava, `#` wall, `.` free.
fn picture(scene: &Scene) -> Vec<String> {
    let [width, height] = scene.size.map(|side| side.ceil() as usize);
    let mut rows = vec![vec!['.'; width]; height];
    for area in &scene.areas {
        let kind = match area.kind {
            AreaKind::Lava => 'L',
            AreaKind::Goal => 'G',
            AreaKind::LesserGoal => 'g',
            AreaKind::Wall => '#',
        };
        let [x, y] = [0, 1].map(|axis| area.min[axis] as usize..area.max[axis].ceil() as usize);
        for row in rows.iter_mut().take(y.end).skip(y.start) {
            for cell in row.iter_mut().take(x.end).skip(x.start) {
                *cell = kind;
            }
        }
    }
    let [x, y] = scene.start.map(|at| at as usize);
    if let Some(cell) = rows.get_mut(y).and_then(|row| row.get_mut(x)) {
        *cell = 'S';
    }
    rows.into_iter().map(String::from_iter).collect()
}

/// The arrow of eight that is nearest to a direction, y downward.
fn arrow([x, y]: [f64; 2]) -> char {
    if x == 0.0 && y == 0.0 {
        return '·';
    }
    let eighth = (y.atan2(x) / std::f64::consts::FRAC_PI_4).round().rem_euclid(8.0) as usize;
    ['→', '↘', '↓', '↙', '←', '↖', '↑', '↗'][eighth % 8]
}

/// Expectations over the episodes of a policy under its worst-case antagonist.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposure {
    /// Steps that begin in each state.
    pub visits: Vec<f64>,
    /// Those of them whose outcome is not the one that carries out the chosen action; 0 where no
    /// outcome does.
    pub deviations: Vec<f64>,
    /// Mean of log eta_t / log eta over the episodes that still run at time t, as long as one does.
    pub budget: Vec<f64>,
}

/// A cell and the action chosen there.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PathStep {
    /// Column.
    pub x: usize,
    /// Row, downward.
    pub y: usize,
    /// The action in a word.
    pub chosen: &'static str,
    /// The action as an arrow.
    #[serde(skip)]
    pub arrow: char,
}

/// What is best in a finite world at one budget. Its [`Display`] is a readable page with the map.
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
    /// The constants of the world.
    pub constants: serde_json::Value,
    /// Those that results depend on most, in a few words, see [`World::headline`].
    #[serde(skip)]
    pub headline: String,
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
    /// The optimal policy's actions when each is carried out as it was chosen.
    pub path: Vec<PathStep>,
    /// Expected visits of the optimal policy per cell, row by row; in goal and lava the probability
    /// of ending there.
    pub visits: Vec<Vec<f64>>,
    /// The map, row by row.
    pub map: Vec<String>,
}

impl Display for Summary {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Summary { eta, alpha, gamma, horizon, headline, .. } = self;
        writeln!(
            f,
            "{}, budget eta = {eta}, so CVaR at alpha = {}",
            self.env,
            significant(*alpha)
        )?;
        let separator = if headline.is_empty() { "" } else { ", " };
        writeln!(f, "{headline}{separator}T = {horizon}, gamma = {gamma}\n")?;
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
                let first = self.path.iter().find(|step| (step.x, step.y) == (x, y));
                let arrow = first.map_or(' ', |step| step.arrow);
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
