//! `lava-point`: a disc that is pushed across a plane with lava, in metres and seconds.
//!
//! A control step of length tau goes
//!
//! 1. the action u is scaled onto the unit disc if it is longer; vbar = v + A u;
//! 2. chance draws xi, nominally N(0, I); v = vbar + sigma xi;
//! 3. Rapier integrates n substeps of tau/n, with walls and damping ([`physics`]);
//! 4. in the first substep in which the disc touches lava the episode ends with `lava_reward`, in
//!    which its centre gets inside the goal region with `goal_reward`; of two impacts in one substep
//!    the earlier one counts, and lava if they coincide. Both tests are swept along the substep's
//!    motion ([`geometry`]), so that no fast body jumps over a corner. Walls inside the arena bend the motion there. Otherwise the reward is
//!    `-step_cost`, and after T steps the episode ends.
//!
//! The state is position and velocity in f32, Rapier's precision; x counts to the right, y downward,
//! both from the arena's corner. An ended episode stays where it ended: at the point of impact.

pub mod config;
pub mod geometry;
pub mod physics;

pub use config::{PointConfig, Rectangle};

use crate::action::{Action, Plane};
use crate::error::{ConfigError, NoSuchState};
use crate::law::GaussianLaw;
use crate::map::Map;
use crate::random::ChaCha8Rng;
use crate::scene::{Area, AreaKind, Field, Scene as Picture};
use crate::world::{End, Step, World, return_range};
use geometry::{Scene, Slid};
use nalgebra::Vector2;
use physics::{Body, Physics};
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use rapier2d::math::Vector;
use serde::{Deserialize, Serialize};

/// Positions that are tried to scatter a slot.
const MOST_DRAWS: usize = 1000;

/// Speed that the observation maps onto 1 (m/s).
pub const OBSERVED_SPEED: f64 = 4.0;

/// The action: a push u, in units of the largest one. Longer vectors than 1 are allowed; the world
/// scales them onto the unit disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Force(pub Vector2<f64>);

impl Force {
    /// The push that the world carries out, of length at most 1.
    pub fn on_disc(self) -> Vector2<f64> {
        let length = self.0.norm();
        if length > 1.0 { self.0 / length } else { self.0 }
    }
}

impl Action for Force {
    type Kind = Plane;

    /// Uniform on the unit disc.
    fn uniform(random: &mut impl Rng) -> Force {
        let (angle, length) =
            (random.random::<f64>() * std::f64::consts::TAU, random.random::<f64>().sqrt());
        Force(Vector2::new(length * angle.cos(), length * angle.sin()))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
struct Clock {
    time: u32,
    ended: bool,
}

/// State of an episode. Rapier keeps nothing of a disc from step to step, see [`physics`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    position: [f32; 2],
    velocity: [f32; 2],
    clock: Clock,
}

/// A batch of episodes of `lava-point`.
pub struct LavaPoint {
    config: PointConfig,
    scene: Scene,
    physics: Physics,
    bodies: Vec<Body>,
    clocks: Vec<Clock>,
    /// Work space: the slots that still move in this control step.
    moving: Vec<usize>,
    /// Work space: where each of them was before the substep.
    before: Vec<Vector>,
    /// Work space: the path of each of them in this substep, where walls inside the arena have bent it.
    slid: Vec<Option<Slid>>,
    /// Work space: the slots that no such wall stops in this substep.
    free: Vec<usize>,
}

impl LavaPoint {
    /// The same world with every substep of every body in Rapier. Bit for bit equal and slower; for tests and
    /// benchmarks.
    ///
    /// # Errors
    /// If a value of the configuration is out of range.
    pub fn by_rapier_alone(config: &PointConfig, episodes: usize) -> Result<Self, ConfigError> {
        let mut world = LavaPoint::new(config, episodes)?;
        world.physics.give_all_to_rapier();
        Ok(world)
    }

    /// Velocity of the disc in m/s.
    pub fn velocity(&self, slot: usize) -> [f64; 2] {
        floats(self.bodies[slot].velocity)
    }

