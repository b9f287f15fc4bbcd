//! Any finite MDP with a time limit, solved exactly.
//!
//! Python sees states 0..S, times 0..T and returns `J = sum_{t<T} gamma^t r_t`. The solver's own MDP may have two
//! states more, which nothing here shows:
//!
//! * the one in which an episode is over that ends by a transition (`next = -1`), whatever state that would be;
//! * the one before the start, where the start is a law over states. Its only action takes a step of time, so that
//!   the time limit is T + 1 and every reward is divided by gamma. Every reward of a running episode makes levels of
//!   the accumulated reward at every time, so this step has one of the rewards that exist already, c, and all
//!   returns of the solver are J + c.

use crate::law::Law;
use crate::{Real, budget, discount, elements, index, invalid, valid};
use cvar_game::exact::ExactError;
use cvar_game::exact::chow::Chow;
use cvar_game::exact::law::{Perturbation, evaluate, evaluate_under};
use cvar_game::exact::mdp::{FiniteMdp, MAX_NODES, Node, Outcome, State};
use cvar_game::exact::optimum;
use cvar_game::exact::policy::Policy;
use cvar_game::exact::stationary;
use cvar_game::game::budget::Eta;
use cvar_game::game::returns::{Atom, ReturnLaw};
use lava_envs::End;
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArray1,
    PyReadonlyArrayDyn, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use std::cmp::Ordering;
use std::sync::{Arc, OnceLock};

/// The most numbers of a policy: one for each time, accumulated reward, state and action.
const MAX_CHOICES: usize = 64_000_000;

/// The most numbers that the budget-augmented programme may keep for one time.
const MAX_MASSES: usize = 100_000_000;

/// The largest reward, so that no sum of rewards overflows.
const LARGEST_REWARD: f64 = 1e100;

/// A tail of less probability counts as out of reach: its reciprocal might not be finite.
const LEAST_TAIL: f64 = f64::MIN_POSITIVE;

/// The largest budget of a worst case, whose tail is in reach then.
const LARGEST_BUDGET: f64 = 1e300;

/// How far the sum of a law may be from 1. Decimals in files are rounded; such laws are normalised.
const SUM_TOLERANCE: f64 = 1e-6;

/// How far the sum of a policy's probabilities may be from 1: they may be numbers of single precision.
const POLICY_TOLERANCE: f64 = 1e-4;

/// How far an accumulated reward may be from a level, relative to the largest accumulated reward.
const LEVEL_TOLERANCE: f64 = 1e-6;

/// Transitions, as arrays of equal length.
struct Transitions {
    state: Vec<i64>,
    action: Vec<i64>,
    next: Vec<i64>,
    probability: Vec<f64>,
    reward: Vec<f64>,
}

/// One thing chance may decide, as Python sees it.
#[derive(Debug, Clone, Copy)]
struct Seen {
    probability: f64,
    reward: f64,
    /// `None` if the episode ends with it, whatever the next state.
    next: Option<usize>,
}

/// An MDP and how Python sees it.
struct Model {
    mdp: FiniteMdp,
    /// Outcomes by state and action, ascending in next state and reward; no actions where the episode has ended.
    outcomes: Vec<Vec<Vec<Seen>>>,
    /// The most actions of a state.
    actions: usize,
    /// The law of the start, by state.
    start: Vec<f64>,
    /// Steps of the solver before the first of Python's: 1 where the start is a law, else 0.
    shift: usize,
    /// What they add to the return.
    offset: f64,
    /// By the solver's time and level: the first of the levels that differ by rounding only, as 0.1 + 0.2 and 0.3.
    same: Vec<Vec<usize>>,
    /// By Python's time: the accumulated rewards that can be reached, ascending, each with the first of its levels.
    levels: Vec<Vec<(f64, usize)>>,
    /// By the solver's time: the pairs (time, level) before it.
    blocks: Vec<usize>,
    /// The largest accumulated reward or return of the solver, of either sign.
    scale: f64,
    /// How far two sums of the same rewards may be apart.
    rounding: f64,
    chow: OnceLock<Chow>,
}

fn in_range(what: &str, value: i64, end: usize) -> Result<usize, String> {
    let found = usize::try_from(value).ok().filter(|value| *value < end);
    found.ok_or_else(|| format!("{what} = {value} must be in [0, {end})"))
}

