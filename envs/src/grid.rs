//! `lava-grid`: a walk over the cells of a map, with slips.
//!
//! The state is a cell (x, y), x to the right and y downward. The protagonist chooses one of four
//! moves; chance decides which move o_t is executed: the chosen one with probability 1 - p, each
//! other one with probability p/3. A move off the map or into a wall leaves the state unchanged.
//! The reward is `goal_reward` on entering a goal and `lava_reward` on entering lava, both of which
//! end the episode, and otherwise `-step_cost`: the terminal step carries no step cost. After T steps
//! the episode ends. Lengths are in cells.
//!
//! Source: the gridworld of "A Game-Theoretic Perspective on Risk-Sensitive Reinforcement Learning"
//! (arXiv 2109.09470).

use crate::action::{Action, Discrete, Finite, uniform_index};
use crate::error::{ConfigError, NoSuchState, require, require_rewards};
use crate::finite::FiniteModel;
use crate::law::FiniteLaw;
use crate::map::{Map, Tile};
use crate::scene::{Area, AreaKind, Field, Scene};
use crate::world::{End, Step, World, return_range};
use rand::Rng;
use serde::{Deserialize, Serialize};

/// Number of moves, which are both the actions and the outcomes of chance.
pub const MOVES: usize = 4;

/// The constants, with what they mean, their defaults and their ranges.
const DEFAULTS: &str = r#"# lava-grid: a walk over the cells of a map, with slips. Lengths are in cells.

# The map: S start (one), G goal, g lesser goal, L lava, . free, # wall. The paper's 10 x 7 cells. Rows are equally
# long; white space around them does not count. A way past lava and walls leads to a goal within the
# time limit.
map = """
S.LLLLLL.G
..LLLLLL..
..........
..........
..........
..........
..........
"""

# Probability that a move other than the chosen one is executed. The paper's 0.05.
# Range: [0, 1]
slip = 0.05

# What a step costs that ends in neither goal nor lava: it is subtracted. The paper's 0.035.
# Range: [0, 1000000]
step_cost = 0.035

# Reward on entering a goal, which ends the episode.
# Range: [-1000000, 1000000]
goal_reward = 1.0

# Reward on entering a lesser goal `g`, which ends the episode too. The paper's map has none.
# Range: [-1000000, 1000000]
lesser_goal_reward = 0.5

# Reward on entering lava, which ends the episode.
# Range: [-1000000, 1000000]
lava_reward = -1.0

# Time limit T in steps. A true end of the episode: nothing is bootstrapped. The paper's 40. At least the
# moves of the shortest way to a goal.
# Range: [1, 1000000]
horizon = 40
"#;

/// Constants of `lava-grid`; [`LavaGrid::DEFAULTS`] explains them and has their defaults and ranges.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridConfig {
    /// The map as a picture, see [`crate::map`].
    pub map: String,
    /// Probability p that a move other than the chosen one is executed.
    pub slip: f64,
    /// Cost of a step that ends in neither goal nor lava: it is subtracted from the return.
    pub step_cost: f64,
    /// Reward on entering a goal.
    pub goal_reward: f64,
    /// Reward on entering a lesser goal; former versions had none.
    #[serde(default = "lesser_goal_reward")]
    pub lesser_goal_reward: f64,
    /// Reward on entering lava.
    pub lava_reward: f64,
    /// Time limit T in steps.
    pub horizon: u32,
}

/// The default of [`GridConfig::lesser_goal_reward`].
fn lesser_goal_reward() -> f64 {
    0.5
}

impl Default for GridConfig {
    /// What [`LavaGrid::DEFAULTS`] says.
    fn default() -> Self {
        LavaGrid::defaults()
    }
}

