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

use crate::error::{ConfigError, NoSuchState, require};
use crate::law::{FiniteLaw, MOVES};
use crate::map::{Map, Tile};
use crate::world::{End, Step, World};
use serde::{Deserialize, Serialize};

/// The map of the paper's experiment: 10 x 7 cells, lava in columns 2..=7 of the two upper rows.
pub const PAPER_MAP: &str = "\
S.LLLLLL.G
..LLLLLL..
..........
..........
..........
..........
..........
";

/// Constants of `lava-grid`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GridConfig {
    /// The map as a picture, see [`crate::map`]; default [`PAPER_MAP`]; at most
    /// [`crate::map::MAX_CELLS`] cells.
    pub map: String,
    /// Probability p that another than the chosen move is executed; default 0.05; in [0, 1].
    pub slip: f64,
    /// What a step costs that does not end in goal or lava, subtracted from the return; default
    /// 0.035; at least 0.
    pub step_cost: f64,
    /// Reward on entering a goal; default 1; any finite number.
    pub goal_reward: f64,
    /// Reward on entering lava; default -1; any finite number.
    pub lava_reward: f64,
    /// Time limit T in steps; default 40; at least 1.
    pub horizon: u32,
}

impl Default for GridConfig {
    fn default() -> Self {
        GridConfig {
            map: PAPER_MAP.to_owned(),
            slip: 0.05,
            step_cost: 0.035,
            goal_reward: 1.0,
            lava_reward: -1.0,
            horizon: 40,
        }
    }
}

impl GridConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Names the first field that is out of range, its value and the range, or the place in the map.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.parse().map(|_| ())
    }

    fn parse(&self) -> Result<Map, ConfigError> {
        require("slip", self.slip, |p| (0.0..=1.0).contains(&p), "a probability in [0, 1]")?;
        require("step_cost", self.step_cost, |cost| cost >= 0.0, "at least 0 (it is subtracted)")?;
        require("goal_reward", self.goal_reward, |_| true, "a finite number")?;
        require("lava_reward", self.lava_reward, |_| true, "a finite number")?;
        if self.horizon == 0 {
            return Err(ConfigError::value("horizon", self.horizon, "at least 1 step"));
        }
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

    /// Position in [`Move::ALL`], which is also the outcome in a [`FiniteLaw`].
    pub fn index(self) -> usize {
        self as usize
    }

    /// The move in a word, as in files.
    pub fn name(self) -> &'static str {
        ["up", "down", "right", "left"][self.index()]
    }

    /// The move of an index.
    ///
    /// # Panics
    /// If the index is not below [`MOVES`].
    pub fn from_index(index: usize) -> Move {
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
    /// Distance to the nearest lava per cell, in moves.
    clearance: Vec<f64>,
    episodes: Vec<Episode>,
}

impl LavaGrid {
    /// A batch of `episodes` slots, all in the initial state.
    ///
    /// # Errors
    /// If a value of the configuration is out of range or its map is none.
    pub fn new(config: &GridConfig, episodes: usize) -> Result<Self, ConfigError> {
        let map = config.parse()?;
        let initial = Episode { cell: map.start(), time: 0, ended: false };
        Ok(LavaGrid {
            config: config.clone(),
            clearance: clearance(&map),
            episodes: vec![initial; episodes],
            map,
        })
    }

    /// The constants of this world.
    pub fn config(&self) -> &GridConfig {
        &self.config
    }

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
        self.map.tile(cell) == Tile::Goal
    }

    /// Whether the cell can never be entered.
    pub fn is_wall(&self, cell: usize) -> bool {
        self.map.tile(cell) == Tile::Wall
    }

    /// What executing a move in a cell leads to, leaving the time limit aside. A goal or lava cell
    /// is absorbing and pays nothing.
    pub fn successor(&self, cell: usize, executed: Move) -> (usize, Step) {
        if self.is_goal(cell) || self.is_lava(cell) {
            return (cell, Step::IDLE);
        }
        let next = self.neighbour(cell, executed);
        let step = match self.map.tile(next) {
            Tile::Goal => Step { reward: self.config.goal_reward, end: Some(End::Goal) },
            Tile::Lava => Step { reward: self.config.lava_reward, end: Some(End::Lava) },
            Tile::Free | Tile::Wall => Step { reward: -self.config.step_cost, end: None },
        };
        (next, step)
    }

    /// The nominal law of the executed move, which depends on the chosen move alone.
    pub fn law_of(&self, chosen: Move) -> FiniteLaw {
        let mut probabilities = [self.config.slip / 3.0; MOVES];
        probabilities[chosen.index()] = 1.0 - self.config.slip;
        FiniteLaw { probabilities }
    }

    /// Whether the slot's episode has ended.
    pub fn is_over(&self, slot: usize) -> bool {
        self.episodes[slot].ended
    }

    /// The cell an episode is in.
    pub fn state(&self, slot: usize) -> usize {
        self.episodes[slot].cell
    }

    /// Puts the slot's episode into `cell` after `time` steps, to look at states one by one.
    ///
    /// # Panics
    /// If there is no such cell.
    pub fn place(&mut self, slot: usize, cell: usize, time: u32) {
        assert!(cell < self.cells(), "cell {cell} of a map with {}", self.cells());
        self.episodes[slot] = Episode { cell, time, ended: false };
    }

    fn neighbour(&self, cell: usize, executed: Move) -> usize {
        let (x, y) = self.map.coordinates(cell);
        let next = match executed {
            Move::Up if y > 0 => cell - self.map.width(),
            Move::Down if y + 1 < self.map.height() => cell + self.map.width(),
            Move::Right if x + 1 < self.map.width() => cell + 1,
            Move::Left if x > 0 => cell - 1,
            _ => cell,
        };
        if self.map.tile(next) == Tile::Wall { cell } else { next }
    }

    fn scaled_position(&self, slot: usize) -> [f32; 2] {
        let (x, y) = self.map.coordinates(self.episodes[slot].cell);
        [scaled(x, self.map.width()), scaled(y, self.map.height())]
    }
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
    type Action = Move;
    type Law = FiniteLaw;
    type Snapshot = Episode;

    /// (x, y), each mapped from its first to its last cell onto [-1, 1].
    const OBSERVATION: usize = 2;
    /// (x, y) likewise, then the probabilities of the four moves.
    const SITUATION: usize = 2 + MOVES;

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
        observation.copy_from_slice(&self.scaled_position(slot));
    }

    fn law(&self, _slot: usize, action: Move) -> FiniteLaw {
        self.law_of(action)
    }

    fn situation(&self, slot: usize, action: Move, situation: &mut [f32]) {
        situation[..2].copy_from_slice(&self.scaled_position(slot));
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
        let (x, y) = self.map.coordinates(self.episodes[slot].cell);
        [x as f64, y as f64]
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
