//! `table`: any finite Markov decision process, given as the table of its transitions.
//!
//! The table is the CSV text that RiskMDPs.jl and CRAAM read: `idstatefrom,idaction,idstateto,probability,reward`, a line for
//! each transition. Ids may start at 0 or at 1; here they are counted from 0. The protagonist chooses an action of the
//! state, chance decides where it leads and what it pays. A state without transitions, or one that only leads to itself and pays
//! nothing, ends the episode: well if some transition into it pays more than 0, and badly otherwise. After T steps the episode ends, too.

use crate::action::{Action, Discrete, Finite, uniform_index};
use crate::error::{ConfigError, NoSuchState};
use crate::finite::FiniteModel;
use crate::law::FiniteLaw;
use crate::scene::{Area, AreaKind, Field, Scene};
use crate::world::{End, Step, World};
use rand::Rng;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The most actions of a state.
pub const ACTIONS: usize = 16;

/// The most different outcomes of an action: pairs of a next state and a reward.
pub const OUTCOMES: usize = 16;

/// Larger numbers of states are refused: what players see of a state has an entry for each.
const MOST_STATES: usize = 100_000;

/// The columns that are read.
const COLUMNS: [&str; 5] = ["idstatefrom", "idaction", "idstateto", "probability", "reward"];

/// Work above which the range of returns is bounded and not computed.
const MOST_WORK: usize = 50_000_000;

/// Names of the actions.
const NAMES: [&str; ACTIONS] =
    ["0", "1", "2", "3", "4", "5", "6", "7", "8", "9", "10", "11", "12", "13", "14", "15"];

/// The constants, with what they mean, their defaults and their ranges.
const DEFAULTS: &str = r#"# table: any finite Markov decision process, given as the table of its transitions.

# The transitions as CSV, with a header: idstatefrom, idaction, idstateto, probability, reward; other columns are ignored.
# Ids of states and actions start at 0 or at 1. `--file mdp.csv` reads them from a file. By default the program's
# counterexample to the decomposition of CVaR: at eta = 2 the best CVaR is 0, and Chow's programme says 1/12.
model = """
idstatefrom,idaction,idstateto,probability,reward
0,0,1,0.5,0
0,0,2,0.5,0
1,0,3,1,0
1,1,3,0.5,-1
1,1,3,0.5,1.5
2,0,3,1,0.5
"""

# The state in which an episode starts, counted from 0 whatever the first id of the table is.
# Range: [0, 99999]
start = 0

# Columns of pictures, in which the states are the cells, row by row; 0 makes them about square.
# Range: [0, 99999]
columns = 0

# Time limit T in steps. A true end of the episode: nothing is bootstrapped.
# Range: [1, 1000000]
horizon = 100
"#;

/// The number of a state says nothing about its neighbours, and a reward may be far away.
const TRAINING: &str = r#"# How both players see the world: which of the states it is in, one-hot.
observation = "features"

# Half of the episodes start anywhere, fading out: a single reward at the end is met then.
exploring_starts = 0.5

# The protagonist's critic sees the time and the remaining budget.
critic_sees = "game"

# A tenth of the run at budget 1.
budget_wait = 0.1
# Three tenths for the rise after it.
budget_rise = 0.3
# The antagonist's gradient counts what it spends.
budget_sensitivity = true

# The protagonist of this world.
[protagonist]

# The best policy of a process with a time limit depends on the time.
time_aware = true
# A bonus that finds a single reward far away.
entropy = 0.05
# It fades.
entropy_final = 0.0

# The antagonist of this world.
[antagonist]

# What is left of the episode decides where the budget is best spent.
time_aware = true
# As on lava-grid in configs/paper.toml.
minibatch = 250
# The bonus fades.
entropy_final = 0.0
"#;

/// Constants of `table`; [`Table::DEFAULTS`] explains them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TableConfig {
    /// The transitions as CSV.
    pub model: String,
    /// The state in which an episode starts, from 0.
    pub start: usize,
    /// Columns of pictures; 0 makes them about square.
    pub columns: usize,
    /// Time limit T in steps.
    pub horizon: u32,
}

impl Default for TableConfig {
    /// What [`Table::DEFAULTS`] says.
    fn default() -> Self {
        Table::defaults()
    }
}

/// The action of a number. A state that has fewer actions counts them through: with two, the third is its first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Choice(usize);

impl Action for Choice {
    type Kind = Finite<ACTIONS>;

    fn uniform(random: &mut impl Rng) -> Choice {
        uniform_index(random)
    }
}

impl Discrete for Choice {
    const COUNT: usize = ACTIONS;

    fn index(self) -> usize {
        self.0
    }

