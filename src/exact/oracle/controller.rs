//! What plays: the controller of the dynamic programme, and scripted yardsticks.

use super::lattice::Space;
use super::sweep::{PLAYED, Rewards, SWEPT, Utility, actions, sweep};
use crate::exact::watch::Watch;
use crate::game::columns::{Loops, widest};
use lava_envs::PointConfig;
use lava_envs::point::Force;
use lava_envs::random::ChaCha8Rng;
use nalgebra::Vector2;
use rand::RngExt;

/// Chooses pushes from time, position and velocity.
pub trait Protagonist: Sync {
    /// The push at time t. `random` is the episode's own stream.
    fn act(
        &self,
        time: u32,
        position: [f64; 2],
        velocity: [f64; 2],
        random: &mut ChaCha8Rng,
    ) -> Force;
}

/// Greedy with respect to W of the dynamic programme: the push with the largest W(x, y, v + A u, t),
/// interpolated as in the programme.
pub struct Controller {
    space: Space,
    /// W by time, node, vbar_x, vbar_y.
    means: Vec<f32>,
    actions: Vec<Candidate>,
    value: f64,
}

/// A push and the change A u that it makes, in nodes of vbar.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    push: [f64; 2],
    change: [f64; 2],
}

impl Controller {
    /// The controller that maximises a utility on a lattice.
    pub fn new(
        space: Space,
        rewards: &Rewards,
        utility: Utility,
        threads: usize,
        watch: &dyn Watch,
    ) -> Controller {
        let swept = sweep(&space, rewards, utility, SWEPT, threads, true, watch);
        let nodes = space.config.acceleration / space.spacing;
        let actions = actions(PLAYED)
            .into_iter()
            .map(|push| Candidate { push, change: push.map(|u| u * nodes) })
            .collect();
        Controller { space, means: swept.means, actions, value: swept.value }
    }

    /// The largest expected utility from the start, by interpolation; not certified.
    pub fn value(&self) -> f64 {
        self.value
    }

    /// The lattice that it was computed on.
    pub fn space(&self) -> &Space {
        &self.space
    }
}

/// Most nodes of vbar on one axis that pushes from one velocity reach, stencils included.
const WINDOW: usize = 32;

impl Protagonist for Controller {
    fn act(&self, time: u32, position: [f64; 2], velocity: [f64; 2], _: &mut ChaCha8Rng) -> Force {
        let mut best = [0.0, 0.0];
        widest(Choose { controller: self, time, position, velocity, best: &mut best });
        Force(Vector2::from(best))
    }
}

/// What a controller chooses.
struct Choose<'a> {
    controller: &'a Controller,
    time: u32,
    position: [f64; 2],
    velocity: [f64; 2],
    /// Receives the push; 0 where nothing is known.
    best: &'a mut [f64; 2],
}

impl Loops for Choose<'_> {
    #[inline(always)]
    fn run(self) {
        let Choose { controller, time, position, velocity, best } = self;
        let space = &controller.space;
        let ny = space.axes[1].nodes;
        let count = 2 * space.halves.mean + 1;
        let [(x, fx), (y, fy)] = [0, 1].map(|axis| space.axes[axis].locate(position[axis]));

        // The velocity in nodes of vbar, and the window of nodes around it.
        let half = space.halves.mean as f64;
        let fastest = space.halves.before as f64;
        let centre = velocity.map(|v| (v / space.spacing).clamp(-fastest, fastest) + half);
        let around = (space.config.acceleration / space.spacing).ceil() as usize + 2;
        let first = centre.map(|c| (c as usize + 1).saturating_sub(around));
        let width = (2 * around).min(WINDOW);
        let width_x = width.min(count - first[0]);
        let width_y = width.min(count - first[1]);

        let mut window = [0.0_f32; WINDOW * WINDOW];
        let mut total = 0.0;
        for (node, weight) in [
            (x * ny + y, (1.0 - fx) * (1.0 - fy)),
            (x * ny + y + 1, (1.0 - fx) * fy),
            ((x + 1) * ny + y, fx * (1.0 - fy)),
            ((x + 1) * ny + y + 1, fx * fy),
        ] {
            if weight == 0.0 || space.stopped[node].is_some() {
                continue;
            }
            total += weight;
            let table = &controller.means[(time as usize * space.nodes() + node) * count * count..];
            for i in 0..width_x {
                let row = &table[(first[0] + i) * count + first[1]..][..width_y];
                for (entry, mean) in window[i * WINDOW..][..width_y].iter_mut().zip(row) {
                    *entry += weight as f32 * mean;
                }
            }
        }
        if total > 0.0 {
            let mut highest = f32::NEG_INFINITY;
            for option in &controller.actions {
                let place = [0, 1].map(|axis| centre[axis] + option.change[axis]);
                let below = place.map(f64::floor);
                let at = [0, 1].map(|axis| below[axis] as usize - 1 - first[axis]);
                let wx = space.weights(place[0] - below[0]);
                let wy = space.weights(place[1] - below[1]);
                let mut mean = 0.0;
                for (p, across) in wx.iter().enumerate() {
                    let row = &window[(at[0] + p) * WINDOW + at[1]..][..4];
                    let along: f32 = row.iter().zip(&wy).map(|(m, w)| m * w).sum();
                    mean += across * along;
                }
                if mean > highest {
                    highest = mean;
                    *best = option.push;
                }
            }
        }
    }
}

