//! The lattice over position and velocity, and one control step on it.
//!
//! Positions lie on a lattice over [r, W - r] x [r, H - r]. Velocities lie on three lattices of the
//! same spacing dv, each symmetric about 0:
//!
//! | lattice | of | reaches |
//! |---|---|---|
//! | v | velocity before the push | A rho/(1-rho) + 2.5 rho sigma / sqrt(1-rho^2), the fastest steady drift and its spread |
//! | vbar | mean velocity v + A u | that of v, and A |
//! | v+ | velocity after the noise | that of vbar, and 4 sigma |
//!
//! # One step, given v+
//! A substep of length h moves by h v and then leaves the share rho^(1/n) of v, so that a step of n
//! substeps in free flight displaces by
//!
//!   v+ tau (1 - rho) / (n (1 - rho^(1/n))),
//!
//! and leaves rho v+. A component that would carry the centre over a wall ends at the wall with
//! velocity 0; the axes do not act on each other. Lava and goal are tested along the straight path
//! of each substep.
//!
//! # Little noise
//! Values are interpolated in velocity by cubics where the noise spans 1.5 nodes or more, and by straight lines
//! where it spans less; there the programme is a Markov decision process of its own, whose values lie between
//! the least and the largest return whatever the lattice (Kushner and Dupuis 2001, section 5).
//!
//! Positions are interpolated by straight lines where those add little to the noise, and by limited cubics where
//! they would blur the world ([`Space::blurs`]).
//!
//! # Ends
//! Ends are a discontinuity in v+. Each node of v+ therefore represents its cell: [`Events`] holds
//! the shares of the cell that end in lava and in the goal.

use super::Lattice;
use lava_envs::point::Rectangle;
use lava_envs::{End, PointConfig};

/// Sub-samples per axis of a cell of the v+ lattice, for the shares of ends.
const SAMPLES: usize = 3;

/// How far in m the DP lets the disc into lava before it counts: nodes that lie on the border of
/// lava or goal are then nodes just outside, and the values next to a border are interpolated between
/// nodes that all run on.
const SLACK: f64 = 1e-4;

/// Standard deviations of the noise at which its lattice ends.
const TAILS: f64 = 4.0;

/// Standard deviation of the noise in nodes of the velocity lattice from which on weights that sample its
/// density have its variance.
const RESOLVED: f64 = 0.7;

/// Standard deviation of the noise in nodes of the velocity lattice from which on means over the noise are so
/// smooth that cubics follow them. Below it cubics overshoot, and the maximum over pushes seeks the
/// overshoot; straight lines stay between the values at the nodes.
const SMOOTH: f64 = 1.5;

/// Equally spaced nodes of one position axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axis {
    /// The first node in m.
    pub origin: f64,
    /// Distance of neighbours in m.
    pub step: f64,
    /// Number of nodes, at least 2.
    pub nodes: usize,
}

impl Axis {
    fn new(low: f64, high: f64, cell: f64) -> Axis {
        let intervals = ((high - low) / cell).round().max(1.0);
        Axis { origin: low, step: (high - low) / intervals, nodes: intervals as usize + 1 }
    }

    /// Position of a node in m.
    pub fn at(&self, node: usize) -> f64 {
        self.origin + self.step * node as f64
    }

    /// The node below a position and the position's share of the way to the next.
    pub fn locate(&self, position: f64) -> (usize, f64) {
        let place = ((position - self.origin) / self.step).clamp(0.0, (self.nodes - 1) as f64);
        let node = (place as usize).min(self.nodes - 2);
        (node, place - node as f64)
    }
}

/// Where one axis of a step leads, from a node and a node of v+.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Landing {
    /// The node below.
    pub node: usize,
    /// Share of the way to the next node.
    pub share: f32,
    /// Index of the velocity afterwards, rho times this node of v+.
    pub velocity: usize,
}

/// Shares of the cells of v+ that end, as counts of sub-samples: lava in the lowest four bits, goals in the next four,
/// lesser goals in the next.
pub type Events = Vec<u16>;