    fn from_index(index: usize) -> Choice {
        assert!(index < ACTIONS, "there is no action {index}");
        Choice(index)
    }
}

/// State of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    state: usize,
    time: u32,
    ended: bool,
}

/// What an action leads to.
#[derive(Debug, Clone, Copy)]
struct Transition {
    law: FiniteLaw<OUTCOMES>,
    /// By outcome; impossible outcomes lead where the first one does.
    successors: [(usize, Step); OUTCOMES],
}

/// What a state is.
#[derive(Debug, Clone)]
enum Kind {
    Running(Vec<Transition>),
    Ended(End),
}

/// A batch of episodes of one process.
#[derive(Debug, Clone)]
pub struct Table {
    config: TableConfig,
    states: Vec<Kind>,
    columns: usize,
    episodes: Vec<Place>,
}

/// Outcomes of an action: next state and bits of the reward, with their probability.
type Outcomes = BTreeMap<(usize, u64), f64>;

/// The lines of a table, by state and action, counted from 0, and the number of states.
struct Lines {
    actions: BTreeMap<(usize, usize), Outcomes>,
    states: usize,
}

fn refused(line: u64, problem: impl Into<String>) -> ConfigError {
    ConfigError::Model { line, problem: problem.into() }
}

impl Lines {
    fn read(text: &str) -> Result<Lines, ConfigError> {
        // The text may begin with an empty line.
        let before = text.len() - text.trim_start().len();
        let skipped = text[..before].matches('\n').count() as u64;
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .flexible(true)
            .from_reader(&text.as_bytes()[before..]);
        let header = reader.headers().map_err(|error| refused(1, error.to_string()))?.clone();
        let place = |name: &str| header.iter().position(|of| of.eq_ignore_ascii_case(name));
        let places = COLUMNS.map(place);
        if places.contains(&None) {
            return Err(refused(
                skipped + 1,
                format!("the header must have {}", COLUMNS.join(",")),
            ));
        }
        let places = places.map(Option::unwrap_or_default);
        let mut rows: Vec<(u64, [usize; 3], f64, f64)> = Vec::new();
        for record in reader.records() {
            let record = record.map_err(|error| refused(1, error.to_string()))?;
            let line = skipped + record.position().map_or(0, csv::Position::line);
            let field = |column: usize| {
                let text = record.get(places[column]).unwrap_or_default();
                let value = text.parse::<f64>().ok().filter(|value| value.is_finite());
                value.ok_or_else(|| {
                    refused(line, format!("{} = {text:?} is no number", COLUMNS[column]))
                })
            };
            let id = |column: usize| {
                let value = field(column)?;
                let whole = value.fract() == 0.0 && (0.0..=MOST_STATES as f64).contains(&value);
                let what = || {
                    let name = COLUMNS[column];
                    refused(
                        line,
                        format!("{name} = {value} must be a whole number of at most {MOST_STATES}"),
                    )
                };
                whole.then_some(value as usize).ok_or_else(what)
            };
            let (ids, probability, reward) = ([id(0)?, id(1)?, id(2)?], field(3)?, field(4)?);
            if !(0.0..=1.0 + 1e-6).contains(&probability) {
                return Err(refused(
                    line,
                    format!("probability = {probability} must be in [0, 1]"),
                ));
            }
            if reward.abs() > 1e6 {
                return Err(refused(
                    line,
                    format!("reward = {reward} must be in [-1000000, 1000000]"),
                ));
            }
            rows.push((line, ids, probability, reward));
        }
        if rows.is_empty() {
            return Err(refused(skipped + 1, "it has no transitions"));
        }
        let least = |of: &[usize]| {
            let ids = rows.iter().flat_map(|row| of.iter().map(|&column| row.1[column]));
            ids.min().unwrap_or_default()
        };
        let first = [least(&[0, 2]), least(&[1])];
        for (first, what) in first.iter().zip(["states", "actions"]) {
            if *first > 1 {
                let problem =
                    format!("the ids of {what} must start at 0 or 1, and the first one is {first}");
                return Err(refused(skipped + 1, problem));
            }
        }
        let mut lines = Lines { actions: BTreeMap::new(), states: 0 };
        let mut begun = BTreeMap::new();
        for (line, [from, action, to], probability, reward) in rows {
            let (from, action, to) = (from - first[0], action - first[1], to - first[0]);
            lines.states = lines.states.max(from + 1).max(to + 1);
            begun.entry((from, action)).or_insert(line);
            // 0 and -0 are one reward.
            let outcome = (to, (reward + 0.0).to_bits());
            let outcomes = lines.actions.entry((from, action)).or_default();
            if probability > 0.0 {
                *outcomes.entry(outcome).or_default() += probability;
            }
        }
        for (&(state, action), outcomes) in &lines.actions {
            let line = begun[&(state, action)];
            let own = |id: usize, of: usize| id + first[of];
            let (from, name) = (own(state, 0), own(action, 1));
            let sum: f64 = outcomes.values().sum();
            if (sum - 1.0).abs() > 1e-6 {
                let problem = format!(
                    "the probabilities of action {name} in state {from} sum to {sum}, not to 1"
                );
                return Err(refused(line, problem));
            }
            if action > 0 && !lines.actions.contains_key(&(state, action - 1)) {
                let problem =
                    format!("state {from} has an action {name} but no action {}", name - 1);
                return Err(refused(line, problem));
            }
            if action >= ACTIONS {
                return Err(refused(line, format!("state {from} has more than {ACTIONS} actions")));
            }
            if outcomes.len() > OUTCOMES {
                let problem = format!(
                    "action {name} in state {from} has more than {OUTCOMES} different outcomes"
                );
                return Err(refused(line, problem));
            }
        }
        Ok(lines)
    }

