//! Constants of `lava-point`, in metres, seconds and kilograms.

use super::LavaPoint;
use crate::error::{ConfigError, require, require_rewards};
use crate::world::World;
use serde::{Deserialize, Serialize};

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

# Reward on touching lava, which ends the episode.
# Range: [-1000000, 1000000]
lava_reward = -1.0

# Time limit T in control steps. A true end of the episode, as on the grid.
# Range: [1, 1000000]
horizon = 40

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
    /// Reward on touching lava.
    pub lava_reward: f64,
    /// Time limit T in control steps.
    pub horizon: u32,
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
        for (field, rectangle) in [("lava", self.lava), ("goal", self.goal)] {
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
        if distance(self.start, self.lava) <= radius || distance(self.start, self.goal) == 0.0 {
            let allowed =
                "the disc must touch neither the lava nor, with its centre, the goal region";
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
        require_rewards(self.step_cost, self.goal_reward, self.lava_reward, self.horizon)
    }

    /// Whether the disc can come to the goal region and touch no lava. The lava is convex: where it does not
    /// reach from wall to wall, there is a way around it.
    fn goal_can_be_reached(&self) -> bool {
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

/// Distance from a point to a rectangle, 0 inside.
fn distance(point: [f64; 2], rectangle: Rectangle) -> f64 {
    let outside = |axis: usize| {
        (rectangle.min[axis] - point[axis]).max(point[axis] - rectangle.max[axis]).max(0.0)
    };
    outside(0).hypot(outside(1))
}