/// A lattice laid over a world.
#[derive(Debug, Clone)]
pub struct Space {
    /// Constants of the world.
    pub config: PointConfig,
    /// Position axes x and y.
    pub axes: [Axis; 2],
    /// Spacing dv of the velocities in m/s.
    pub spacing: f64,
    /// Nodes of v, vbar and v+ on either side of 0.
    pub halves: Halves,
    /// Weights of the Gaussian smoothing, of length 2 (plus - mean) + 1, summing to 1.
    pub kernel: Vec<f32>,
    /// Whether velocities are interpolated by straight lines in place of cubics.
    pub straight: bool,
    /// Displacement in s per unit of v+.
    pub reach: f64,
    /// Which end a node itself is, by `x * ny + y`.
    pub stopped: Vec<Option<Ending>>,
    /// Shares of ends by node; empty where no velocity of the lattice ends.
    pub events: Vec<Events>,
    /// Landings by `axis`, then `node * (2 plus + 1) + velocity`.
    pub landings: [Vec<Landing>; 2],
}

/// Nodes on either side of 0 of the three velocity lattices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Halves {
    /// Of v, before the push.
    pub before: usize,
    /// Of vbar.
    pub mean: usize,
    /// Of v+, after the noise.
    pub plus: usize,
}

impl Halves {
    fn new(config: &PointConfig, spacing: f64) -> Halves {
        let (rho, sigma, push) = (config.velocity_retention, config.noise, config.acceleration);
        let drift = push * rho / (1.0 - rho).max(1e-9);
        let spread = rho * sigma / (1.0 - rho * rho).max(1e-9).sqrt();
        // Without damping there is no steady drift; faster than this nobody steers.
        let fastest = (drift + 2.5 * spread).min(4.0 * (push + sigma)).max(spacing);
        let nodes = |speed: f64| (speed / spacing - 1e-9).ceil().max(0.0) as usize;
        let before = nodes(fastest).max(2);
        // Two more for the stencil of the cubic interpolation.
        let mean = before + nodes(push) + 2;
        Halves { before, mean, plus: mean + nodes(TAILS * sigma) }
    }
}

impl Space {
    /// Lays a lattice over a valid configuration.
    pub fn new(config: &PointConfig, lattice: &Lattice, threads: usize) -> Space {
        let (radius, spacing) = (config.radius, lattice.velocity);
        let axes = [0, 1].map(|axis| Axis::new(radius, config.arena[axis] - radius, lattice.cell));
        let halves = Halves::new(config, spacing);
        let kernel = kernel(config.noise / spacing, halves.plus - halves.mean);

        let mut space = Space {
            config: config.clone(),
            axes,
            spacing,
            halves,
            kernel,
            straight: config.noise / spacing < SMOOTH,
            reach: reach(config),
            stopped: Vec::new(),
            events: Vec::new(),
            landings: [Vec::new(), Vec::new()],
        };
        space.landings = [0, 1].map(|axis| space.axis_landings(axis));
        let scene = Scene::new(config);
        space.stopped = (0..axes[0].nodes * axes[1].nodes)
            .map(|node| scene.end_at(space.position(node)))
            .collect();
        space.events = space.all_events(&scene, threads);
        space
    }

    /// Bytes that the table of a controller and the work space of its programme would take.
    pub fn bytes(config: &PointConfig, lattice: &Lattice) -> f64 {
        let nodes = |axis: usize| {
            ((config.arena[axis] - 2.0 * config.radius) / lattice.cell).round().max(1.0) + 1.0
        };
        let Halves { mean, plus, .. } = Halves::new(config, lattice.velocity);
        let square = |half: usize| (2.0 * half as f64 + 1.0).powi(2);
        let table = f64::from(config.horizon) * square(mean) * 4.0;
        // V of two times in single precision, and the shares of ends in two bytes.
        nodes(0) * nodes(1) * (table + square(plus) * 10.0)
    }

    /// Weights of four nodes for interpolation in velocity, at `share` between the middle ones.
    #[inline(always)]
    pub fn weights(&self, share: f64) -> [f32; 4] {
        if self.straight { linear(share) } else { cubic(share) }
    }

    /// Number of position nodes.
    pub fn nodes(&self) -> usize {
        self.axes[0].nodes * self.axes[1].nodes
    }

    /// Whether straight lines between positions would spread the state of an episode, step by step, by more than a
    /// tenth of what noise does. The position is uniform between two nodes for most steps, and the line then has
    /// the variance of a sixth of their squared distance.
    pub fn blurs(&self) -> bool {
        let widest = self.axes.iter().fold(0.0_f64, |widest, axis| widest.max(axis.step));
        let (lines, noise) = (widest.powi(2) / 6.0, (self.reach * self.config.noise).powi(2));
        lines > 0.1 * noise
    }

