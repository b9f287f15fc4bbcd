//! How to add a world, in one file: a windy corridor between two bands of lava.
//!
//! ```text
//! cargo run --release --example windy_corridor -- exact --env windy-corridor --eta 25
//! cargo run --release --example windy_corridor -- train --env windy-corridor --eta 25 --seed 1
//! ```
//!
//! # The world
//! A walker starts at the left end of a corridor and wants to reach its right end. It steps ahead, up
//! or down. Now and then a gust of wind blows it two cells up or down besides. In the middle of the
//! corridor both walls are lava, and the start lies near the upper one: the shortest way runs near the
//! lava, the safe way in the middle.
//!
//! # What a world consists of
//! 1. **Constants** ([`Constants`]): what a configuration may change, with serde. Their documentation,
//!    defaults and ranges stand in one annotated TOML text, [`DEFAULTS`]; `World::defaults()` reads it.
//! 2. **An action** ([`Walk`]): implement [`Action`], and [`Discrete`] if there are finitely many. The
//!    kind of the action decides which policies fit.
//! 3. **A law of chance**: here [`FiniteLaw<3>`], one outcome for each wind. Chance is explicit: `law`
//!    says what may happen after an action, `apply` carries out what did happen. An antagonist
//!    reweights the outcomes in between.
//! 4. **A snapshot** ([`Walker`]): all that the next steps of an episode depend on.
//! 5. **[`World`]** for the batch of episodes ([`WindyCorridor`]). Slots must not influence each other.
//! 6. **[`FiniteModel`]**, if states, actions and outcomes are finitely many: the same dynamics by
//!    indices. With it every exact yardstick is there at once.
//! 7. **[`Solvable`]**: empty for a finite world. Another world may bring a yardstick of its own.
//!
//! Then let [`conformance::check`](lava_envs::conformance::check) look at it: it checks every promise of
//! these traits and says which one is broken. `tests/windy_corridor.rs` does that, and trains in it.

use cvar_game::exact::yardstick::Solvable;
use cvar_game::experiment::registry::Registry;
use cvar_game::learn::methods::{Game, Uniform};
use lava_envs::action::{Finite, uniform_index};
use lava_envs::error::require;
use lava_envs::{
    Action, Area, AreaKind, ConfigError, Discrete, End, Field, FiniteLaw, FiniteModel, NoSuchState,
    Scene, Step, World,
};
use rand::Rng;
use serde::{Deserialize, Serialize};

/// The constants, with what they mean, their defaults and their ranges: comments first, then the range,
/// then the key.
const DEFAULTS: &str = r#"# windy-corridor: a walk between two bands of lava. Lengths are in cells.

# Length of the corridor. Its first and its last two columns have no lava.
# Range: [5, 1000]
length = 12

# Rows of the corridor, the two with lava included.
# Range: [3, 1000]
width = 7

# Probability of a gust up in a step, and of a gust down.
# Range: [0, 0.5]
wind = 0.002

# What a step costs that ends in neither goal nor lava: it is subtracted.
# Range: [0, inf)
step_cost = 0.035

# Time limit T in steps. A true end of the episode: nothing is bootstrapped.
# Range: [1, 4294967295]
horizon = 40
"#;

/// Columns at each end without lava.
const SAFE_COLUMNS: usize = 2;

/// Constants of the corridor, as [`DEFAULTS`] explains them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Constants {
    length: usize,
    width: usize,
    wind: f64,
    step_cost: f64,
    horizon: u32,
}

/// What the walker chooses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Walk {
    /// x + 1
    Ahead,
    /// y - 1
    Up,
    /// y + 1
    Down,
}

impl Walk {
    const ALL: [Walk; 3] = [Walk::Ahead, Walk::Up, Walk::Down];

    fn name(self) -> &'static str {
        ["ahead", "up", "down"][self.index()]
    }
}

impl Action for Walk {
    type Kind = Finite<3>;