impl GridConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Names the first field that is out of range, its value and the range, or the place in the map. A map
    /// whose goals cannot be reached in time is refused too, though [`LavaGrid`] can be made of it.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let map = self.parse()?;
        let Some(moves) = map.moves_to_goal() else {
            let (x, y) = map.coordinates(map.start());
            return Err(ConfigError::Map {
                row: y + 1,
                column: x + 1,
                problem: "no way past lava and walls leads from this start to a goal".into(),
                remedy: "open one".into(),
            });
        };
        if moves > self.horizon as usize {
            let allowed = format!("at least {moves}, the moves of the shortest way to a goal");
            return Err(ConfigError::value("horizon", self.horizon, allowed));
        }
        Ok(())
    }

    fn parse(&self) -> Result<Map, ConfigError> {
        require("slip", self.slip, |p| (0.0..=1.0).contains(&p), "a probability in [0, 1]")?;
        let rewards = [self.goal_reward, self.lesser_goal_reward, self.lava_reward];
        require_rewards(self.step_cost, rewards, self.horizon)?;
        Map::parse(&self.map)
    }
}

/// A move on the grid; y grows downward.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Move {
    /// y - 1
    Up,
    /// y + 1
    Down,
    /// x + 1
    Right,
    /// x - 1
    Left,
}

impl Move {
    /// All moves, ordered by index.
    pub const ALL: [Move; MOVES] = [Move::Up, Move::Down, Move::Right, Move::Left];

    /// The move in a word, as in files.
    pub fn name(self) -> &'static str {
        ["up", "down", "right", "left"][self.index()]
    }
}

impl Action for Move {
    type Kind = Finite<MOVES>;

    fn uniform(random: &mut impl Rng) -> Move {
        uniform_index(random)
    }
}

/// The index is the position in [`Move::ALL`], which is also the outcome in a [`FiniteLaw`].
impl Discrete for Move {
    const COUNT: usize = MOVES;

    fn index(self) -> usize {
        self as usize
    }

    fn from_index(index: usize) -> Move {
        Move::ALL[index]
    }
}

/// State of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Episode {
    cell: usize,
    time: u32,
    ended: bool,
}

/// A batch of episodes on one map, and the map's dynamics for exact solvers.
#[derive(Debug, Clone)]
pub struct LavaGrid {
    config: GridConfig,
    map: Map,
    /// What each move leads to, by cell.
    successors: Vec<[(usize, Step); MOVES]>,
    /// The nominal law of the executed move, by the chosen one.
    laws: [FiniteLaw<MOVES>; MOVES],
    /// The position in [-1, 1]^2, by cell.
    scaled: Vec<[f32; 2]>,
    /// Distance to the nearest lava per cell, in moves.
    clearance: Vec<f64>,
    episodes: Vec<Episode>,
}

impl LavaGrid {
    /// The map of this world.
    pub fn map(&self) -> &Map {
        &self.map
    }

    /// Number of cells of the map; cells are numbered row by row.
    pub fn cells(&self) -> usize {
        self.map.cells()
    }

    /// Number of columns.
    pub fn width(&self) -> usize {
        self.map.width()
    }

    /// Number of rows.
    pub fn height(&self) -> usize {
        self.map.height()
    }

    /// The cell in which an episode starts.
    pub fn start(&self) -> usize {
        self.map.start()
    }

    /// The cell in column x and row y; panics outside the map.
    pub fn cell(&self, x: usize, y: usize) -> usize {
        self.map.cell(x, y)
    }

    /// Column x and row y of a cell.
    pub fn coordinates(&self, cell: usize) -> (usize, usize) {
        self.map.coordinates(cell)
    }

    /// Whether entering the cell ends the episode with [`End::Lava`].
    pub fn is_lava(&self, cell: usize) -> bool {
        self.map.tile(cell) == Tile::Lava
    }

    /// Whether entering the cell ends the episode with [`End::Goal`].
    pub fn is_goal(&self, cell: usize) -> bool {
        self.map.tile(cell).is_goal()
    }

    /// Whether the cell can never be entered.
    pub fn is_wall(&self, cell: usize) -> bool {
        self.map.tile(cell) == Tile::Wall
    }

    /// What executing a move in a cell leads to, leaving the time limit aside. A goal or lava cell
    /// is absorbing and pays nothing.
    pub fn successor(&self, cell: usize, executed: Move) -> (usize, Step) {
        self.successors[cell][executed.index()]
    }

    /// The nominal law of the executed move, which depends only on the chosen move.
    pub fn law_of(&self, chosen: Move) -> FiniteLaw<MOVES> {
        self.laws[chosen.index()]
    }