impl Model {
    fn new(
        transitions: &Transitions,
        states: i64,
        start: Vec<f64>,
        horizon: i64,
        gamma: f64,
    ) -> Result<Self, String> {
        let count = |name, value| {
            let found = usize::try_from(value).ok().filter(|value| (1..=MAX_NODES).contains(value));
            found.ok_or_else(|| format!("{name} = {value} must be in [1, {MAX_NODES}]"))
        };
        let (states, horizon) = (count("states", states)?, count("horizon", horizon)?);
        let outcomes = outcomes(transitions, states)?;
        let first = start_states(&start, &outcomes)?;
        let (shift, scaling) = match first[..] {
            [_] => (0, 1.0),
            _ => (1, gamma),
        };
        // Index of the state in which all is over, and of the one before the start.
        let mut extra = states;
        let ends = outcomes.iter().flatten().flatten().any(|outcome| outcome.next.is_none());
        let over = ends.then(|| std::mem::replace(&mut extra, states + 1));
        let solved = |outcome: &Seen| Outcome {
            probability: outcome.probability,
            reward: outcome.reward / scaling,
            next: outcome.next.or(over).unwrap_or_default(),
        };
        let mut list: Vec<State> = Vec::with_capacity(states + 2);
        for actions in &outcomes {
            list.push(match actions.is_empty() {
                true => State::Ended(End::Goal),
                false => State::Running(
                    actions.iter().map(|outcomes| outcomes.iter().map(solved).collect()).collect(),
                ),
            });
        }
        list.extend(over.map(|_| State::Ended(End::Goal)));
        let rewards = || outcomes.iter().flatten().flatten();
        if rewards().any(|outcome| (outcome.reward / scaling).abs() > LARGEST_REWARD) {
            return Err(format!(
                "gamma = {gamma} is too small for these rewards with a start distribution; use a larger gamma"
            ));
        }
        let mut offset = 0.0;
        if shift == 1 {
            // The smallest one, which costs the least precision.
            let running =
                rewards().filter(|of| of.next.is_some_and(|next| !outcomes[next].is_empty()));
            let running = running.map(|outcome| outcome.reward / scaling);
            offset = running.min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0);
            let law = first.iter().map(|&next| Outcome {
                probability: start[next],
                reward: offset,
                next,
            });
            list.push(State::Running(vec![law.collect()]));
        }
        let begin = if shift == 1 { extra } else { first[0] };
        let mdp = FiniteMdp::new(&list, begin, horizon + shift, gamma).map_err(|error| match error {
            ExactError::TooLarge => format!(
                "the MDP is too large to be solved exactly: more than {MAX_NODES} combinations of time, accumulated \
                 reward and state; shorten the horizon or round the rewards"
            ),
            other => other.to_string(),
        })?;
        let mut blocks = vec![0];
        for time in 0..mdp.horizon() {
            blocks.push(blocks[time] + mdp.accumulated(time).len());
        }
        let pairs: usize = (0..mdp.states()).map(|state| mdp.actions(state)).sum();
        if blocks[mdp.horizon()].saturating_mul(pairs) > MAX_CHOICES {
            return Err(format!(
                "the MDP is too large to be solved exactly: more than {MAX_CHOICES} combinations of time, accumulated \
                 reward, state and action; shorten the horizon or round the rewards"
            ));
        }
        let (reached, scale) = reached(&mdp);
        let actions = outcomes.iter().map(Vec::len).max().unwrap_or(0);
        // Each step rounds a sum once, and each product.
        let rounding = 2.0 * f64::EPSILON * (mdp.horizon() + 4) as f64 * scale;
        let mut same: Vec<Vec<usize>> = Vec::with_capacity(mdp.horizon());
        let mut levels = Vec::with_capacity(horizon);
        for (time, reached) in reached.iter().enumerate() {
            let accumulated = mdp.accumulated(time);
            let mut firsts: Vec<usize> = Vec::with_capacity(accumulated.len());
            let mut found: Vec<(f64, usize)> = Vec::new();
            for level in 0..accumulated.len() {
                let value = |level: usize| accumulated[level].discounted;
                let new = level == 0 || value(level) - value(level - 1) > rounding;
                let first = if new { level } else { firsts[level - 1] };
                firsts.push(first);
                if reached[level] && found.last().is_none_or(|last| last.1 != first) {
                    found.push((value(first) - offset, first));
                }
            }
            same.push(firsts);
            if time >= shift {
                levels.push(found);
            }
        }
        let chow = OnceLock::new();
        Ok(Model {
            mdp,
            outcomes,
            actions,
            start,
            shift,
            offset,
            same,
            levels,
            blocks,
            scale,
            rounding,
            chow,
        })
    }

    /// How two of the solver's returns compare, apart from rounding.
    fn compare(&self, one: f64, other: f64) -> Ordering {
        if (one - other).abs() <= self.rounding { Ordering::Equal } else { one.total_cmp(&other) }
    }

    /// A deterministic policy that does the same at levels that differ by rounding only. It loses no more than that:
    /// the shortfall to go is 1-Lipschitz in the accumulated reward.
    fn merged(&self, policy: Policy) -> Policy {
        let mut levels = self.same.iter().flat_map(|levels| levels.iter().enumerate());
        if levels.all(|(level, first)| level == *first) {
            return policy;
        }
        Policy::augmented_choice(&self.mdp, |node| {
            let level = self.same[node.time][node.level];
            policy.action(&self.mdp, Node { level, ..node })
        })
    }

    fn states(&self) -> usize {
        self.outcomes.len()
    }

    fn horizon(&self) -> usize {
        self.levels.len()
    }

    /// Whether the time says what has been accumulated.
    fn one_level(&self) -> bool {
        self.levels.iter().all(|levels| levels.len() <= 1)
    }

    fn ended(&self, state: usize) -> bool {
        self.outcomes[state].is_empty()
    }

    /// The place of a node among all of the solver's.
    fn place(&self, node: Node) -> usize {
        (self.blocks[node.time] + node.level) * self.mdp.states() + node.state
    }

    /// The solver's node of a time, an accumulated reward and a state.
    fn node(&self, time: i64, accumulated: f64, state: i64) -> Result<Node, String> {
        let time = in_range("time", time, self.horizon())?;
        let state = in_range("state", state, self.states())?;
        if self.ended(state) {
            return Err(format!("state {state} has no actions: the episode has ended there"));
        }
        let levels = &self.levels[time];
        let above = levels.partition_point(|(value, _)| *value < accumulated);
        let beside = levels[above.saturating_sub(1)..levels.len().min(above + 1)].iter();
        let distance = |level: &(f64, usize)| (level.0 - accumulated).abs();
        let nearest = beside.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        // A NaN is no level either.
        match nearest.filter(|level| distance(level) <= LEVEL_TOLERANCE * self.scale) {
            Some(&(_, level)) => Ok(Node { time: time + self.shift, level, state }),
            None if levels.is_empty() => Err(format!("no episode lasts until time {time}")),
            None => Err(format!(
                "no episode has accumulated {accumulated} at time {time}; it must be the sum of gamma^k r_k over the \
                 steps k before"
            )),
        }
    }

    /// The node of a time and a state where the time says the rest.
    fn only_node(&self, time: usize, state: usize) -> Option<Node> {
        let &(_, level) = self.levels[time].first().filter(|_| !self.ended(state))?;
        Some(Node { time: time + self.shift, level, state })
    }

    fn needs_one_level(&self) -> PyResult<()> {
        self.one_level().then_some(()).ok_or_else(|| {
            invalid(
                "there is no table by time and state, because the accumulated reward matters as well; ask with time, \
                 accumulated reward and state",
            )
        })
    }

    /// A law of the solver's returns as that of J.
    fn law(&self, law: &ReturnLaw) -> Law {
        if self.shift == 0 {
            return Law(law.clone());
        }
        let gamma = self.mdp.gamma();
        Law(ReturnLaw::exact(
            law.atoms()
                .iter()
                .map(|atom| Atom {
                    value: atom.value - self.offset,
                    undiscounted: (atom.undiscounted - self.offset) * gamma,
                    steps: atom.steps - 1,
                    ..*atom
                })
                .collect(),
        ))
    }

    /// A policy of shape `[S, A]` or `[T, S, A]`.
    fn policy(&self, shape: &[usize], probabilities: &[f64]) -> Result<Policy, String> {
        let (horizon, states, width) = (self.horizon(), self.states(), self.actions);
        let timed = match shape {
            [s, a] if [*s, *a] == [states, width] => false,
            [t, s, a] if [*t, *s, *a] == [horizon, states, width] => true,
            _ => {
                let shape: Vec<String> = shape.iter().map(ToString::to_string).collect();
                return Err(format!(
                    "a policy must have shape ({states}, {width}) or ({horizon}, {states}, {width}), got ({})",
                    shape.join(", ")
                ));
            }
        };
        for (place, row) in probabilities.chunks_exact(width).enumerate() {
            let (time, state) = (place / states, place % states);
            let actions = self.outcomes[state].len();
            let at = || match timed {
                true => format!("policy[{time}, {state}]"),
                false => format!("policy[{state}]"),
            };
            if actions == 0 {
                continue;
            }
            let sum: f64 = row[..actions].iter().sum();
            // A NaN fails the comparison.
            let law =
                row[..actions].iter().all(|p| *p >= 0.0) && (sum - 1.0).abs() <= POLICY_TOLERANCE;
            if row[actions..].iter().any(|p| *p != 0.0) {
                return Err(format!("{} must be 0 from action {actions} on: {row:?}", at()));
            }
            if !law {
                return Err(format!("{} must have no negative number and sum to 1: {row:?}", at()));
            }
        }
        let fill = |time: usize, state: usize, row: &mut [f64]| {
            if state >= states {
                row.fill(1.0); // before the start
                return;
            }
            let place = (time.saturating_sub(self.shift) * states + state) * width;
            row.copy_from_slice(&probabilities[place..][..row.len()]);
        };
        let policy = match timed {
            true => Policy::timed(&self.mdp, fill),
            false => Policy::stationary(&self.mdp, |state, row| fill(0, state, row)),
        };
        policy.map_err(|error| error.to_string())
    }

    /// The action of a policy; -1 where the episode has ended, and 0 at times until which no episode lasts.
    fn table(&self, action: impl Fn(Node) -> usize) -> Vec<i64> {
        let places =
            (0..self.horizon()).flat_map(|time| (0..self.states()).map(move |state| (time, state)));
        let otherwise = |state| if self.ended(state) { -1 } else { 0 };
        let node = |(time, state)| {
            self.only_node(time, state).map_or(otherwise(state), |node| action(node) as i64)
        };
        places.map(node).collect()
    }
}