    /// Whether the noise is so small for the lattice that returns are a matter of whole steps.
    pub fn is_coarse(&self) -> bool {
        self.blurs() || self.config.noise / self.spacing < SMOOTH
    }

    /// Position of a node in m.
    pub fn position(&self, node: usize) -> [f64; 2] {
        let ny = self.axes[1].nodes;
        [self.axes[0].at(node / ny), self.axes[1].at(node % ny)]
    }

    /// Velocity of a node of v+ in m/s.
    pub fn plus(&self, index: usize) -> f64 {
        (index as f64 - self.halves.plus as f64) * self.spacing
    }

    fn axis_landings(&self, axis: usize) -> Vec<Landing> {
        let line = self.axes[axis];
        let (low, high) = (line.origin, line.at(line.nodes - 1));
        let mut landings = Vec::with_capacity(line.nodes * (2 * self.halves.plus + 1));
        for node in 0..line.nodes {
            for index in 0..=2 * self.halves.plus {
                let goes_to = line.at(node) + self.reach * self.plus(index);
                let stops = goes_to < low - 1e-9 || goes_to > high + 1e-9;
                let (below, share) = line.locate(goes_to);
                landings.push(Landing {
                    node: below,
                    share: share as f32,
                    velocity: if stops { self.halves.plus } else { index },
                });
            }
        }
        landings
    }

    fn all_events(&self, scene: &Scene, threads: usize) -> Vec<Events> {
        let mut events = vec![Vec::new(); self.nodes()];
        let share = self.nodes().div_ceil(8 * threads).max(1);
        let queue = std::sync::Mutex::new(events.chunks_mut(share).enumerate());
        std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    loop {
                        let next = queue.lock().expect("no worker panics with the queue").next();
                        let Some((chunk, events)) = next else { break };
                        for (index, events) in events.iter_mut().enumerate() {
                            *events = self.events_of(scene, chunk * share + index);
                        }
                    }
                });
            }
        });
        events
    }

    fn events_of(&self, scene: &Scene, node: usize) -> Events {
        let position = self.position(node);
        let furthest = self.reach * self.spacing * (self.halves.plus + 1) as f64;
        let around = position.map(|p| [p - furthest, p + furthest]);
        if self.stopped[node].is_some() || !scene.may_end([around[0], around[1]]) {
            return Vec::new();
        }
        let count = 2 * self.halves.plus + 1;
        let mut events = Vec::with_capacity(count * count);
        let offsets: Vec<f64> = (0..SAMPLES)
            .map(|s| (s as f64 - (SAMPLES - 1) as f64 / 2.0) / SAMPLES as f64 * self.spacing)
            .collect();
        for i in 0..count {
            for j in 0..count {
                let mut code = 0;
                for dx in &offsets {
                    for dy in &offsets {
                        let velocity = [self.plus(i) + dx, self.plus(j) + dy];
                        let end = scene.step(position, velocity).end;
                        code += end.map_or(0, |end| 1 << (4 * end as u16));
                    }
                }
                events.push(code);
            }
        }
        if events.iter().all(|&code| code == 0) { Vec::new() } else { events }
    }
}

/// Displacement in s per unit of v+ in free flight.
pub(super) fn reach(config: &PointConfig) -> f64 {
    let left = config.velocity_retention.powf(1.0 / f64::from(config.substeps));
    let travel: f64 = (0..config.substeps).map(|k| left.powi(k as i32)).sum();
    config.substep() * travel
}

/// Weights of the smoothing over noise, for `wide` nodes on either side, whose variance is that of the noise.
/// `ratio` is its standard deviation in nodes.
fn kernel(ratio: f64, wide: usize) -> Vec<f32> {
    let nodes = -(wide as i64)..=wide as i64;
    let weight = |m: i64| {
        if ratio >= RESOLVED {
            (-0.5 * (m as f64 / ratio).powi(2)).exp()
        } else {
            // The law on three nodes with the first three moments of the noise.
            match m {
                0 => 1.0 - ratio * ratio,
                -1 | 1 => 0.5 * ratio * ratio,
                _ => 0.0,
            }
        }
    };
    let total: f64 = nodes.clone().map(weight).sum();
    nodes.map(|m| (weight(m) / total) as f32).collect()
}