    /// What each state is.
    fn kinds(&self) -> Vec<Kind> {
        let stays = |state: usize| {
            let of_state = self.actions.range((state, 0)..(state + 1, 0));
            of_state.flat_map(|(_, outcomes)| outcomes.keys()).all(|&key| key == (state, 0))
        };
        let ends: Vec<bool> = (0..self.states).map(stays).collect();
        let mut pays = vec![false; self.states];
        for &(next, reward) in self.actions.values().flat_map(BTreeMap::keys) {
            pays[next] |= f64::from_bits(reward) > 0.0;
        }
        let end = |state: usize| if pays[state] { End::Goal } else { End::Lava };
        let transition = |outcomes: &Outcomes| {
            let sum: f64 = outcomes.values().sum();
            let mut probabilities = [0.0; OUTCOMES];
            let successor = |&(next, reward): &(usize, u64)| {
                let end = ends[next].then(|| end(next));
                (next, Step { reward: f64::from_bits(reward), end })
            };
            let first = outcomes.keys().next().map_or((0, Step::IDLE), successor);
            let mut successors = [first; OUTCOMES];
            for (place, (key, probability)) in outcomes.iter().enumerate() {
                probabilities[place] = probability / sum;
                successors[place] = successor(key);
            }
            Transition { law: FiniteLaw { probabilities }, successors }
        };
        let kind = |state: usize| {
            if ends[state] {
                return Kind::Ended(end(state));
            }
            let of_state = self.actions.range((state, 0)..(state + 1, 0));
            Kind::Running(of_state.map(|(_, outcomes)| transition(outcomes)).collect())
        };
        (0..self.states).map(kind).collect()
    }
}

impl Table {
    fn transition(&self, state: usize, action: usize) -> Option<&Transition> {
        match &self.states[state] {
            Kind::Running(actions) => actions.get(action % actions.len()),
            Kind::Ended(_) => None,
        }
    }

    /// Column and row of a state in pictures.
    fn cell(&self, state: usize) -> [usize; 2] {
        [state % self.columns, state / self.columns]
    }

    fn scaled(&self, state: usize) -> f32 {
        let last = self.states.len().saturating_sub(1).max(1);
        (2.0 * state as f64 / last as f64 - 1.0) as f32
    }
}

impl World for Table {
    type Constants = TableConfig;
    type Action = Choice;
    type Law = FiniteLaw<OUTCOMES>;
    type Snapshot = Place;

    const NAME: &'static str = "table";
    const DEFAULTS: &'static str = DEFAULTS;
    const TRAINING: &'static str = TRAINING;
    /// What it plays is the user's.
    const IN_BENCHMARK: bool = false;

    /// The state's index, mapped from the first to the last one onto [-1, 1].
    const OBSERVATION: usize = 1;
    /// The same of the state and of the action, and the probabilities of the outcomes.
    const SITUATION: usize = 2 + OUTCOMES;

    fn of_model(text: &str) -> Result<toml::Table, String> {
        Lines::read(text).map_err(|error| error.to_string())?;
        Ok(toml::Table::from_iter([("model".to_owned(), text.into())]))
    }

    fn validate(constants: &TableConfig) -> Result<(), ConfigError> {
        Table::new(constants, 1).map(|_| ())
    }