/// Outcomes by state and action.
fn outcomes(transitions: &Transitions, states: usize) -> Result<Vec<Vec<Vec<Seen>>>, String> {
    let Transitions { state, action, next, probability, reward } = transitions;
    let count = state.len();
    if [action.len(), next.len(), probability.len(), reward.len()] != [count; 4] {
        return Err("the arrays of transitions must have one length".to_owned());
    }
    let mut sorted: Vec<(usize, usize, Option<usize>, f64, f64)> = Vec::with_capacity(count);
    for i in 0..count {
        let at = |problem: String| format!("transition {i}: {problem}");
        let from = in_range("state", state[i], states).map_err(at)?;
        let chosen = in_range("action", action[i], MAX_NODES).map_err(at)?;
        let to = match next[i] {
            -1 => None,
            next => Some(
                in_range("next", next, states)
                    .map_err(|problem| at(format!("{problem}, or -1 where the episode ends")))?,
            ),
        };
        let (p, r) = (probability[i], reward[i]);
        if !(0.0..=1.0 + SUM_TOLERANCE).contains(&p) {
            return Err(at(format!("probability = {p} must be in [0, 1]")));
        }
        // A NaN is not contained.
        if !(-LARGEST_REWARD..=LARGEST_REWARD).contains(&r) {
            return Err(at(format!(
                "reward = {r} must be a finite number of at most {LARGEST_REWARD:e}"
            )));
        }
        // Both zeros are one.
        sorted.push((from, chosen, to, r + 0.0, p));
    }
    sorted.sort_by(|a, b| (a.0, a.1, a.2).cmp(&(b.0, b.1, b.2)).then(a.3.total_cmp(&b.3)));
    let mut found: Vec<Vec<Vec<Seen>>> = vec![Vec::new(); states];
    for (state, action, next, reward, probability) in sorted {
        let actions = &mut found[state];
        if action > actions.len() {
            return Err(format!(
                "state {state} has an action {action} but no action {}; number the actions of a state from 0 without \
                 gaps",
                actions.len()
            ));
        }
        if action == actions.len() {
            actions.push(Vec::new());
        }
        let outcomes = &mut actions[action];
        match outcomes.last_mut().filter(|last| (last.next, last.reward) == (next, reward)) {
            Some(same) => same.probability += probability,
            None => outcomes.push(Seen { probability, reward, next }),
        }
    }
    for (state, actions) in found.iter_mut().enumerate() {
        for (action, outcomes) in actions.iter_mut().enumerate() {
            let sum: f64 = outcomes.iter().map(|outcome| outcome.probability).sum();
            normalise(sum, outcomes.iter_mut().map(|outcome| &mut outcome.probability)).map_err(|sum| {
                format!("the probabilities of action {action} in state {state} sum to {sum}, not to 1")
            })?;
            outcomes.retain(|outcome| outcome.probability > 0.0);
        }
    }
    Ok(found)
}