/// Shares of the ends in a code of [`Events`], by [`Ending`].
pub fn shares(code: u16) -> [f32; ENDINGS] {
    let all = (SAMPLES * SAMPLES) as f32;
    std::array::from_fn(|end| f32::from(code >> (4 * end) & 15) / all)
}

/// What a place of the arena ends an episode with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ending {
    /// Lava.
    Lava,
    /// A goal.
    Goal,
    /// A goal that pays the lesser reward.
    LesserGoal,
}

/// Number of [`Ending`]s.
pub const ENDINGS: usize = 3;

/// What a control step leads to once v+ is fixed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moved {
    /// Where the centre is, in m; at an end, the point of impact.
    pub position: [f64; 2],
    /// Velocity after damping, in m/s.
    pub velocity: [f64; 2],
    /// What the step ends in, if it does.
    pub end: Option<Ending>,
}

/// Lava, goal and walls, as the DP sees them, and how a disc moves among them.
#[derive(Debug, Clone)]
pub struct Scene {
    lava: Vec<Rectangle>,
    goals: Vec<(Rectangle, Ending)>,
    radius: f64,
    /// Where the centre may be, by axis.
    room: [[f64; 2]; 2],
    substeps: u32,
    substep: f64,
    /// Share of the velocity that is left after a substep, and after a control step.
    left: [f64; 2],
    /// Displacement in s per unit of v+ in free flight.
    reach: f64,
}

impl Scene {
    /// The scene of a valid configuration.
    pub fn new(config: &PointConfig) -> Scene {
        let goal = |(Rectangle { min, max }, reward): (Rectangle, f64)| {
            let inner = Rectangle { min: min.map(|c| c + SLACK), max: max.map(|c| c - SLACK) };
            (inner, if reward == config.goal_reward { Ending::Goal } else { Ending::LesserGoal })
        };
        let left = config.velocity_retention.powf(1.0 / f64::from(config.substeps));
        Scene {
            lava: config.lava().collect(),
            goals: config.goals().map(goal).collect(),
            radius: config.radius - SLACK,
            room: config.arena.map(|side| [config.radius, side - config.radius]),
            substeps: config.substeps,
            substep: config.substep(),
            left: [left, config.velocity_retention],
            reach: reach(config),
        }
    }

    /// Which end a centre at rest is in.
    pub fn end_at(&self, position: [f64; 2]) -> Option<Ending> {
        self.first_end(position, [0.0, 0.0]).map(|(_, end)| end)
    }

    /// Whether a path in the box `[[x_min, x_max], [y_min, y_max]]` may end.
    fn may_end(&self, [x, y]: [[f64; 2]; 2]) -> bool {
        let meets = |rectangle: &Rectangle, margin: f64| {
            x[0] <= rectangle.max[0] + margin
                && x[1] >= rectangle.min[0] - margin
                && y[0] <= rectangle.max[1] + margin
                && y[1] >= rectangle.min[1] - margin
        };
        self.lava.iter().any(|lava| meets(lava, self.radius))
            || self.goals.iter().any(|(goal, _)| meets(goal, 0.0))
    }

    /// One control step from a velocity after the noise.
    pub fn step(&self, position: [f64; 2], velocity: [f64; 2]) -> Moved {
        let stops = |axis: usize, goes_to: f64| {
            let [low, high] = self.room[axis];
            goes_to < low - 1e-9 || goes_to > high + 1e-9
        };
        // Damping does not turn the velocity: in free flight all substeps together are one straight path.
        let path = velocity.map(|v| self.reach * v);
        let free = (0..2).all(|axis| !stops(axis, position[axis] + path[axis]));
        let (times, length) = if free { (1, self.reach) } else { (self.substeps, self.substep) };
        let left = self.left[usize::from(free)];
        let (mut position, mut velocity) = (position, velocity);
        for _ in 0..times {
            let before = position;
            for axis in 0..2 {
                let [low, high] = self.room[axis];
                let goes_to = position[axis] + length * velocity[axis];
                position[axis] = goes_to.clamp(low, high);
                velocity[axis] = if stops(axis, goes_to) { 0.0 } else { velocity[axis] * left };
            }
            let path = [position[0] - before[0], position[1] - before[1]];
            if let Some((time, end)) = self.first_end(before, path) {
                let impact = [before[0] + time * path[0], before[1] + time * path[1]];
                return Moved { position: impact, velocity, end: Some(end) };
            }
        }
        Moved { position, velocity, end: None }
    }

