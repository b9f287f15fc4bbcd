//! Constants of `lava-point`, in metres, seconds and kilograms.

use super::geometry::Scene;
use super::{LavaPoint, vector};
use crate::error::{ConfigError, require, require_rewards};
use crate::map::{Map, Tile};
use crate::world::{End, World};
use serde::{Deserialize, Serialize};

/// Most rectangles of one kind.
const MOST_RECTANGLES: usize = 10_000;

/// Points across the longer side of the lattice on which ways to a goal are looked for, where the disc is small.
const WAYS_ACROSS: f64 = 500.0;

/// The constants, with what they mean, their defaults and their ranges.
pub const DEFAULTS: &str = r#"# lava-point: a disc is pushed past the same lava, in metres and seconds; x to the right, y downward.

# Width and height of the arena, in m. The grid's scene, one metre a cell.
# Range: (0, 1000]
arena = [10.0, 7.0]

# Where the disc's centre starts, at rest, in m. The disc must lie in the arena and touch neither lava
# nor goal.
start = [0.5, 0.5]

# Radius of the disc, in m, above 0 and below half of the arena's shorter side.
radius = 0.1

# Mass of the disc, in kg. The pushes are impulses, so it cancels from the motion.
# Range: [0.001, 1000]
mass = 1.0

# Change of velocity by a push of length 1, in m/s per control step. 2.5 is enough to steer
# against the noise, not enough to ignore it.
# Range: [0, 1000]
acceleration = 2.5

# Standard deviation of the noise, per component, in m/s per control step. At 1.5 the risk-neutral
# optimum passes the lava visibly closer than the CVaR-optimal controllers.
# Range: [0, 1000]
noise = 1.5

# Length of a control step, in s.
# Range: [0.001, 10]
control_step = 0.2

# Physics substeps of a control step. Impacts are looked for in each of them.
# Range: [1, 1000]
substeps = 4

# Share of the velocity that damping leaves after a control step. Halved by default.
# Range: [0.001, 1]
velocity_retention = 0.5

# What a step costs that ends in neither goal nor lava: it is subtracted. As on the grid.
# Range: [0, 1000000]
step_cost = 0.035

# Reward on reaching the goal region, which ends the episode.
# Range: [-1000000, 1000000]
goal_reward = 1.0

# Reward on reaching a lesser goal, which ends the episode too.
# Range: [-1000000, 1000000]
lesser_goal_reward = 0.5

# Reward on touching lava, which ends the episode.
# Range: [-1000000, 1000000]
lava_reward = -1.0

# Time limit T in control steps. A true end of the episode, as on the grid.
# Range: [1, 1000000]
horizon = 40

# More lava: a list of rectangles [x_min, y_min, x_max, y_max], in m.
more_lava = []

# More goal regions, likewise.
more_goals = []

# Goal regions that pay lesser_goal_reward, likewise.
lesser_goals = []

# Walls inside the arena, likewise. A disc slides along them.
walls = []

# The lava, a rectangle inside the arena.
[lava]

# Its corner with the smaller coordinates, in m.
min = [2.0, 0.0]

# Its corner with the larger coordinates, in m.
max = [8.0, 2.0]

# The goal region, a rectangle inside the arena; it is reached when the disc's centre is in it.
[goal]

# Its corner with the smaller coordinates, in m.
min = [9.0, 0.0]

# Its corner with the larger coordinates, in m.
max = [10.0, 1.0]
"#;

/// The training options in which this world differs.
pub const TRAINING: &str = r#"# A quarter of the run at budget 1 and two fifths for the rise: with the antagonist at full budget from
# the first step the protagonist learns to end the episode early. Of two seeds each after 2 million
# steps, the goal rate of the greedy policy was 0.53 and 0.00 at eta = 25 and 0.24 and 0.00 at 100
# without, and 0.99 or more in all four runs with both.
budget_wait = 0.25
# The rise after it.
budget_rise = 0.4

# The protagonist of this world.
[protagonist]

# The bonus fades: a policy that stays wide adds noise as large as nature's to what its critic and its
# antagonist see.
entropy_final = 0.0
"#;

/// An axis-parallel rectangle, borders included.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rectangle {
    /// The corner with the smaller coordinates, (x, y) in metres.
    pub min: [f64; 2],
    /// The corner with the larger coordinates, (x, y) in metres.
    pub max: [f64; 2],
}