/// Makes the sum of a law 1, if its decimals were rounded.
fn normalise<'a>(sum: f64, law: impl Iterator<Item = &'a mut f64>) -> Result<(), f64> {
    let off = (sum - 1.0).abs();
    // A NaN fails the comparison.
    let possible = off <= SUM_TOLERANCE;
    if !possible {
        return Err(sum);
    }
    if off > 1e-12 {
        law.for_each(|probability| *probability /= sum);
    }
    Ok(())
}

/// The states in which an episode may start.
fn start_states(start: &[f64], outcomes: &[Vec<Vec<Seen>>]) -> Result<Vec<usize>, String> {
    let states = outcomes.len();
    if start.len() != states {
        return Err(format!(
            "start must be a state or the probabilities of {states} states, got {} numbers",
            start.len()
        ));
    }
    if let Some(p) = start.iter().find(|p| !(0.0..=1.0 + SUM_TOLERANCE).contains(*p)) {
        return Err(format!("the probabilities of start must be in [0, 1], got {p}"));
    }
    let first: Vec<usize> = (0..states).filter(|state| start[*state] > 0.0).collect();
    match first.iter().find(|state| outcomes[**state].is_empty()) {
        Some(state) => Err(format!("no episode can start in state {state}: it has no transitions")),
        None => Ok(first),
    }
}