    /// The first end on a straight path, with its share of the path; lava if both coincide.
    fn first_end(&self, from: [f64; 2], path: [f64; 2]) -> Option<(f64, Ending)> {
        let line = |axis: usize| {
            let (a, b) = (from[axis], from[axis] + path[axis]);
            [a.min(b), a.max(b)]
        };
        if !self.may_end([line(0), line(1)]) {
            return None;
        }
        let lava = self.lava.iter().filter_map(|&lava| self.time_to_lava(lava, from, path));
        let lava = lava.min_by(f64::total_cmp).map(|time| (time, Ending::Lava));
        let goals = self.goals.iter().filter_map(|&(Rectangle { min, max }, ending)| {
            time_to_box(from, path, min, max).map(|time| (time, ending))
        });
        // The first of equal ones is the least.
        lava.into_iter().chain(goals).min_by(|a, b| a.0.total_cmp(&b.0))
    }

    /// The centre touches lava in the rectangle grown in x, the one grown in y, or the discs at the
    /// corners.
    fn time_to_lava(
        &self,
        Rectangle { min, max }: Rectangle,
        from: [f64; 2],
        path: [f64; 2],
    ) -> Option<f64> {
        let r = self.radius;
        let grown_x = time_to_box(from, path, [min[0] - r, min[1]], [max[0] + r, max[1]]);
        let grown_y = time_to_box(from, path, [min[0], min[1] - r], [max[0], max[1] + r]);
        let corners = [min, [min[0], max[1]], [max[0], min[1]], max];
        let corners = corners.iter().filter_map(|&corner| time_to_disc(from, path, corner, r));
        grown_x.into_iter().chain(grown_y).chain(corners).min_by(f64::total_cmp)
    }
}

impl From<Ending> for End {
    fn from(ending: Ending) -> End {
        match ending {
            Ending::Lava => End::Lava,
            Ending::Goal | Ending::LesserGoal => End::Goal,
        }
    }
}

/// Share of a straight path after which it is in a box.
pub(super) fn time_to_box(
    from: [f64; 2],
    path: [f64; 2],
    min: [f64; 2],
    max: [f64; 2],
) -> Option<f64> {
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for axis in 0..2 {
        if path[axis] == 0.0 {
            if from[axis] < min[axis] || from[axis] > max[axis] {
                return None;
            }
        } else {
            let a = (min[axis] - from[axis]) / path[axis];
            let b = (max[axis] - from[axis]) / path[axis];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
    }
    (enter <= leave).then_some(enter)
}

fn time_to_disc(from: [f64; 2], path: [f64; 2], centre: [f64; 2], radius: f64) -> Option<f64> {
    let off = [from[0] - centre[0], from[1] - centre[1]];
    let outside = off[0] * off[0] + off[1] * off[1] - radius * radius;
    if outside <= 0.0 {
        return Some(0.0);
    }
    // The smaller root of a s^2 + 2 b s + outside = 0.
    let a = path[0] * path[0] + path[1] * path[1];
    let b = off[0] * path[0] + off[1] * path[1];
    let root = b * b - a * outside;
    if b >= 0.0 || root < 0.0 {
        return None;
    }
    let time = outside / (-b + root.sqrt());
    (time <= 1.0).then_some(time)
}

/// Weights of the straight line between nodes 0 and 1 at `share` in [0, 1], as [`cubic`] orders them.
#[inline(always)]
pub fn linear(share: f64) -> [f32; 4] {
    [0.0, (1.0 - share) as f32, share as f32, 0.0]
}

/// Weights of the cubic through four equally spaced nodes -1, 0, 1, 2 at `share` in [0, 1].
#[inline(always)]
pub fn cubic(share: f64) -> [f32; 4] {
    let s = share;
    [
        -s * (s - 1.0) * (s - 2.0) / 6.0,
        (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
        -(s + 1.0) * s * (s - 2.0) / 2.0,
        (s + 1.0) * s * (s - 1.0) / 6.0,
    ]
    .map(|weight| weight as f32)
}