    fn new(config: &TableConfig, episodes: usize) -> Result<Self, ConfigError> {
        let states = Lines::read(&config.model)?.kinds();
        if config.start >= states.len() {
            let allowed = format!("a state of the table, from 0 to {}", states.len() - 1);
            return Err(ConfigError::value("start", config.start, allowed));
        }
        if matches!(states[config.start], Kind::Ended(_)) {
            return Err(ConfigError::value(
                "start",
                config.start,
                "a state in which episodes continue",
            ));
        }
        if config.columns >= MOST_STATES {
            return Err(ConfigError::value(
                "columns",
                config.columns,
                format!("below {MOST_STATES}"),
            ));
        }
        if !(1..=1_000_000).contains(&config.horizon) {
            return Err(ConfigError::value("horizon", config.horizon, "from 1 to 1000000 steps"));
        }
        let square = (states.len() as f64).sqrt().ceil() as usize;
        let columns = if config.columns == 0 { square } else { config.columns };
        let initial = Place { state: config.start, time: 0, ended: false };
        Ok(Table { config: config.clone(), states, columns, episodes: vec![initial; episodes] })
    }

    fn constants(&self) -> &TableConfig {
        &self.config
    }

    fn episodes(&self) -> usize {
        self.episodes.len()
    }

    fn horizon(&self) -> u32 {
        self.config.horizon
    }

    fn reset(&mut self, slot: usize) {
        self.episodes[slot] = Place { state: self.config.start, time: 0, ended: false };
    }

    fn snapshot(&self, slot: usize) -> Place {
        self.episodes[slot]
    }

    fn restore(&mut self, slot: usize, snapshot: Place) -> Result<(), NoSuchState> {
        let Place { state, time, ended } = snapshot;
        // A running episode has time left, and is in a state with actions.
        let running = || matches!(self.states[state], Kind::Running(_));
        if state >= self.states.len()
            || time > self.config.horizon - u32::from(!ended)
            || !(ended || running())
        {
            return Err(NoSuchState::of(&snapshot));
        }
        self.episodes[slot] = snapshot;
        Ok(())
    }

    fn time(&self, slot: usize) -> u32 {
        self.episodes[slot].time
    }

    fn observe(&self, slot: usize, observation: &mut [f32]) {
        observation[0] = self.scaled(self.episodes[slot].state);
    }

    fn law(&self, slot: usize, action: Choice) -> FiniteLaw<OUTCOMES> {
        let over = || {
            let mut probabilities = [0.0; OUTCOMES];
            probabilities[0] = 1.0;
            FiniteLaw { probabilities }
        };
        self.transition(self.episodes[slot].state, action.0).map_or_else(over, |of| of.law)
    }

    fn situation(&self, slot: usize, action: Choice, situation: &mut [f32]) {
        situation[0] = self.scaled(self.episodes[slot].state);
        situation[1] = (2.0 * action.0 as f64 / (ACTIONS - 1) as f64 - 1.0) as f32;
        let law = self.law(slot, action);
        for (entry, probability) in situation[2..].iter_mut().zip(law.probabilities) {
            *entry = probability as f32;
        }
    }

    /// 0 in a state that ends the episode badly, else infinity: a table knows no distances.
    fn clearance(&self, slot: usize) -> f64 {
        match self.states[self.episodes[slot].state] {
            Kind::Ended(End::Lava) => 0.0,
            _ => f64::INFINITY,
        }
    }

    fn position(&self, slot: usize) -> [f64; 2] {
        self.cell(self.episodes[slot].state).map(|of| of as f64)
    }

    fn scene(&self) -> Scene {
        let rows = self.states.len().div_ceil(self.columns);
        let kind = |state: usize| match self.states.get(state) {
            Some(Kind::Running(_)) => None,
            Some(Kind::Ended(End::Goal)) => Some(AreaKind::Goal),
            Some(Kind::Ended(_)) => Some(AreaKind::Lava),
            None => Some(AreaKind::Wall),
        };
        let area = |state: usize| {
            let min = self.cell(state).map(|of| of as f64);
            kind(state).map(|kind| Area { kind, min, max: min.map(|of| of + 1.0) })
        };
        Scene {
            size: [self.columns as f64, rows as f64],
            cells: true,
            start: self.cell(self.config.start).map(|of| of as f64),
            areas: (0..self.columns * rows).filter_map(area).collect(),
            rules: format!(
                "States are the cells, row by row from 0. The table of transitions says where an action leads and what \
                 it pays. Step {} ends the episode.",
                self.config.horizon
            ),
        }
    }