    /// Starts a new episode at time 0 from a given state (metres, m/s; rounded to f32) instead of the
    /// initial one. For tests and for yardsticks that need other starts.
    ///
    /// # Panics
    /// If the disc does not lie in the arena, lies in a wall, or a number is not finite.
    pub fn place(&mut self, slot: usize, position: [f64; 2], velocity: [f64; 2]) {
        let inside = (0..2).all(|axis| {
            let margin = self.config.radius - 1e-4; // a disc at a wall has rounding errors
            position[axis] >= margin && position[axis] <= self.config.arena[axis] - margin
        });
        assert!(inside, "a disc of radius {} at {position:?} leaves the arena", self.config.radius);
        let in_wall = self.scene.in_wall(vector(position), 1e-4);
        assert!(!in_wall, "a disc of radius {} at {position:?} lies in a wall", self.config.radius);
        assert!(velocity.iter().all(|v| v.is_finite()), "the velocity {velocity:?} is not finite");
        self.bodies[slot] = Body { position: vector(position), velocity: vector(velocity) };
        self.clocks[slot] = Clock { time: 0, ended: false };
    }

    /// Mean velocity vbar = v + A u after the push, in m/s.
    pub fn mean_velocity(&self, slot: usize, action: Force) -> Vector2<f64> {
        Vector2::from(self.velocity(slot)) + self.config.acceleration * action.on_disc()
    }

    /// Moves the bodies of the moving slots by one substep.
    fn substep(&mut self) {
        if !self.scene.has_walls() {
            return self.physics.substep(&mut self.bodies, &self.moving);
        }
        self.slid.clear();
        self.free.clear();
        for &slot in &self.moving {
            let body = &mut self.bodies[slot];
            let velocity = self.physics.limited(body.velocity);
            let slid = self.scene.slide(body.position, velocity, self.physics.dt());
            match slid {
                None => self.free.push(slot),
                Some(slid) => {
                    *body =
                        Body { position: slid.end(), velocity: self.physics.damped(slid.velocity) };
                }
            }
            self.slid.push(slid);
        }
        self.physics.substep(&mut self.bodies, &self.free);
    }

    fn scaled_position(&self, slot: usize) -> [f32; 2] {
        let [x, y] = self.position(slot);
        let [width, height] = self.config.arena;
        [(2.0 * x / width - 1.0) as f32, (2.0 * y / height - 1.0) as f32]
    }
}

fn vector([x, y]: [f64; 2]) -> Vector {
    Vector::new(x as f32, y as f32)
}

fn floats(vector: Vector) -> [f64; 2] {
    [f64::from(vector.x), f64::from(vector.y)]
}

impl World for LavaPoint {
    type Constants = PointConfig;
    type Action = Force;
    type Law = GaussianLaw;
    type Snapshot = Snapshot;

    const NAME: &'static str = "lava-point";
    const DEFAULTS: &'static str = config::DEFAULTS;
    const TRAINING: &'static str = config::TRAINING;

    /// Position, mapped from the arena onto [-1, 1]^2, and velocity in units of [`OBSERVED_SPEED`].
    const OBSERVATION: usize = 4;
    /// Position likewise, and the mean post-force velocity vbar likewise. The parameters of the law
    /// are constants (xi is standard normal, sigma is the config's) and are therefore left out.
    const SITUATION: usize = 4;
    /// Both vectors begin with the position.
    const POSITIONS: usize = 2;

    /// A cell is a square metre, and the disc starts in the middle of its cell.
    fn of_map(map: &Map) -> Result<toml::Table, String> {
        config::of_map(map)
    }

    fn new(config: &PointConfig, episodes: usize) -> Result<Self, ConfigError> {
        config.check_values()?;
        let start = Body { position: vector(config.start), velocity: Vector::ZERO };
        Ok(LavaPoint {
            scene: Scene::new(config),
            physics: Physics::new(config, episodes),
            bodies: vec![start; episodes],
            clocks: vec![Clock { time: 0, ended: false }; episodes],
            moving: Vec::with_capacity(episodes),
            before: Vec::with_capacity(episodes),
            slid: Vec::new(),
            free: Vec::new(),
            config: config.clone(),
        })
    }

    fn constants(&self) -> &PointConfig {
        &self.config
    }

    fn validate(constants: &PointConfig) -> Result<(), ConfigError> {
        constants.validate()
    }