    fn uniform(random: &mut impl Rng) -> Walk {
        uniform_index(random)
    }
}

impl Discrete for Walk {
    const COUNT: usize = 3;

    fn index(self) -> usize {
        self as usize
    }

    fn from_index(index: usize) -> Walk {
        Walk::ALL[index]
    }
}

/// Winds, the outcomes of chance, by their index: how many cells they blow downward.
const WINDS: [isize; 3] = [0, -2, 2];

/// State of an episode. Cells are numbered row by row.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Walker {
    cell: usize,
    time: u32,
    ended: bool,
}

/// A batch of walks along the corridor.
#[derive(Debug)]
pub struct WindyCorridor {
    constants: Constants,
    walkers: Vec<Walker>,
}

impl WindyCorridor {
    /// Column and row.
    fn place_of(&self, cell: usize) -> [usize; 2] {
        [cell % self.constants.length, cell / self.constants.length]
    }

    fn start(&self) -> Walker {
        Walker { cell: self.constants.length, time: 0, ended: false } // the second row
    }

    /// What a cell is, if entering it ends the episode.
    fn end_at(&self, cell: usize) -> Option<End> {
        let Constants { length, width, .. } = self.constants;
        let [x, y] = self.place_of(cell);
        if (y == 0 || y + 1 == width) && (SAFE_COLUMNS..length - SAFE_COLUMNS).contains(&x) {
            Some(End::Lava)
        } else if x + 1 == length {
            Some(End::Goal)
        } else {
            None
        }
    }

    /// One step, leaving the time limit aside. A step into a wall stays where it is.
    fn step(&self, cell: usize, walk: Walk, wind: usize) -> (usize, Step) {
        if self.end_at(cell).is_some() {
            return (cell, Step::IDLE);
        }
        let [x, y] = self.place_of(cell);
        let (ahead, down) = match walk {
            Walk::Ahead => (1, 0),
            Walk::Up => (0, -1),
            Walk::Down => (0, 1),
        };
        let row = y.saturating_add_signed(down + WINDS[wind]).min(self.constants.width - 1);
        let next = row * self.constants.length + x + ahead;
        let end = self.end_at(next);
        let reward = match end {
            Some(End::Goal) => 1.0,
            Some(_) => -1.0,
            None => -self.constants.step_cost,
        };
        (next, Step { reward, end })
    }

    fn law_of_wind(&self) -> FiniteLaw<3> {
        let wind = self.constants.wind;
        FiniteLaw { probabilities: [1.0 - 2.0 * wind, wind, wind] }
    }

    fn scaled(&self, slot: usize) -> [f32; 2] {
        let [x, y] = self.place_of(self.walkers[slot].cell);
        let scaled = |of: usize, cells: usize| 2.0 * of as f32 / (cells - 1) as f32 - 1.0;
        [scaled(x, self.constants.length), scaled(y, self.constants.width)]
    }
}

impl World for WindyCorridor {
    type Constants = Constants;
    type Action = Walk;
    type Law = FiniteLaw<3>;
    type Snapshot = Walker;

    const NAME: &'static str = "windy-corridor";
    const DEFAULTS: &'static str = DEFAULTS;
    /// Column and row, each mapped onto [-1, 1].
    const OBSERVATION: usize = 2;
    /// The same, the chosen walk as an arrow, and the probabilities of the winds.
    const SITUATION: usize = 7;

    fn validate(constants: &Constants) -> Result<(), ConfigError> {
        for (field, cells, least) in
            [("length", constants.length, 5), ("width", constants.width, 3)]
        {
            if !(least..=1000).contains(&cells) {
                return Err(ConfigError::value(field, cells, format!("in [{least}, 1000]")));
            }
        }
        require("wind", constants.wind, |p| (0.0..=0.5).contains(&p), "in [0, 0.5]")?;
        require("step_cost", constants.step_cost, |cost| cost >= 0.0, "at least 0")?;
        if constants.horizon == 0 {
            return Err(ConfigError::value("horizon", 0, "at least 1 step"));
        }
        Ok(())
    }