    fn return_range(&self, gamma: f64) -> Option<[f64; 2]> {
        let horizon = self.config.horizon;
        let transitions = || {
            self.states.iter().flat_map(|kind| match kind {
                Kind::Running(actions) => &actions[..],
                Kind::Ended(_) => &[],
            })
        };
        let work = transitions().count() * OUTCOMES * horizon as usize;
        if work > MOST_WORK {
            let last = gamma.powf(f64::from(horizon));
            let sum = if gamma < 1.0 { (1.0 - last) / (1.0 - gamma) } else { f64::from(horizon) };
            let rewards = transitions().flat_map(|of| of.successors).map(|(_, step)| step.reward);
            let [least, greatest] = rewards
                .fold([0.0_f64; 2], |[low, high], reward| [low.min(reward), high.max(reward)]);
            return Some([least * sum, greatest * sum]);
        }
        // What can still be earned, backwards in time.
        let mut ahead = vec![[0.0_f64; 2]; self.states.len()];
        for _ in 0..horizon {
            let of_state = |kind: &Kind| {
                let Kind::Running(actions) = kind else { return [0.0; 2] };
                let mut range = [f64::INFINITY, f64::NEG_INFINITY];
                for of in actions {
                    for (place, (next, step)) in of.successors.iter().enumerate() {
                        if of.law.probabilities[place] > 0.0 {
                            let [low, high] = ahead[*next].map(|later| step.reward + gamma * later);
                            range = [range[0].min(low), range[1].max(high)];
                        }
                    }
                }
                range
            };
            ahead = self.states.iter().map(of_state).collect();
        }
        Some(ahead[self.config.start])
    }

    fn headline(&self) -> String {
        format!("{} states", self.states.len())
    }

    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)> {
        vec![("state", Field::Count(self.episodes[slot].state as u64))]
    }

    fn action_columns(action: Choice) -> Vec<(&'static str, Field)> {
        vec![("action", Field::Word(NAMES[action.0]))]
    }

    fn outcome_columns(outcome: usize) -> Vec<(&'static str, Field)> {
        vec![("outcome", Field::Count(outcome as u64))]
    }

    /// A number has no direction.
    fn action_arrow(_action: Choice) -> [f64; 2] {
        [0.0; 2]
    }

    fn outcome_arrow(_outcome: usize) -> [f64; 2] {
        [0.0; 2]
    }

    fn finite(&self) -> Option<&dyn FiniteModel> {
        Some(self)
    }

    fn finite_mut(&mut self) -> Option<&mut dyn FiniteModel> {
        Some(self)
    }

    fn apply(&mut self, actions: &[Choice], outcomes: &[usize], steps: &mut [Step]) {
        for (slot, step) in steps.iter_mut().enumerate() {
            let mut place = self.episodes[slot];
            *step = Step::IDLE;
            if place.ended {
                continue;
            }
            let Some(transition) = self.transition(place.state, actions[slot].0) else { continue };
            (place.state, *step) = transition.successors[outcomes[slot]];
            place.time += 1;
            if step.end.is_none() && place.time == self.config.horizon {
                step.end = Some(End::Timeout);
            }
            place.ended = step.end.is_some();
            self.episodes[slot] = place;
        }
    }
}

/// States and actions are those of the table, outcomes its different pairs of next state and reward.
impl FiniteModel for Table {
    fn states(&self) -> usize {
        self.states.len()
    }

    fn start(&self) -> usize {
        self.config.start
    }

    fn actions(&self) -> usize {
        ACTIONS
    }

    fn outcomes(&self) -> usize {
        OUTCOMES
    }

    fn ended(&self, state: usize) -> Option<End> {
        match self.states[state] {
            Kind::Running(_) => None,
            Kind::Ended(end) => Some(end),
        }
    }

    fn probabilities(&self, state: usize, action: usize) -> Vec<f64> {
        self.transition(state, action).map_or_else(Vec::new, |of| of.law.probabilities.to_vec())
    }

    fn successor(&self, state: usize, action: usize, outcome: usize) -> (usize, Step) {
        self.transition(state, action).map_or((state, Step::IDLE), |of| of.successors[outcome])
    }

    fn intended_outcome(&self, _action: usize) -> Option<usize> {
        None
    }

    fn action_name(&self, action: usize) -> &'static str {
        NAMES[action]
    }

    fn arrow(&self, _action: usize) -> [f64; 2] {
        [0.0; 2]
    }

    fn coordinates(&self, state: usize) -> [usize; 2] {
        self.cell(state)
    }

    fn state(&self, slot: usize) -> usize {
        self.episodes[slot].state
    }

    fn is_over(&self, slot: usize) -> bool {
        self.episodes[slot].ended
    }

    fn place(&mut self, slot: usize, state: usize, time: u32) {
        assert!(state < self.states.len(), "state {state} of {}", self.states.len());
        self.episodes[slot] = Place { state, time, ended: false };
    }
}