    fn episodes(&self) -> usize {
        self.bodies.len()
    }

    fn horizon(&self) -> u32 {
        self.config.horizon
    }

    fn reset(&mut self, slot: usize) {
        self.bodies[slot] = Body { position: vector(self.config.start), velocity: Vector::ZERO };
        self.clocks[slot] = Clock { time: 0, ended: false };
    }

    /// The position is uniform over where the disc touches neither lava nor wall nor goal, the velocity normal with
    /// the noise's standard deviation. Where almost nothing of the arena is free, the slot is reset.
    fn scatter(&mut self, slot: usize, random: &mut ChaCha8Rng) {
        let PointConfig { arena, radius, noise, horizon, .. } = self.config;
        if horizon == 1 {
            return self.reset(slot);
        }
        let free = (0..MOST_DRAWS).find_map(|_| {
            let place = arena.map(|side| random.random_range(radius..=side - radius));
            let centre = vector(place);
            let ended = self.scene.in_goal(centre) || self.scene.clearance(centre) == 0.0;
            (!ended && !self.scene.in_wall(centre, 0.0)).then_some(place)
        });
        let Some(position) = free else { return self.reset(slot) };
        let fastest = physics::speed_limit(&self.config);
        let velocity: [f64; 2] = std::array::from_fn(|_| {
            let velocity = noise * random.sample::<f64, _>(StandardNormal);
            velocity.clamp(-fastest, fastest)
        });
        self.bodies[slot] = Body { position: vector(position), velocity: vector(velocity) };
        self.clocks[slot] = Clock { time: random.random_range(1..horizon), ended: false };
    }

    fn snapshot(&self, slot: usize) -> Snapshot {
        let Body { position, velocity } = self.bodies[slot];
        let [position, velocity] = [position.to_array(), velocity.to_array()];
        Snapshot { position, velocity, clock: self.clocks[slot] }
    }

    fn restore(&mut self, slot: usize, snapshot: Snapshot) -> Result<(), NoSuchState> {
        let Snapshot { position, velocity, clock } = snapshot;
        // Wide enough for rounding at walls and at the speed limit. No comparison holds for a NaN.
        let fastest = 2.0 * physics::speed_limit(&self.config) as f32;
        let possible = (0..2).all(|axis| {
            (0.0..=self.config.arena[axis] as f32).contains(&position[axis])
                && velocity[axis].abs() <= fastest
        });
        let possible = possible && !self.scene.in_wall(position.into(), 1e-3);
        // A running episode has time left.
        if !possible || clock.time > self.config.horizon - u32::from(!clock.ended) {
            return Err(NoSuchState::of(&snapshot));
        }
        self.bodies[slot] = Body { position: position.into(), velocity: velocity.into() };
        self.clocks[slot] = clock;
        Ok(())
    }

    fn time(&self, slot: usize) -> u32 {
        self.clocks[slot].time
    }

    fn observe(&self, slot: usize, observation: &mut [f32]) {
        let velocity = self.bodies[slot].velocity / OBSERVED_SPEED as f32;
        observation[..2].copy_from_slice(&self.scaled_position(slot));
        observation[2..].copy_from_slice(&velocity.to_array());
    }

    fn law(&self, _slot: usize, _action: Force) -> GaussianLaw {
        GaussianLaw
    }

    fn situation(&self, slot: usize, action: Force, situation: &mut [f32]) {
        let velocity = self.mean_velocity(slot, action) / OBSERVED_SPEED;
        situation[..2].copy_from_slice(&self.scaled_position(slot));
        situation[2..].copy_from_slice(&[velocity.x as f32, velocity.y as f32]);
    }

    /// Distance from the disc's surface to the nearest lava in metres, 0 at contact.
    fn clearance(&self, slot: usize) -> f64 {
        self.scene.clearance(self.bodies[slot].position)
    }

    fn position(&self, slot: usize) -> [f64; 2] {
        floats(self.bodies[slot].position)
    }

