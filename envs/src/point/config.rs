//! Constants of `lava-point`, in metres, seconds and kilograms.

use crate::error::{ConfigError, require};
use serde::{Deserialize, Serialize};

/// An axis-parallel rectangle, borders included.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rectangle {
    /// The corner with the smaller coordinates, (x, y) in metres.
    pub min: [f64; 2],
    /// The corner with the larger coordinates, (x, y) in metres.
    pub max: [f64; 2],
}

/// Constants of `lava-point`. Everything must fit in the arena [0, width] x [0, height].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PointConfig {
    /// Width and height of the arena in m; default (10, 7); each in (0, 1000].
    pub arena: [f64; 2],
    /// The lava in m; default [2, 8] x [0, 2]; inside the arena.
    pub lava: Rectangle,
    /// The goal region in m, reached when the disc's centre is in it; default [9, 10] x [0, 1];
    /// inside the arena.
    pub goal: Rectangle,
    /// Where the disc's centre starts, at rest, in m; default (0.5, 0.5); the disc must lie in the
    /// arena and touch neither lava nor goal region.
    pub start: [f64; 2],
    /// Radius of the disc in m; default 0.1; above 0 and below half of the arena's shorter side.
    pub radius: f64,
    /// Mass m of the disc in kg; default 1; in [0.001, 1000]. The pushes are impulses m A u and
    /// m sigma xi and the walls are fixed, so it cancels from the motion.
    pub mass: f64,
    /// Change of velocity A by a push of length 1, in m/s per control step; default 2.5; at least 0.
    pub acceleration: f64,
    /// Standard deviation sigma of the noise per component, in m/s per control step; default 1.5;
    /// at least 0.
    pub noise: f64,
    /// Length tau of a control step in s; default 0.2; in (0, 10].
    pub control_step: f64,
    /// Number n of physics substeps of a control step; default 4; in 1..=1000.
    pub substeps: u32,
    /// Share of the velocity that damping leaves after a control step; default 0.5; in (0, 1].
    pub velocity_retention: f64,
    /// What a step costs that does not end in goal or lava, subtracted from the return; default
    /// 0.035; at least 0.
    pub step_cost: f64,
    /// Reward on reaching the goal; default 1; any finite number.
    pub goal_reward: f64,
    /// Reward on touching lava; default -1; any finite number.
    pub lava_reward: f64,
    /// Time limit T in control steps; default 40; at least 1.
    pub horizon: u32,
}

impl Default for PointConfig {
    fn default() -> Self {
        PointConfig {
            arena: [10.0, 7.0],
            lava: Rectangle { min: [2.0, 0.0], max: [8.0, 2.0] },
            goal: Rectangle { min: [9.0, 0.0], max: [10.0, 1.0] },
            start: [0.5, 0.5],
            radius: 0.1,
            mass: 1.0,
            acceleration: 2.5,
            noise: 1.5,
            control_step: 0.2,
            substeps: 4,
            velocity_retention: 0.5,
            step_cost: 0.035,
            goal_reward: 1.0,
            lava_reward: -1.0,
            horizon: 40,
        }
    }
}

impl PointConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Names the first field that is out of range, its value and the range.
    pub fn validate(&self) -> Result<(), ConfigError> {
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
        let steps = |tau: f64| tau > 0.0 && tau <= 10.0;
        require("control_step", self.control_step, steps, "above 0 and at most 10 s")?;
        if !(1..=1000).contains(&self.substeps) {
            return Err(ConfigError::value("substeps", self.substeps, "from 1 to 1000"));
        }
        let retention = |share: f64| (1e-3..=1.0).contains(&share);
        require("velocity_retention", self.velocity_retention, retention, "in [0.001, 1]")?;
        require("step_cost", self.step_cost, |cost| cost >= 0.0, "at least 0 (it is subtracted)")?;
        require("goal_reward", self.goal_reward, |_| true, "a finite number")?;
        require("lava_reward", self.lava_reward, |_| true, "a finite number")?;
        if self.horizon == 0 {
            return Err(ConfigError::value("horizon", self.horizon, "at least 1 step"));
        }
        Ok(())
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