/// Constants of `lava-point`; [`DEFAULTS`] explains them and has their defaults and ranges.
/// Everything must fit in the arena [0, width] x [0, height].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointConfig {
    /// Width and height of the arena in m.
    pub arena: [f64; 2],
    /// The lava in m.
    pub lava: Rectangle,
    /// The goal region in m; it is reached when the disc's centre is in it.
    pub goal: Rectangle,
    /// Where the disc's centre starts, at rest, in m.
    pub start: [f64; 2],
    /// Radius of the disc in m.
    pub radius: f64,
    /// Mass m of the disc in kg. The pushes are impulses m A u and m sigma xi and the walls are
    /// fixed, so it cancels from the motion.
    pub mass: f64,
    /// Change of velocity A by a push of length 1, in m/s per control step.
    pub acceleration: f64,
    /// Standard deviation sigma of the noise per component, in m/s per control step.
    pub noise: f64,
    /// Length tau of a control step in s.
    pub control_step: f64,
    /// Number n of physics substeps of a control step.
    pub substeps: u32,
    /// Share of the velocity that damping leaves after a control step.
    pub velocity_retention: f64,
    /// Cost of a step that ends in neither goal nor lava: it is subtracted from the return.
    pub step_cost: f64,
    /// Reward on reaching the goal.
    pub goal_reward: f64,
    /// Reward on reaching a lesser goal. The default is not written, so that certificates of worlds without lesser
    /// goals do not depend on it.
    #[serde(default = "lesser_goal_reward", skip_serializing_if = "is_the_default")]
    pub lesser_goal_reward: f64,
    /// Reward on touching lava.
    pub lava_reward: f64,
    /// Time limit T in control steps.
    pub horizon: u32,
    /// More lava, as [x_min, y_min, x_max, y_max] in m.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub more_lava: Vec<Corners>,
    /// More goal regions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub more_goals: Vec<Corners>,
    /// Goal regions that pay [`PointConfig::lesser_goal_reward`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lesser_goals: Vec<Corners>,
    /// Walls inside the arena.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub walls: Vec<Corners>,
}

/// A rectangle as [x_min, y_min, x_max, y_max] in m.
pub type Corners = [f64; 4];

impl From<Corners> for Rectangle {
    fn from([left, top, right, bottom]: Corners) -> Rectangle {
        Rectangle { min: [left, top], max: [right, bottom] }
    }
}

/// The default of [`PointConfig::lesser_goal_reward`].
fn lesser_goal_reward() -> f64 {
    0.5
}

fn is_the_default(reward: &f64) -> bool {
    *reward == lesser_goal_reward()
}

impl Default for PointConfig {
    /// What [`DEFAULTS`] says.
    fn default() -> Self {
        LavaPoint::defaults()
    }
}