    fn scene(&self) -> Picture {
        let PointConfig { arena, start, step_cost, goal_reward, lava_reward, .. } = self.config;
        let area = |kind, of: Rectangle| Area { kind, min: of.min, max: of.max };
        let goal = |(goal, reward): (Rectangle, f64)| {
            let lesser = reward != self.config.goal_reward;
            area(if lesser { AreaKind::LesserGoal } else { AreaKind::Goal }, goal)
        };
        let mut areas: Vec<Area> = self.config.lava().map(|of| area(AreaKind::Lava, of)).collect();
        areas.extend(self.config.goals().map(goal));
        areas.extend(self.config.walls().map(|of| area(AreaKind::Wall, of)));
        Picture {
            size: arena,
            cells: false,
            start,
            areas,
            rules: format!(
                "A step costs {step_cost}, lava pays {lava_reward} and the goal {goal_reward}, both of \
                 which end the episode; so does step {}. The noise has a standard deviation of {} m/s.",
                self.config.horizon, self.config.noise
            ),
        }
    }

    fn return_range(&self, gamma: f64) -> Option<[f64; 2]> {
        let of = &self.config;
        let ends = of.goals().map(|(_, reward)| reward).chain([of.lava_reward]);
        Some(return_range(of.step_cost, &ends.collect::<Vec<_>>(), of.horizon, gamma))
    }

    fn state_columns(&self, slot: usize) -> Vec<(&'static str, Field)> {
        let ([x, y], [vx, vy]) = (self.position(slot), self.velocity(slot));
        [("x", x), ("y", y), ("vx", vx), ("vy", vy)]
            .map(|(name, number)| (name, Field::Number(number)))
            .into()
    }

    fn action_columns(Force(push): Force) -> Vec<(&'static str, Field)> {
        vec![("action_x", Field::Number(push.x)), ("action_y", Field::Number(push.y))]
    }

    fn outcome_columns(xi: Vector2<f64>) -> Vec<(&'static str, Field)> {
        vec![("xi_x", Field::Number(xi.x)), ("xi_y", Field::Number(xi.y))]
    }

    fn action_arrow(action: Force) -> [f64; 2] {
        action.on_disc().into()
    }

    fn outcome_arrow(xi: Vector2<f64>) -> [f64; 2] {
        xi.into()
    }

    /// # Panics
    /// If an action or an outcome of a running episode is not finite.
    fn apply(&mut self, actions: &[Force], outcomes: &[Vector2<f64>], steps: &mut [Step]) {
        assert_eq!(actions.len(), self.bodies.len(), "one action per slot");
        assert_eq!(outcomes.len(), self.bodies.len(), "one outcome per slot");
        assert_eq!(steps.len(), self.bodies.len(), "one step per slot");
        self.moving.clear();
        for (slot, step) in steps.iter_mut().enumerate() {
            *step = Step::IDLE;
            if self.clocks[slot].ended {
                continue;
            }
            let velocity =
                self.mean_velocity(slot, actions[slot]) + self.config.noise * outcomes[slot];
            assert!(
                velocity.iter().all(|v| v.is_finite()),
                "slot {slot}: {:?} with outcome {:?} is not finite",
                actions[slot],
                outcomes[slot],
            );
            self.bodies[slot].velocity = vector(velocity.into());
            self.clocks[slot].time += 1;
            step.reward = -self.config.step_cost;
            self.moving.push(slot);
        }

        for _ in 0..self.config.substeps {
            self.before.clear();
            self.before.extend(self.moving.iter().map(|&slot| self.bodies[slot].position));
            self.substep();

            let mut kept = 0;
            for index in 0..self.moving.len() {
                let slot = self.moving[index];
                let position = &mut self.bodies[slot].position;
                let impact = match self.slid.get(index).copied().flatten() {
                    None => self.scene.impact(self.before[index], *position),
                    Some(slid) => slid.legs().find_map(|(from, to)| self.scene.impact(from, to)),
                };
                if let Some((impact, end, reward)) = impact {
                    *position = impact;
                    self.clocks[slot].ended = true;
                    steps[slot] = Step { reward, end: Some(end) };
                } else {
                    self.moving[kept] = slot;
                    kept += 1;
                }
            }
            self.moving.truncate(kept);
        }

        for &slot in &self.moving {
            if self.clocks[slot].time == self.config.horizon {
                self.clocks[slot].ended = true;
                steps[slot].end = Some(End::Timeout);
            }
        }
    }
}