/// By time and level, whether some policy reaches it; and the largest accumulated reward or return, of either sign,
/// that some policy reaches.
fn reached(mdp: &FiniteMdp) -> (Vec<Vec<bool>>, f64) {
    let states = mdp.states();
    let mut levels = Vec::with_capacity(mdp.horizon());
    let mut scale = 0.0_f64;
    let mut now = vec![false; states];
    now[mdp.start()] = true;
    for time in 0..mdp.horizon() {
        let accumulated = mdp.accumulated(time);
        let last = time + 1 == mdp.horizon();
        let mut next = vec![false; if last { 0 } else { mdp.accumulated(time + 1).len() * states }];
        let mut found = Vec::with_capacity(accumulated.len());
        for (level, so_far) in accumulated.iter().enumerate() {
            let here = &now[level * states..][..states];
            found.push(here.contains(&true));
            if found[level] {
                scale = scale.max(so_far.discounted.abs());
            }
            for state in (0..states).filter(|state| here[*state]) {
                let node = Node { time, level, state };
                for action in 0..mdp.actions(state) {
                    for outcome in 0..mdp.outcome_count(state, action) {
                        if let Some(Node { level, state, .. }) =
                            mdp.successor(node, action, outcome)
                        {
                            next[level * states + state] = true;
                        } else if let Some((_, value)) = mdp.ending(node, action, outcome) {
                            scale = scale.max(value.abs());
                        }
                    }
                }
            }
        }
        levels.push(found);
        now = next;
    }
    (levels, scale)
}

/// A finite MDP with a time limit.
#[pyclass(frozen, module = "cvar_game._core")]
pub struct Mdp(Arc<Model>);

#[pymethods]
impl Mdp {
    /// The MDP of some transitions, in arrays of equal length. States without any have ended; `next = -1` ends the
    /// episode whatever the state. `start` has the probability of each state.
    #[new]
    #[pyo3(signature = (state, action, next, probability, reward, *, states, start, horizon, gamma))]
    #[expect(clippy::too_many_arguments, reason = "Python names them")]
    #[expect(clippy::needless_pass_by_value, reason = "PyO3 gives them away")]
    fn new(
        py: Python<'_>,
        state: PyReadonlyArray1<'_, i64>,
        action: PyReadonlyArray1<'_, i64>,
        next: PyReadonlyArray1<'_, i64>,
        probability: PyReadonlyArray1<'_, f64>,
        reward: PyReadonlyArray1<'_, f64>,
        #[pyo3(from_py_with = index)] states: i64,
        start: PyReadonlyArray1<'_, f64>,
        #[pyo3(from_py_with = index)] horizon: i64,
        gamma: Real,
    ) -> PyResult<Self> {
        let gamma = discount(gamma)?;
        let whole = |array: &PyReadonlyArray1<'_, i64>| PyResult::Ok(elements(array)?.to_vec());
        let real = |array: &PyReadonlyArray1<'_, f64>| PyResult::Ok(elements(array)?.to_vec());
        let transitions = Transitions {
            state: whole(&state)?,
            action: whole(&action)?,
            next: whole(&next)?,
            probability: real(&probability)?,
            reward: real(&reward)?,
        };
        let mut start = real(&start)?;
        let sum: f64 = start.iter().sum();
        let made = py.detach(|| {
            normalise(sum, start.iter_mut())
                .map_err(|sum| format!("the probabilities of start sum to {sum}, not to 1"))?;
            Model::new(&transitions, states, start, horizon, gamma)
        });
        Ok(Mdp(Arc::new(valid(made)?)))
    }

    /// Number of states S.
    #[getter]
    fn states(&self) -> usize {
        self.0.states()
    }

    /// The most actions of a state, A.
    #[getter]
    fn actions(&self) -> usize {
        self.0.actions
    }

    /// Time limit T in steps.
    #[getter]
    fn horizon(&self) -> usize {
        self.0.horizon()
    }

    /// Discount per step.
    #[getter]
    fn gamma(&self) -> f64 {
        self.0.mdp.gamma()
    }