/// Protagonists that need no computation, as yardsticks of what is easy.
#[derive(Debug, Clone, PartialEq)]
pub enum Scripted {
    /// Never pushes.
    StandStill,
    /// Pushes uniformly drawn from the unit disc.
    Random,
    /// Pushes so as to fly to the centre of the goal at full drift, lava or not.
    Straight(PointConfig),
    /// Goes around the lava's lower edge with this clearance in m between the surfaces: down beside
    /// the lava, along the lane, and up to the goal.
    Clearance(PointConfig, f64),
}

impl Scripted {
    /// The yardsticks of a world; clearances are multiples of half a metre that fit in the arena, where there is one
    /// rectangle of lava to go around.
    pub fn all(config: &PointConfig) -> Vec<Scripted> {
        let mut all =
            vec![Scripted::StandStill, Scripted::Random, Scripted::Straight(config.clone())];
        let free = config.arena[1] - config.lava.max[1] - 2.0 * config.radius;
        let alone = config.more_lava.is_empty();
        let clearances = (1..=8).map(|k| 0.5 * f64::from(k)).filter(|&c| alone && c <= free);
        all.extend(clearances.map(|c| Scripted::Clearance(config.clone(), c)));
        all
    }

    /// Name in tables.
    pub fn name(&self) -> String {
        match self {
            Scripted::StandStill => "stand-still".to_owned(),
            Scripted::Random => "random".to_owned(),
            Scripted::Straight(_) => "straight".to_owned(),
            Scripted::Clearance(_, clearance) => format!("clearance-{clearance:.1}"),
        }
    }
}

/// The push that brings the mean velocity vbar as close as may be to full drift towards a target.
fn fly(config: &PointConfig, position: [f64; 2], velocity: [f64; 2], target: [f64; 2]) -> Force {
    let way = Vector2::from(target) - Vector2::from(position);
    let drift = config.acceleration / (1.0 - config.velocity_retention).max(0.1);
    // Not so fast that a step would go beyond the target.
    let speed = drift.min(way.norm() / config.control_step);
    let wanted = way.try_normalize(1e-9).unwrap_or_else(Vector2::zeros) * speed;
    Force((wanted - Vector2::from(velocity)) / config.acceleration.max(1e-9))
}

fn centre_of_goal(config: &PointConfig) -> [f64; 2] {
    [0, 1].map(|axis| (config.goal.min[axis] + config.goal.max[axis]) / 2.0)
}

impl Protagonist for Scripted {
    fn act(
        &self,
        _: u32,
        position: [f64; 2],
        velocity: [f64; 2],
        random: &mut ChaCha8Rng,
    ) -> Force {
        match self {
            Scripted::StandStill => Force(Vector2::zeros()),
            Scripted::Random => {
                let length = random.random::<f64>().sqrt();
                let angle = std::f64::consts::TAU * random.random::<f64>();
                Force(Vector2::new(length * angle.cos(), length * angle.sin()))
            }
            Scripted::Straight(config) => fly(config, position, velocity, centre_of_goal(config)),
            Scripted::Clearance(config, clearance) => {
                let [x, y] = position;
                let (min, max) = (config.lava.min, config.lava.max);
                let highest = config.arena[1] - config.radius;
                let lane = (max[1] + config.radius + clearance).min(highest);
                let before = x < min[0] && y < lane - 0.5 * clearance;
                let target = if before {
                    [x.min(min[0] / 2.0), lane]
                } else if x < max[0] + config.radius + clearance.min(0.5) {
                    [x + 1.5, lane]
                } else {
                    centre_of_goal(config)
                };
                fly(config, position, velocity, target)
            }
        }
    }
}