    fn coordinates_of(&self, cell: usize) -> [f64; 2] {
        let (x, y) = self.map.coordinates(cell);
        [x as f64, y as f64]
    }
}

/// See [`LavaGrid::successor`].
fn successor(config: &GridConfig, map: &Map, cell: usize, executed: Move) -> (usize, Step) {
    if matches!(map.tile(cell), Tile::Goal | Tile::LesserGoal | Tile::Lava) {
        return (cell, Step::IDLE);
    }
    let (x, y) = map.coordinates(cell);
    let next = match executed {
        Move::Up if y > 0 => cell - map.width(),
        Move::Down if y + 1 < map.height() => cell + map.width(),
        Move::Right if x + 1 < map.width() => cell + 1,
        Move::Left if x > 0 => cell - 1,
        _ => cell,
    };
    let next = if map.tile(next) == Tile::Wall { cell } else { next };
    let step = match map.tile(next) {
        Tile::Goal => Step { reward: config.goal_reward, end: Some(End::Goal) },
        Tile::LesserGoal => Step { reward: config.lesser_goal_reward, end: Some(End::Goal) },
        Tile::Lava => Step { reward: config.lava_reward, end: Some(End::Lava) },
        Tile::Free | Tile::Wall => Step { reward: -config.step_cost, end: None },
    };
    (next, step)
}

/// A coordinate 0..cells mapped onto [-1, 1]; 0 where there is one cell only.
fn scaled(coordinate: usize, cells: usize) -> f32 {
    if cells == 1 { 0.0 } else { (2.0 * coordinate as f64 / (cells - 1) as f64 - 1.0) as f32 }
}

/// Number of moves |dx| + |dy| from each cell to the nearest lava cell, as if there were no walls;
/// infinity if there is no lava.
fn clearance(map: &Map) -> Vec<f64> {
    // The city-block distance transform: one sweep down and right, one up and left.
    let (width, cells) = (map.width(), map.cells());
    let mut distance: Vec<f64> = (0..cells)
        .map(|cell| if map.tile(cell) == Tile::Lava { 0.0 } else { f64::INFINITY })
        .collect();
    for cell in 0..cells {
        if cell % width > 0 {
            distance[cell] = distance[cell].min(distance[cell - 1] + 1.0);
        }
        if cell >= width {
            distance[cell] = distance[cell].min(distance[cell - width] + 1.0);
        }
    }
    for cell in (0..cells).rev() {
        if cell % width + 1 < width {
            distance[cell] = distance[cell].min(distance[cell + 1] + 1.0);
        }
        if cell + width < cells {
            distance[cell] = distance[cell].min(distance[cell + width] + 1.0);
        }
    }
    distance
}

impl World for LavaGrid {
    type Constants = GridConfig;
    type Action = Move;
    type Law = FiniteLaw<MOVES>;
    type Snapshot = Episode;

    const NAME: &'static str = "lava-grid";
    const DEFAULTS: &'static str = DEFAULTS;
    const OUTCOMES_ARE_ACTIONS: bool = true;

    /// (x, y), each mapped from its first to its last cell onto [-1, 1].
    const OBSERVATION: usize = 2;
    /// (x, y) likewise, then the probabilities of the four moves.
    const SITUATION: usize = 2 + MOVES;
    /// Both vectors begin with the position.
    const POSITIONS: usize = 2;

    fn of_map(map: &Map) -> Result<toml::Table, String> {
        Ok(toml::Table::from_iter([("map".to_owned(), map.to_string().into())]))
    }

    fn new(config: &GridConfig, episodes: usize) -> Result<Self, ConfigError> {
        let map = config.parse()?;
        let initial = Episode { cell: map.start(), time: 0, ended: false };
        let successors = |cell| Move::ALL.map(|executed| successor(config, &map, cell, executed));
        let law = |chosen: Move| {
            let mut probabilities = [config.slip / 3.0; MOVES];
            probabilities[chosen.index()] = 1.0 - config.slip;
            FiniteLaw { probabilities }
        };
        let position = |cell| {
            let (x, y) = map.coordinates(cell);
            [scaled(x, map.width()), scaled(y, map.height())]
        };
        Ok(LavaGrid {
            config: config.clone(),
            successors: (0..map.cells()).map(successors).collect(),
            laws: Move::ALL.map(law),
            scaled: (0..map.cells()).map(position).collect(),
            clearance: clearance(&map),
            episodes: vec![initial; episodes],
            map,
        })
    }