    /// The probability that an episode starts in each state, shape `[S]`.
    #[getter]
    fn start<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, &self.0.start)
    }

    /// Whether the time says what has been accumulated, so that policies need time and state only.
    #[getter]
    fn one_level(&self) -> bool {
        self.0.one_level()
    }

    /// Number of actions of a state; 0 where the episode has ended.
    fn action_count(&self, #[pyo3(from_py_with = index)] state: i64) -> PyResult<usize> {
        Ok(self.0.outcomes[valid(in_range("state", state, self.0.states()))?].len())
    }

    /// Next states (-1 where the episode ends), probabilities and rewards of an action, each of shape `[K]`.
    #[expect(clippy::type_complexity, reason = "three arrays")]
    fn outcomes<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = index)] state: i64,
        #[pyo3(from_py_with = index)] action: i64,
    ) -> PyResult<(Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>)>
    {
        let actions = &self.0.outcomes[valid(in_range("state", state, self.0.states()))?];
        let outcomes = &actions[valid(in_range("action", action, actions.len()))?];
        let next = outcomes.iter().map(|of| of.next.map_or(-1, |next| next as i64));
        let probabilities = outcomes.iter().map(|of| of.probability);
        let rewards = outcomes.iter().map(|of| of.reward);
        Ok((
            PyArray1::from_iter(py, next),
            PyArray1::from_iter(py, probabilities),
            PyArray1::from_iter(py, rewards),
        ))
    }

    /// The values that the accumulated reward may have at a time, ascending.
    fn levels<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = index)] time: i64,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let time = valid(in_range("time", time, self.0.horizon()))?;
        Ok(PyArray1::from_iter(py, self.0.levels[time].iter().map(|(value, _)| *value)))
    }

    /// Whether an optimum is one of this MDP.
    fn has_solved(&self, optimum: &Optimum) -> bool {
        Arc::ptr_eq(&self.0, &optimum.model)
    }

    /// The best attainable CVaR and a policy that attains it.
    fn optimum(&self, py: Python<'_>, alpha: Real) -> PyResult<Optimum> {
        let model = &self.0;
        let found = py.detach(|| {
            let policy = model.merged(optimum::optimum(&model.mdp, alpha.0)?.policy);
            let law = model.law(&evaluate(&model.mdp, &policy).law);
            Ok(Optimum { model: Arc::clone(model), policy, law, alpha: alpha.0 })
        });
        found.map_err(|error: ExactError| invalid(error.to_string()))
    }

    /// The law of the return under a policy of shape `[S, A]` or `[T, S, A]`.
    #[expect(clippy::needless_pass_by_value, reason = "PyO3 gives it away")]
    fn evaluate(&self, py: Python<'_>, policy: PyReadonlyArrayDyn<'_, f64>) -> PyResult<Law> {
        let model = &self.0;
        let (shape, probabilities) = read(&policy)?;
        valid(py.detach(|| {
            let policy = model.policy(&shape, &probabilities)?;
            Ok(model.law(&evaluate(&model.mdp, &policy).law))
        }))
    }

    /// The worst case of the greedy version of a policy of shape `[S, A]` or `[T, S, A]`.
    #[expect(clippy::needless_pass_by_value, reason = "PyO3 gives it away")]
    fn worst_case(
        &self,
        py: Python<'_>,
        policy: PyReadonlyArrayDyn<'_, f64>,
        eta: Real,
    ) -> PyResult<MdpWorstCase> {
        let eta = budget(eta)?;
        let (shape, probabilities) = read(&policy)?;
        valid(py.detach(|| {
            let policy = self.0.policy(&shape, &probabilities)?.greedy(&self.0.mdp);
            MdpWorstCase::new(&self.0, policy, eta)
        }))
    }

    /// The value that the budget-augmented programme reports, which no policy need attain.
    fn chow(&self, py: Python<'_>, eta: Real) -> PyResult<f64> {
        let (eta, model) = (budget(eta)?, &self.0);
        let returns = model.mdp.returns().len();
        let largest = model.blocks.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(0);
        if largest.saturating_mul(model.mdp.states()).saturating_mul(returns) > MAX_MASSES {
            return Err(invalid(
                "the MDP has too many returns for the budget-augmented programme; shorten the horizon or round the \
                 rewards",
            ));
        }
        let value =
            py.detach(|| model.chow.get_or_init(|| Chow::solve(&model.mdp)).value(eta.alpha()));
        Ok(value.map_err(|error| invalid(error.to_string()))? - model.offset)
    }

    /// A good stationary deterministic policy, found by local search and not proven to be the best: the law of its
    /// return, its actions of shape `[S]` (-1 where the episode has ended), whether no change of one action improves
    /// it, and the number of policies tried.
    fn best_stationary<'py>(
        &self,
        py: Python<'py>,
        alpha: Real,
    ) -> PyResult<(Law, Bound<'py, PyArray1<i64>>, bool, usize)> {
        let model = &self.0;
        let found = py.detach(|| {
            let best = optimum::optimum(&model.mdp, alpha.0)?;
            stationary::search(&model.mdp, alpha.0, &best.policy)
        });
        let found = found.map_err(|error| invalid(error.to_string()))?;
        let action = |state: usize| match model.ended(state) {
            true => -1,
            false => {
                let node = Node { time: model.shift, level: 0, state };
                found.policy.action(&model.mdp, node) as i64
            }
        };
        let actions = PyArray1::from_iter(py, (0..model.states()).map(action));
        Ok((model.law(&found.evaluation.law), actions, found.local_optimum, found.evaluated))
    }
}

/// Shape and numbers of an array.
fn read(array: &PyReadonlyArrayDyn<'_, f64>) -> PyResult<(Vec<usize>, Vec<f64>)> {
    Ok((array.shape().to_vec(), elements(array)?.iter().copied().collect()))
}

/// The best attainable CVaR, and a policy over time, accumulated reward and state that attains it.
#[pyclass(frozen, module = "cvar_game._core")]
pub struct Optimum {
    model: Arc<Model>,
    policy: Policy,
    law: Law,
    alpha: f64,
}

#[pymethods]
impl Optimum {
    /// Risk level.
    #[getter]
    fn alpha(&self) -> f64 {
        self.alpha
    }