    fn new(constants: &Constants, episodes: usize) -> Result<Self, ConfigError> {
        Self::validate(constants)?;
        let mut world = WindyCorridor { constants: constants.clone(), walkers: Vec::new() };
        world.walkers = vec![world.start(); episodes];
        Ok(world)
    }

    fn constants(&self) -> &Constants {
        &self.constants
    }

    fn episodes(&self) -> usize {
        self.walkers.len()
    }

    fn horizon(&self) -> u32 {
        self.constants.horizon
    }

    fn reset(&mut self, slot: usize) {
        self.walkers[slot] = self.start();
    }

    fn snapshot(&self, slot: usize) -> Walker {
        self.walkers[slot]
    }

    fn restore(&mut self, slot: usize, walker: Walker) -> Result<(), NoSuchState> {
        let cells = self.constants.length * self.constants.width;
        // A running episode has time left.
        let last = self.constants.horizon - u32::from(!walker.ended);
        if walker.cell >= cells || walker.time > last {
            return Err(NoSuchState::of(&walker));
        }
        self.walkers[slot] = walker;
        Ok(())
    }

    fn time(&self, slot: usize) -> u32 {
        self.walkers[slot].time
    }

    fn observe(&self, slot: usize, observation: &mut [f32]) {
        observation.copy_from_slice(&self.scaled(slot));
    }

    fn law(&self, _slot: usize, _action: Walk) -> FiniteLaw<3> {
        self.law_of_wind()
    }

    fn situation(&self, slot: usize, action: Walk, situation: &mut [f32]) {
        let arrow = <Self as World>::action_arrow(action).map(|of| of as f32);
        let law = self.law_of_wind().probabilities.map(|p| p as f32);
        situation[..2].copy_from_slice(&self.scaled(slot));
        situation[2..4].copy_from_slice(&arrow);
        situation[4..].copy_from_slice(&law);
    }

    /// In cells, along the column; infinite where a column has no lava.
    fn clearance(&self, slot: usize) -> f64 {
        let Constants { length, width, .. } = self.constants;
        let [x, y] = self.place_of(self.walkers[slot].cell);
        let beside_lava = (SAFE_COLUMNS..length - SAFE_COLUMNS).contains(&x);
        if beside_lava { y.min(width - 1 - y) as f64 } else { f64::INFINITY }
    }

    fn position(&self, slot: usize) -> [f64; 2] {
        self.place_of(self.walkers[slot].cell).map(|of| of as f64)
    }

    fn scene(&self) -> Scene {
        let Constants { length, width, wind, step_cost, horizon } = self.constants;
        let [columns, rows] = [length, width].map(|of| of as f64);
        let safe = SAFE_COLUMNS as f64;
        let area = |kind, min, max| Area { kind, min, max };
        Scene {
            size: [columns, rows],
            cells: true,
            start: self.place_of(self.start().cell).map(|of| of as f64),
            areas: vec![
                area(AreaKind::Lava, [safe, 0.0], [columns - safe, 1.0]),
                area(AreaKind::Lava, [safe, rows - 1.0], [columns - safe, rows]),
                area(AreaKind::Goal, [columns - 1.0, 0.0], [columns, rows]),
            ],
            rules: format!(
                "A step costs {step_cost}, lava pays -1 and the goal 1, both of which end the episode; so \
                 does step {horizon}. With probability {wind} each, a gust of wind blows two cells up or down."
            ),
        }
    }