impl PointConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Names the first field that is out of range, its value and the range. A goal that cannot be reached is
    /// refused too, though [`LavaPoint`] can be made with it.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check_values()?;
        if !self.goal_can_be_reached() {
            let allowed =
                "the disc must reach it on a way from the start that does not touch the lava";
            return Err(ConfigError::value("goal", self.goal, allowed));
        }
        Ok(())
    }

    /// Checks what the world needs to work.
    pub(super) fn check_values(&self) -> Result<(), ConfigError> {
        let [width, height] = self.arena;
        for side in self.arena {
            if !(side > 0.0 && side <= 1000.0) {
                let allowed = "two lengths in (0, 1000] m";
                return Err(ConfigError::value("arena", self.arena, allowed));
            }
        }
        let listed = [
            ("more_lava", &self.more_lava),
            ("more_goals", &self.more_goals),
            ("lesser_goals", &self.lesser_goals),
            ("walls", &self.walls),
        ];
        for (field, list) in listed {
            if list.len() > MOST_RECTANGLES {
                let allowed = format!("at most {MOST_RECTANGLES} rectangles");
                return Err(ConfigError::value(field, list.len(), &*allowed));
            }
        }
        let listed = listed
            .into_iter()
            .flat_map(|(field, list)| list.iter().map(move |&of| (field, of.into())));
        for (field, rectangle) in
            [("lava", self.lava), ("goal", self.goal)].into_iter().chain(listed)
        {
            let fits = (0..2).all(|axis| {
                let (min, max) = (rectangle.min[axis], rectangle.max[axis]);
                0.0 <= min && min < max && max <= self.arena[axis]
            });
            if !fits {
                let allowed = format!(
                    "min < max in both axes, inside the arena [0, {width}] x [0, {height}]"
                );
                return Err(ConfigError::value(field, rectangle, allowed));
            }
        }
        let radius = self.radius;
        let largest = width.min(height) / 2.0;
        require(
            "radius",
            radius,
            |radius| radius > 0.0 && radius < largest,
            &format!("above 0 and below {largest} m, half of the arena's shorter side"),
        )?;
        let in_arena = (0..2).all(|axis| {
            radius <= self.start[axis] && self.start[axis] <= self.arena[axis] - radius
        });
        if !in_arena {
            let allowed = format!("the disc of radius {radius} m must lie in the arena");
            return Err(ConfigError::value("start", self.start, allowed));
        }
        let touches = |area: Rectangle| distance(self.start, area) <= radius;
        if self.lava().chain(self.walls()).any(touches)
            || self.goals().any(|(goal, _)| distance(self.start, goal) == 0.0)
        {
            let allowed =
                "the disc must touch neither lava nor walls nor, with its centre, a goal region";
            return Err(ConfigError::value("start", self.start, allowed));
        }
        require("mass", self.mass, |m| (1e-3..=1e3).contains(&m), "in [0.001, 1000] kg")?;
        require(
            "acceleration",
            self.acceleration,
            |a| (0.0..=1e3).contains(&a),
            "in [0, 1000] m/s",
        )?;
        require("noise", self.noise, |sigma| (0.0..=1e3).contains(&sigma), "in [0, 1000] m/s")?;
        let steps = |tau: f64| (1e-3..=10.0).contains(&tau);
        require("control_step", self.control_step, steps, "in [0.001, 10] s")?;
        if !(1..=1000).contains(&self.substeps) {
            return Err(ConfigError::value("substeps", self.substeps, "from 1 to 1000"));
        }
        let retention = |share: f64| (1e-3..=1.0).contains(&share);
        require("velocity_retention", self.velocity_retention, retention, "in [0.001, 1]")?;
        let rewards = [self.goal_reward, self.lesser_goal_reward, self.lava_reward];
        require_rewards(self.step_cost, rewards, self.horizon)
    }

    /// All lava.
    pub fn lava(&self) -> impl Iterator<Item = Rectangle> + '_ {
        std::iter::once(self.lava).chain(self.more_lava.iter().map(|&of| of.into()))
    }

    /// All goal regions, each with its reward.
    pub fn goals(&self) -> impl Iterator<Item = (Rectangle, f64)> + '_ {
        let goals = std::iter::once(self.goal).chain(self.more_goals.iter().map(|&of| of.into()));
        let lesser = self.lesser_goals.iter().map(|&of| (of.into(), self.lesser_goal_reward));
        goals.map(|goal| (goal, self.goal_reward)).chain(lesser)
    }

    /// All walls inside the arena.
    pub fn walls(&self) -> impl Iterator<Item = Rectangle> + '_ {
        self.walls.iter().map(|&of| of.into())
    }

    /// Whether the disc can come to a goal region and touch no lava.
    fn goal_can_be_reached(&self) -> bool {
        let one_of_each = [&self.more_lava, &self.more_goals, &self.lesser_goals, &self.walls]
            .iter()
            .all(|list| list.is_empty());
        if one_of_each { self.goal_is_beside_lava() } else { self.a_goal_is_connected() }
    }

    /// Whether steps between the points of a lattice lead to a goal, past lava and walls. A way that is narrower than
    /// the lattice may be missed.
    fn a_goal_is_connected(&self) -> bool {
        let scene = Scene::new(self);
        let room = self.arena.map(|side| side - 2.0 * self.radius);
        // About the radius, and a whole part of a metre: the middles of a map's cells are on the lattice.
        let spacing = 1.0 / (1.0 / self.radius).ceil();
        let spacing = spacing.max(room[0].max(room[1]) / WAYS_ACROSS);
        let counts = room.map(|side| (side / spacing).ceil() as usize);
        // The lattice goes through the start, so that a start in a narrow place is on it.
        let at = |[x, y]: [usize; 2]| {
            let along = |axis: usize, index: usize| {
                let first = (self.start[axis] - self.radius) % spacing;
                (self.radius + first + index as f64 * spacing).min(self.arena[axis] - self.radius)
            };
            vector([along(0, x), along(1, y)])
        };
        let index = |axis: usize| ((self.start[axis] - self.radius) / spacing) as usize;
        let begin = [index(0), index(1)];
        let mut seen = vec![false; (counts[0] + 1) * (counts[1] + 1)];
        let mut waiting = vec![begin];
        seen[begin[0] * (counts[1] + 1) + begin[1]] = true;
        while let Some([x, y]) = waiting.pop() {
            let near = [[x.wrapping_sub(1), y], [x + 1, y], [x, y.wrapping_sub(1)], [x, y + 1]];
            for next in near {
                if next[0] > counts[0] || next[1] > counts[1] {
                    continue;
                }
                let (from, to) = (at([x, y]), at(next));
                match scene.impact(from, to) {
                    Some((_, End::Goal, _)) if !scene.is_blocked(from, to) => return true,
                    None if !scene.is_blocked(from, to) => {
                        let place = &mut seen[next[0] * (counts[1] + 1) + next[1]];
                        if !std::mem::replace(place, true) {
                            waiting.push(next);
                        }
                    }
                    _ => {}
                }
            }
        }
        false
    }

    /// The same where there is one rectangle of lava and one of goal. The lava is convex: where it does not
    /// reach from wall to wall, there is a way around it.
    fn goal_is_beside_lava(&self) -> bool {
        let PointConfig { arena, lava, goal, start, radius, .. } = self;
        // The farthest points from the lava are corners of what the centre can reach of the goal.
        let side = |axis: usize| {
            let (least, most) = (*radius, arena[axis] - radius);
            [goal.min[axis].max(least), goal.max[axis].min(most)]
        };
        let [[left, right], [top, bottom]] = [side(0), side(1)];
        if left > right || top > bottom {
            return false;
        }
        let narrow = |gap: f64| gap <= 2.0 * radius;
        let wall_to_wall =
            |axis: usize| narrow(lava.min[axis]) && narrow(arena[axis] - lava.max[axis]);
        let beyond = |point: [f64; 2], axis: usize| point[axis] > lava.max[axis];
        [[left, top], [right, top], [left, bottom], [right, bottom]].into_iter().any(|corner| {
            distance(corner, *lava) > *radius
                && (0..2).all(|axis| {
                    !wall_to_wall(1 - axis) || beyond(corner, axis) == beyond(*start, axis)
                })
        })
    }

    /// Length tau / n of a physics substep in s.
    pub fn substep(&self) -> f64 {
        self.control_step / f64::from(self.substeps)
    }
}