    /// The best CVaR.
    #[getter]
    fn cvar(&self) -> f64 {
        self.law.0.cvar(self.alpha)
    }

    /// The lower alpha-quantile of the return under the policy.
    #[getter]
    fn var(&self) -> f64 {
        self.law.0.var(self.alpha)
    }

    /// The mean return of the policy.
    #[getter]
    fn mean(&self) -> f64 {
        self.law.0.mean()
    }

    /// The law of the return under the policy.
    #[getter]
    fn law(&self) -> Law {
        self.law.clone()
    }

    /// Discount per step.
    #[getter]
    fn gamma(&self) -> f64 {
        self.model.mdp.gamma()
    }

    /// Time limit T in steps.
    #[getter]
    fn horizon(&self) -> usize {
        self.model.horizon()
    }

    /// Whether the policy needs time and state only.
    #[getter]
    fn one_level(&self) -> bool {
        self.model.one_level()
    }

    /// The policy's action at a time, with a discounted reward accumulated before it, in a state.
    fn action(
        &self,
        #[pyo3(from_py_with = index)] time: i64,
        accumulated: Real,
        #[pyo3(from_py_with = index)] state: i64,
    ) -> PyResult<usize> {
        let node = valid(self.model.node(time, accumulated.0, state))?;
        Ok(self.policy.action(&self.model.mdp, node))
    }

    /// The actions by time and state, shape `[T, S]`; -1 where the episode has ended.
    fn table<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<i64>>> {
        let model = &self.model;
        model.needs_one_level()?;
        let actions = model.table(|node| self.policy.action(&model.mdp, node));
        actions.into_pyarray(py).reshape([model.horizon(), model.states()])
    }

    /// Itself: it never changes.
    fn __deepcopy__(of: Py<Self>, _memo: &Bound<'_, PyAny>) -> Py<Self> {
        of
    }

    /// The worst case of the policy.
    fn worst_case(&self, py: Python<'_>, eta: Real) -> PyResult<MdpWorstCase> {
        let eta = budget(eta)?;
        valid(py.detach(|| MdpWorstCase::new(&self.model, self.policy.clone(), eta)))
    }
}

/// The likelihood ratios of a worst case, as those of [`cvar_game::exact::antagonist`]: of the probability of the
/// tail after a step to that before it. Returns that differ by rounding only are one return here.
struct Tail {
    model: Arc<Model>,
    /// The solver's return at which the tail ends, and which share of that return belongs to it.
    threshold: f64,
    share: f64,
    /// Probabilities of the tail, by place.
    probabilities: Vec<f64>,
}

impl Tail {
    /// The tail of a deterministic policy whose law, in the solver's returns, is `law`.
    fn new(model: &Arc<Model>, policy: &Policy, law: &ReturnLaw, alpha: f64) -> Self {
        let mdp = &model.mdp;
        let threshold = law.var(alpha);
        let mass = |side: Ordering| -> f64 {
            let atoms = law.atoms().iter();
            atoms.filter(|of| model.compare(of.value, threshold) == side).map(|of| of.mass).sum()
        };
        // Only rounding takes the quotient out of [0, 1].
        let share = ((alpha - mass(Ordering::Less)) / mass(Ordering::Equal)).clamp(0.0, 1.0);
        let places = model.blocks[mdp.horizon()] * mdp.states();
        let mut tail =
            Tail { model: Arc::clone(model), threshold, share, probabilities: vec![0.0; places] };
        for time in (0..mdp.horizon()).rev() {
            for level in 0..mdp.accumulated(time).len() {
                for state in (0..mdp.states()).filter(|state| mdp.actions(*state) > 0) {
                    let node = Node { time, level, state };
                    let action = policy.action(mdp, node);
                    let expectation = (0..mdp.outcome_count(state, action)).map(|outcome| {
                        let probability = mdp.outcome(state, action, outcome).probability;
                        probability * tail.after(node, action, outcome)
                    });
                    let expectation: f64 = expectation.sum();
                    tail.probabilities[model.place(node)] = expectation;
                }
            }
        }
        tail
    }

    /// The probability of the tail at a node; 0 where it is too small to divide by.
    fn at(&self, node: Node) -> f64 {
        let probability = self.probabilities[self.model.place(node)];
        if probability < LEAST_TAIL { 0.0 } else { probability }
    }

    /// That after an outcome.
    fn after(&self, node: Node, action: usize, outcome: usize) -> f64 {
        let mdp = &self.model.mdp;
        let end = |(_, value)| match self.model.compare(value, self.threshold) {
            Ordering::Less => 1.0,
            Ordering::Equal => self.share,
            Ordering::Greater => 0.0,
        };
        match mdp.successor(node, action, outcome) {
            Some(next) => self.at(next),
            None => mdp.ending(node, action, outcome).map_or(0.0, end),
        }
    }
}