    fn constants(&self) -> &GridConfig {
        &self.config
    }

    fn validate(constants: &GridConfig) -> Result<(), ConfigError> {
        constants.validate()
    }

    fn episodes(&self) -> usize {
        self.episodes.len()
    }

    fn horizon(&self) -> u32 {
        self.config.horizon
    }

    fn reset(&mut self, slot: usize) {
        self.episodes[slot] = Episode { cell: self.map.start(), time: 0, ended: false };
    }

    fn snapshot(&self, slot: usize) -> Episode {
        self.episodes[slot]
    }

    fn restore(&mut self, slot: usize, snapshot: Episode) -> Result<(), NoSuchState> {
        let Episode { cell, time, ended } = snapshot;
        let enterable = cell < self.cells() && !self.is_wall(cell);
        // A running episode has time left.
        if !enterable || time > self.config.horizon - u32::from(!ended) {
            return Err(NoSuchState::of(&snapshot));
        }
        self.episodes[slot] = snapshot;
        Ok(())
    }

    fn time(&self, slot: usize) -> u32 {
        self.episodes[slot].time
    }

    fn observe(&self, slot: usize, observation: &mut [f32]) {
        observation.copy_from_slice(&self.scaled[self.episodes[slot].cell]);
    }

    fn law(&self, _slot: usize, action: Move) -> FiniteLaw<MOVES> {
        self.law_of(action)
    }

    fn situation(&self, slot: usize, action: Move, situation: &mut [f32]) {
        situation[..2].copy_from_slice(&self.scaled[self.episodes[slot].cell]);
        for (entry, probability) in situation[2..].iter_mut().zip(self.law_of(action).probabilities)
        {
            *entry = probability as f32;
        }
    }

    /// Number of moves |dx| + |dy| to the nearest lava cell, as if there were no walls; infinity if
    /// the map has no lava.
    fn clearance(&self, slot: usize) -> f64 {
        self.clearance[self.episodes[slot].cell]
    }

    fn position(&self, slot: usize) -> [f64; 2] {
        self.coordinates_of(self.episodes[slot].cell)
    }

    fn scene(&self) -> Scene {
        let cell = |cell: usize| {
            let [x, y] = self.coordinates_of(cell);
            ([x, y], [x + 1.0, y + 1.0])
        };
        let kind = |of: usize| match self.map.tile(of) {
            Tile::Free => None,
            Tile::Lava => Some(AreaKind::Lava),
            Tile::Goal => Some(AreaKind::Goal),
            Tile::LesserGoal => Some(AreaKind::LesserGoal),
            Tile::Wall => Some(AreaKind::Wall),
        };
        let area = |of: usize| {
            let (min, max) = cell(of);
            kind(of).map(|kind| Area { kind, min, max })
        };
        let GridConfig { slip, step_cost, goal_reward, lava_reward, horizon, .. } = &self.config;
        Scene {
            size: [self.width() as f64, self.height() as f64],
            cells: true,
            start: self.coordinates_of(self.start()),
            areas: (0..self.cells()).filter_map(area).collect(),
            rules: format!(
                "A step costs {step_cost}, lava pays {lava_reward} and the goal {goal_reward}, both of \
                 which end the episode; so does step {horizon}. With probability {slip} a move other \
                 than the chosen one is executed."
            ),
        }
    }

    fn return_range(&self, gamma: f64) -> Option<[f64; 2]> {
        let of = &self.config;
        let ends = (0..self.cells()).filter_map(|cell| match self.map.tile(cell) {
            Tile::Goal => Some(of.goal_reward),
            Tile::LesserGoal => Some(of.lesser_goal_reward),
            Tile::Lava => Some(of.lava_reward),
            Tile::Free | Tile::Wall => None,
        });
        Some(return_range(of.step_cost, &ends.collect::<Vec<_>>(), of.horizon, gamma))
    }