    fn headline(&self) -> String {
        format!("wind {}, step cost {}", self.constants.wind, self.constants.step_cost)
    }

    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)> {
        let [x, y] = self.position(slot);
        vec![("x", Field::Number(x)), ("y", Field::Number(y))]
    }

    fn action_columns(action: Walk) -> Vec<(&'static str, Field)> {
        vec![("action", Field::Word(action.name()))]
    }

    fn outcome_columns(wind: usize) -> Vec<(&'static str, Field)> {
        vec![("wind", Field::Word(["none", "up", "down"][wind]))]
    }

    fn action_arrow(action: Walk) -> [f64; 2] {
        match action {
            Walk::Ahead => [1.0, 0.0],
            Walk::Up => [0.0, -1.0],
            Walk::Down => [0.0, 1.0],
        }
    }

    fn outcome_arrow(wind: usize) -> [f64; 2] {
        [0.0, WINDS[wind] as f64]
    }

    /// Without wind the walk is carried out as it was chosen.
    fn intended(_action: Walk) -> Option<usize> {
        Some(0)
    }

    fn finite(&self) -> Option<&dyn FiniteModel> {
        Some(self)
    }

    fn finite_mut(&mut self) -> Option<&mut dyn FiniteModel> {
        Some(self)
    }

    fn apply(&mut self, actions: &[Walk], winds: &[usize], steps: &mut [Step]) {
        for (slot, step) in steps.iter_mut().enumerate() {
            let mut walker = self.walkers[slot];
            if walker.ended {
                *step = Step::IDLE;
                continue;
            }
            (walker.cell, *step) = self.step(walker.cell, actions[slot], winds[slot]);
            walker.time += 1;
            if step.end.is_none() && walker.time == self.constants.horizon {
                step.end = Some(End::Timeout);
            }
            walker.ended = step.end.is_some();
            self.walkers[slot] = walker;
        }
    }
}

/// States are cells, actions are walks, outcomes are winds.
impl FiniteModel for WindyCorridor {
    fn states(&self) -> usize {
        self.constants.length * self.constants.width
    }

    fn start(&self) -> usize {
        self.start().cell
    }

    fn actions(&self) -> usize {
        Walk::COUNT
    }

    fn outcomes(&self) -> usize {
        WINDS.len()
    }

    fn ended(&self, cell: usize) -> Option<End> {
        self.end_at(cell)
    }

    fn probabilities(&self, _cell: usize, _walk: usize) -> Vec<f64> {
        self.law_of_wind().probabilities.into()
    }

    fn successor(&self, cell: usize, walk: usize, wind: usize) -> (usize, Step) {
        self.step(cell, Walk::from_index(walk), wind)
    }

    fn intended_outcome(&self, _walk: usize) -> Option<usize> {
        Some(0)
    }

    fn action_name(&self, walk: usize) -> &'static str {
        Walk::from_index(walk).name()
    }

    fn arrow(&self, walk: usize) -> [f64; 2] {
        Self::action_arrow(Walk::from_index(walk))
    }

    fn coordinates(&self, cell: usize) -> [usize; 2] {
        self.place_of(cell)
    }

    fn state(&self, slot: usize) -> usize {
        self.walkers[slot].cell
    }

    fn is_over(&self, slot: usize) -> bool {
        self.walkers[slot].ended
    }

    fn place(&mut self, slot: usize, cell: usize, time: u32) {
        assert!(cell < self.states(), "cell {cell} of {}", self.states());
        self.walkers[slot] = Walker { cell, time, ended: false };
    }
}

/// A finite world is solved exactly: there is nothing to write.
impl Solvable for WindyCorridor {}

/// The program's worlds and methods: a line each. The macro makes the command line, the configuration,
/// training, evaluation, tables and figures know the world.
pub fn registry() -> Registry {
    cvar_game::registry! {
        worlds: WindyCorridor;
        methods: Game, Uniform
    }
}

/// The whole program, with this world.
#[cfg_attr(test, expect(dead_code, reason = "a test has a main function of its own"))]
fn main() -> std::process::ExitCode {
    cvar_game::cli::main(&registry())
}