impl Perturbation for Tail {
    fn ratio(&self, node: Node, action: usize, outcome: usize) -> f64 {
        let before = self.at(node);
        if before == 0.0 { 1.0 } else { self.after(node, action, outcome) / before }
    }
}

/// The worst that chance can do to a deterministic policy within a budget.
#[pyclass(frozen, module = "cvar_game._core")]
pub struct MdpWorstCase {
    tail: Tail,
    policy: Policy,
    eta: Eta,
    /// The value of the game.
    value: f64,
    /// The law of the return if chance does its worst.
    law: Law,
}

impl MdpWorstCase {
    fn new(model: &Arc<Model>, policy: Policy, eta: Eta) -> Result<Self, String> {
        if eta.get() > LARGEST_BUDGET {
            let eta = eta.get();
            return Err(format!("eta = {eta:e} must be at most {LARGEST_BUDGET:e}"));
        }
        let nominal = evaluate(&model.mdp, &policy).law;
        let tail = Tail::new(model, &policy, &nominal, eta.alpha());
        let law = model.law(&evaluate_under(&model.mdp, &policy, &tail).law);
        let value = nominal.cvar(eta.alpha()) - model.offset;
        Ok(MdpWorstCase { tail, policy, eta, value, law })
    }

    fn model(&self) -> &Model {
        &self.tail.model
    }

    /// The likelihood ratios of the policy's action.
    fn deltas(&self, node: Node) -> impl Iterator<Item = f64> + '_ {
        let mdp = &self.model().mdp;
        let action = self.policy.action(mdp, node);
        let outcomes = mdp.outcome_count(node.state, action);
        (0..outcomes).map(move |outcome| self.tail.ratio(node, action, outcome))
    }
}

#[pymethods]
impl MdpWorstCase {
    /// Budget.
    #[getter]
    fn eta(&self) -> f64 {
        self.eta.get()
    }

    /// The value of the game: the CVaR of the policy at alpha = 1/eta.
    #[getter]
    fn value(&self) -> f64 {
        self.value
    }

    /// The return at which the tail ends: the VaR of the policy at alpha = 1/eta.
    #[getter]
    fn threshold(&self) -> f64 {
        self.tail.threshold - self.model().offset
    }

    /// The law of the return if chance does its worst.
    #[getter]
    fn law(&self) -> Law {
        self.law.clone()
    }

    /// The likelihood ratios of the states in which an episode may start, shape `[S]`; 1 in other states.
    fn start_ratios<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        let (model, mdp) = (self.model(), &self.model().mdp);
        let mut ratios = vec![1.0; model.states()];
        if model.shift == 1 {
            let start = mdp.start_node();
            for outcome in 0..mdp.outcome_count(start.state, 0) {
                ratios[mdp.outcome(start.state, 0, outcome).next] =
                    self.tail.ratio(start, 0, outcome);
            }
        }
        ratios.into_pyarray(py)
    }

    /// The policy's action.
    fn action(
        &self,
        #[pyo3(from_py_with = index)] time: i64,
        accumulated: Real,
        #[pyo3(from_py_with = index)] state: i64,
    ) -> PyResult<usize> {
        let node = valid(self.model().node(time, accumulated.0, state))?;
        Ok(self.policy.action(&self.model().mdp, node))
    }

    /// The likelihood ratios of the outcomes of the policy's action, shape `[K]`, in the order of `Mdp.outcomes`.
    fn ratios<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = index)] time: i64,
        accumulated: Real,
        #[pyo3(from_py_with = index)] state: i64,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let node = valid(self.model().node(time, accumulated.0, state))?;
        Ok(PyArray1::from_iter(py, self.deltas(node)))
    }

    /// The budget that is left there; infinite where the tail is out of reach.
    fn budget(
        &self,
        #[pyo3(from_py_with = index)] time: i64,
        accumulated: Real,
        #[pyo3(from_py_with = index)] state: i64,
    ) -> PyResult<f64> {
        let node = valid(self.model().node(time, accumulated.0, state))?;
        Ok(1.0 / self.tail.at(node))
    }

    /// The likelihood ratios by time, state and outcome, shape `[T, S, K]`; 1 where there is no outcome.
    fn table<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let model = self.model();
        model.needs_one_level()?;
        let width = model.outcomes.iter().flatten().map(Vec::len).max().unwrap_or(0);
        let size = model.horizon().saturating_mul(model.states()).saturating_mul(width);
        if size > MAX_CHOICES {
            return Err(invalid(
                "the table is too large; ask with time, accumulated reward and state",
            ));
        }
        let mut ratios = vec![1.0; size];
        for time in 0..model.horizon() {
            for state in 0..model.states() {
                let row = &mut ratios[(time * model.states() + state) * width..][..width];
                if let Some(node) = model.only_node(time, state) {
                    row.iter_mut().zip(self.deltas(node)).for_each(|(ratio, delta)| *ratio = delta);
                }
            }
        }
        ratios.into_pyarray(py).reshape([model.horizon(), model.states(), width])
    }
}