    fn headline(&self) -> String {
        format!("slip {}, step cost {}", self.config.slip, self.config.step_cost)
    }

    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)> {
        let [x, y] = self.position(slot);
        vec![("x", Field::Number(x)), ("y", Field::Number(y))]
    }

    fn action_columns(action: Move) -> Vec<(&'static str, Field)> {
        vec![("action", Field::Word(action.name()))]
    }

    fn outcome_columns(outcome: usize) -> Vec<(&'static str, Field)> {
        vec![("executed", Field::Word(Move::from_index(outcome).name()))]
    }

    fn action_arrow(action: Move) -> [f64; 2] {
        match action {
            Move::Up => [0.0, -1.0],
            Move::Down => [0.0, 1.0],
            Move::Right => [1.0, 0.0],
            Move::Left => [-1.0, 0.0],
        }
    }

    fn outcome_arrow(outcome: usize) -> [f64; 2] {
        Self::action_arrow(Move::from_index(outcome))
    }

    fn intended(action: Move) -> Option<usize> {
        Some(action.index())
    }

    fn executed(outcome: usize) -> Option<Move> {
        Some(Move::from_index(outcome))
    }

    fn finite(&self) -> Option<&dyn FiniteModel> {
        Some(self)
    }

    fn finite_mut(&mut self) -> Option<&mut dyn FiniteModel> {
        Some(self)
    }

    fn apply(&mut self, actions: &[Move], outcomes: &[usize], steps: &mut [Step]) {
        assert_eq!(actions.len(), self.episodes.len(), "one action per slot");
        assert_eq!(outcomes.len(), self.episodes.len(), "one outcome per slot");
        assert_eq!(steps.len(), self.episodes.len(), "one step per slot");
        for (slot, (&outcome, step)) in outcomes.iter().zip(steps).enumerate() {
            let mut episode = self.episodes[slot];
            if episode.ended {
                *step = Step::IDLE;
                continue;
            }
            (episode.cell, *step) = self.successor(episode.cell, Move::from_index(outcome));
            episode.time += 1;
            if step.end.is_none() && episode.time == self.config.horizon {
                step.end = Some(End::Timeout);
            }
            episode.ended = step.end.is_some();
            self.episodes[slot] = episode;
        }
    }
}

/// States are cells, actions and outcomes are moves.
impl FiniteModel for LavaGrid {
    fn states(&self) -> usize {
        self.cells()
    }

    fn start(&self) -> usize {
        self.map.start()
    }

    fn actions(&self) -> usize {
        MOVES
    }

    fn outcomes(&self) -> usize {
        MOVES
    }

    fn ended(&self, cell: usize) -> Option<End> {
        match self.map.tile(cell) {
            Tile::Goal | Tile::LesserGoal => Some(End::Goal),
            Tile::Lava => Some(End::Lava),
            Tile::Free | Tile::Wall => None,
        }
    }

    fn probabilities(&self, _cell: usize, chosen: usize) -> Vec<f64> {
        self.law_of(Move::from_index(chosen)).probabilities.to_vec()
    }

    fn successor(&self, cell: usize, _chosen: usize, executed: usize) -> (usize, Step) {
        self.successor(cell, Move::from_index(executed))
    }

    fn intended_outcome(&self, action: usize) -> Option<usize> {
        Some(action)
    }

    fn action_name(&self, action: usize) -> &'static str {
        Move::from_index(action).name()
    }

    fn arrow(&self, action: usize) -> [f64; 2] {
        LavaGrid::action_arrow(Move::from_index(action))
    }

    fn coordinates(&self, cell: usize) -> [usize; 2] {
        let (x, y) = self.map.coordinates(cell);
        [x, y]
    }

    fn state(&self, slot: usize) -> usize {
        self.episodes[slot].cell
    }

    fn is_over(&self, slot: usize) -> bool {
        self.episodes[slot].ended
    }

    fn place(&mut self, slot: usize, cell: usize, time: u32) {
        assert!(cell < self.cells(), "cell {cell} of a map with {}", self.cells());
        self.episodes[slot] = Episode { cell, time, ended: false };
    }
}