/// See [`World::of_map`].
pub(super) fn of_map(map: &Map) -> Result<toml::Table, String> {
    let metres = |tile| -> Vec<Corners> {
        map.rectangles(tile).into_iter().map(|of| of.map(|cells| cells as f64)).collect()
    };
    let (lava, goals) = (metres(Tile::Lava), metres(Tile::Goal));
    let first = |of: &[Corners], missing: &str| {
        let [left, top, right, bottom] = *of.first().ok_or(missing)?;
        let corners = [
            ("min".to_owned(), vec![left, top].into()),
            ("max".to_owned(), vec![right, bottom].into()),
        ];
        Ok::<_, String>(toml::Value::Table(corners.into_iter().collect()))
    };
    let list = |of: &[Corners]| -> toml::Value {
        of.iter().map(|corners| corners.to_vec()).collect::<Vec<_>>().into()
    };
    let (x, y) = map.coordinates(map.start());
    let constants = [
        ("arena", vec![map.width() as f64, map.height() as f64].into()),
        ("start", vec![x as f64 + 0.5, y as f64 + 0.5].into()),
        ("lava", first(&lava, "the map has no lava `L`")?),
        ("goal", first(&goals, "the map has no goal `G`")?),
        ("more_lava", list(&lava[1..])),
        ("more_goals", list(&goals[1..])),
        ("lesser_goals", list(&metres(Tile::LesserGoal))),
        ("walls", list(&metres(Tile::Wall))),
    ];
    Ok(constants.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
}

/// Distance from a point to a rectangle, 0 inside.
fn distance(point: [f64; 2], rectangle: Rectangle) -> f64 {
    let outside = |axis: usize| {
        (rectangle.min[axis] - point[axis]).max(point[axis] - rectangle.max[axis]).max(0.0)
    };
    outside(0).hypot(outside(1))
}
