//! An upper bound on the best CVaR that any policy has on `lava-point`.
//!
//! The oracle's controller says what can be attained; this says what cannot be surpassed. It is a relaxation: every
//! step of the dynamic programme below gives the protagonist at least what it has, so that the shortfall it
//! computes is at most that of any policy, with or without memory.
//!
//! # Coordinates
//! With rho the share of the velocity that a step leaves and c the displacement per unit of v+ (both as in
//! [`super::lattice`]), let y be where the disc would come to rest without pushes and noise,
//!
//!   y = p + kappa v,   kappa = c / (1 - rho).
//!
//! In free flight a step is then, exactly,
//!
//!   y' = y + kappa (A u + sigma xi),   p' = rho p + (1 - rho) y',
//!
//! a random walk that is steered, and a point that follows it. An axis on which p' would lie beyond a wall ends there
//! at rest, with p' = y' = the wall; the axes do not act on each other.
//!
//! # The programme
//! With b = w + (the cost of the steps so far), what an end with reward R still lacks of the threshold w is
//! (b - R)^+. Let S(P, Y, b) be at most the least E (w - J)^+ from any p in the square cell P and y in the cell Y.
//!
//! | exact | relaxed, in favour of the protagonist |
//! |---|---|
//! | y in Y | it chooses y in Y, anew in every step |
//! | y' = m + kappa sigma xi, with m = y + kappa A u | m is rounded to the node of its box, of side g; once xi is known, it chooses the rounding error |
//! | p' = rho p + (1 - rho) y' | it chooses p in P, too |
//! | the straight path from p to p' touches lava | only if it does so from every p in P to every y' in the cell |
//! | the path enters a goal | if it does so from some p in P to some y' in the cell, whatever comes first |
//! | \|xi\| beyond four standard deviations, or faster than the lattice's band | nothing is lacking |
//! | the episode ends at time T | it may end in any step whose b is at least the b of time T |
//!
//! What is lacking depends on time by b alone, and thresholds are returns of episodes that end, a step's cost apart. So one
//! recursion downwards in b has the bounds of all thresholds w, and
//!
//!   max_pi CVaR_alpha(J) <= max over returns w of { w - S(start, w) / alpha },   for every alpha at once.
//!
//! The cells' sides tell how much is given away: about a cell in every step, which is a stronger push. So the bound comes down as
//! cells become smaller.
//!
//! It holds for the motion of a point between walls, in exact arithmetic. The world's own single precision differs from that by
//! rounding, about 1e-6 m; sums here are rounded in favour of the protagonist (`MARGIN`).

use super::lattice::{reach, time_to_box};
use super::sweep::{LANES, combine};
use crate::exact::watch::Watch;
use crate::game::columns::{Loops, widest};
use crate::game::normal;
use lava_envs::PointConfig;
use lava_envs::point::Rectangle;
use serde::{Deserialize, Serialize};
use std::sync::Mutex;

/// Standard deviations at which noise is cut off, and at which the band of velocities ends.
const TAILS: f64 = 4.0;

/// By how much weights of the noise are lessened: more than the rounding of their sums in single precision.
const MARGIN: f64 = 1e-5;

/// Boxes per cell and axis, to whose nodes the mean of y' is rounded.
const FINER: usize = 2;

/// Largest share of the velocity that a step may leave: with more, y is far from p.
const MOST_RETENTION: f64 = 0.9;

/// Thresholds of one recursion. The more there are the sooner an episode of the largest may be over, which is a
/// relaxation: in that many steps before T.
const BLOCK: usize = 14;

/// Least alpha for which the recursion goes on until no lower threshold can matter.
const LEAST_ALPHA: f64 = 1e-3;

/// An upper bound on the best CVaR at every level.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UpperBound {
    /// Side of the cells in m.
    pub cell: f64,
    /// Thresholds w, each with a lower bound of the least E (w - J)^+ of any policy.
    pub shortfalls: Vec<(f64, f64)>,
    /// All returns that an episode may have.
    returns: Vec<f64>,
}

impl UpperBound {
    /// No policy has a CVaR_alpha above this.
    pub fn at(&self, alpha: f64) -> f64 {
        // A shortfall grows with its threshold, so that those of lower thresholds count; it is never negative.
        let lacking = |w: f64| {
            let below = self.shortfalls.iter().filter(|(known, _)| *known <= w + 1e-9);
            below.map(|(_, shortfall)| *shortfall).fold(0.0, f64::max)
        };
        let bounds = self.returns.iter().map(|&w| w - lacking(w) / alpha);
        bounds.fold(f64::NEG_INFINITY, f64::max)
    }
}

/// One axis of the cells.
#[derive(Debug, Clone)]
struct Axis {
    /// Number of cells of p.
    cells: usize,
    /// Least p in m.
    low: f64,
    /// Where a step may lead, by cell of p and y' - p.
    landings: Vec<Vec<Landing>>,
}

/// Cells that a step may lead to, along one axis.
#[derive(Debug, Clone, Copy)]
struct Landing {
    /// The cell of p'.
    p: usize,
    /// That of y' - p', counted from the first of the band; `None` outside it.
    away: Option<usize>,
}

/// Sizes in cells, or in boxes.
#[derive(Debug, Clone, Copy)]
struct Sizes {
    /// |y - p|, in cells on either side.
    band: usize,
    /// |y' - p|, likewise.
    far: usize,
    /// Boxes of m, and boxes of y' that are shifted by half a box, along an axis; with whole lanes.
    means: usize,
    noisy: usize,
    wide_means: usize,
    wide_noisy: usize,
    /// Boxes beyond the cell of y that a push reaches.
    push: usize,
    /// Weights of the noise on either side.
    tails: usize,
}

impl Sizes {
    fn new(config: &PointConfig, cell: f64, kappa: f64) -> Sizes {
        let (rho, sigma) = (config.velocity_retention, config.noise);
        let drift = config.acceleration * rho / (1.0 - rho);
        let spread = rho * sigma / (1.0 - rho * rho).sqrt();
        let band = (kappa * (drift + TAILS * spread) / cell).ceil().max(1.0) as usize;
        let side = cell / FINER as f64;
        let push = (kappa * config.acceleration / side).floor() as usize + 1;
        let tails = (TAILS * kappa * sigma / side).ceil().max(1.0) as usize;
        let means = (2 * band + 1) * FINER + 2 * push;
        let noisy = means + 2 * tails - 1;
        // Beyond this y' - p' leaves the band, or no mean and noise lead there.
        let widest = push.div_ceil(FINER) + tails.div_ceil(FINER) + 1 + band;
        let far = if rho > 0.0 { ((band as f64 + 2.0) / rho) as usize } else { widest };
        Sizes {
            band,
            far: far.min(widest),
            means,
            noisy,
            wide_means: means.next_multiple_of(LANES) + LANES,
            wide_noisy: noisy.next_multiple_of(LANES) + LANES,
            push,
            tails,
        }
    }

    fn row(self) -> usize {
        2 * self.band + 1
    }

    fn far_row(self) -> usize {
        2 * self.far + 1
    }
}

/// What a step from a cell of p to a cell of y' may or must end in.
mod code {
    /// It certainly touches lava.
    pub const LAVA: u8 = 1;
    /// It may enter a goal.
    pub const GOAL: u8 = 2;
    /// It may enter a goal that pays the lesser reward.
    pub const LESSER: u8 = 4;
}

/// The programme of a world.
struct Programme<'a> {
    config: &'a PointConfig,
    cell: f64,
    sizes: Sizes,
    axes: [Axis; 2],
    /// The one or two cells of y' in which a shifted box lies that is grown by half a box, along an axis; counted with the
    /// border.
    shifted: Vec<[usize; 2]>,
    /// Weights of the noise, by boxes from a node to a cell of y' shifted by half a box.
    weights: Vec<f32>,
    /// By box beyond the cell of y along one axis: how many boxes beyond it the push reaches along the other; `None`
    /// where it does not reach the box.
    reaches: Vec<Option<usize>>,
    /// What steps end in, by cell of p; empty where none does.
    codes: Vec<Vec<u8>>,
    /// What a cell of p lies in wholly.
    inside: Vec<Option<f64>>,
}

impl<'a> Programme<'a> {
    fn new(config: &'a PointConfig, cell: f64, threads: usize) -> Self {
        let rho = config.velocity_retention;
        let kappa = reach(config) / (1.0 - rho);
        let sizes = Sizes::new(config, cell, kappa);
        let axes = [0, 1].map(|axis| Axis::new(config, axis, cell, sizes));
        let side = cell / FINER as f64;
        let deviation = kappa * config.noise;
        let tails = sizes.tails as i64;
        let below = |boxes: i64| {
            let place = boxes as f64 * side;
            if deviation > 0.0 {
                normal::below(place / deviation)
            } else {
                // All of the noise is 0: on the border of two boxes, half for each.
                0.5 * (1.0 + (boxes as f64).signum())
            }
        };
        let weights = (-tails..tails)
            .map(|box_| ((below(box_ + 1) - below(box_)) * (1.0 - MARGIN)) as f32)
            .collect();
        let push = kappa * config.acceleration / side;
        let reaches = (0..=sizes.push)
            .map(|beyond| {
                let gap = beyond.saturating_sub(1) as f64;
                // Boxes with (their own gap)^2 + gap^2 <= push^2.
                (gap <= push).then(|| (push * push - gap * gap).sqrt().floor() as usize + 1)
            })
            .collect();
        let first = -((sizes.band * FINER + sizes.push + sizes.tails) as i64);
        let shifted = (0..sizes.noisy as i64).map(|box_| {
            // Grown it is this box and the next.
            [first + box_, first + box_ + 1].map(|box_| {
                let cell = box_.div_euclid(FINER as i64) + sizes.far as i64;
                (cell + 1).clamp(0, sizes.far_row() as i64 + 1) as usize
            })
        });
        let mut programme = Programme {
            config,
            cell,
            sizes,
            axes,
            shifted: shifted.collect(),
            weights,
            reaches,
            codes: Vec::new(),
            inside: Vec::new(),
        };
        let cells = programme.cells();
        programme.inside = (0..cells).map(|place| programme.lies_in(place)).collect();
        programme.codes = in_parallel(cells, threads, |place| programme.codes_of(place));
        programme
    }

    fn cells(&self) -> usize {
        self.axes[0].cells * self.axes[1].cells
    }

    fn place(&self, index: usize) -> [usize; 2] {
        [index / self.axes[1].cells, index % self.axes[1].cells]
    }

    /// The middle of a cell of p.
    fn middle(&self, index: usize) -> [f64; 2] {
        let place = self.place(index);
        [0, 1].map(|axis| self.axes[axis].low + (place[axis] as f64 + 0.5) * self.cell)
    }

    /// Lava, as the box in which the centre of the disc touches it, from two sides; smaller by `less` on each.
    fn lava(&self, less: f64) -> impl Iterator<Item = Rectangle> + '_ {
        let r = self.config.radius;
        self.config.lava().flat_map(move |Rectangle { min, max }| {
            [[r, 0.0], [0.0, r]].map(|grown| Rectangle {
                min: [0, 1].map(|axis| min[axis] - grown[axis] + less),
                max: [0, 1].map(|axis| max[axis] + grown[axis] - less),
            })
        })
    }

    /// The reward of what every point of a cell is in, so that no episode runs on there.
    fn lies_in(&self, index: usize) -> Option<f64> {
        let (middle, half) = (self.middle(index), self.cell / 2.0);
        let lava = self.lava(half).any(|lava| holds(lava, middle));
        let smaller = |Rectangle { min, max }: Rectangle| Rectangle {
            min: min.map(|c| c + half),
            max: max.map(|c| c - half),
        };
        let goal = self.config.goals().find(|(goal, _)| holds(smaller(*goal), middle));
        if lava { Some(self.config.lava_reward) } else { goal.map(|(_, reward)| reward) }
    }

    fn codes_of(&self, index: usize) -> Vec<u8> {
        let Sizes { far, .. } = self.sizes;
        if self.inside[index].is_some() {
            return Vec::new();
        }
        let (from, half) = (self.middle(index), self.cell / 2.0);
        let rho = self.config.velocity_retention;
        let room =
            [0, 1].map(|axis| [self.axes[axis].low, self.config.arena[axis] - self.config.radius]);
        let mut codes = Vec::with_capacity((2 * far + 1) * (2 * far + 1));
        let steps = || -(far as i64)..=far as i64;
        for dx in steps() {
            for dy in steps() {
                let goes_to: [f64; 2] = std::array::from_fn(|axis| {
                    from[axis] + (1.0 - rho) * [dx, dy][axis] as f64 * self.cell
                });
                let clear = (0..2).all(|axis| {
                    goes_to[axis] - half >= room[axis][0] && goes_to[axis] + half <= room[axis][1]
                });
                let to: [f64; 2] = std::array::from_fn(|axis| {
                    let [low, high] = room[axis];
                    goes_to[axis].min(high - half).max(low + half)
                });
                // From where to where the path certainly leads: as a whole in free flight, its end at a wall.
                let sure = if clear { from } else { to };
                let mut code = 0;
                if self.lava(half).any(|lava| crosses(lava, sure, to)) {
                    code |= code::LAVA;
                }
                for (goal, reward) in self.config.goals() {
                    let near = Rectangle {
                        min: goal.min.map(|c| c - half),
                        max: goal.max.map(|c| c + half),
                    };
                    let meets = if clear {
                        crosses(near, from, to)
                    } else {
                        // Somewhere in the box of both ends.
                        (0..2).all(|axis| {
                            from[axis].min(to[axis]) <= near.max[axis]
                                && from[axis].max(to[axis]) >= near.min[axis]
                        })
                    };
                    if meets {
                        let lesser = reward != self.config.goal_reward;
                        code |= if lesser { code::LESSER } else { code::GOAL };
                    }
                }
                codes.push(code);
            }
        }
        if codes.iter().all(|&code| code == 0) { Vec::new() } else { codes }
    }

    /// Lower bounds of the least E (w - J)^+ for thresholds w that descend by the cost of a step.
    fn shortfalls(&self, thresholds: &[f64], threads: usize, done: &dyn Fn(f64)) -> Vec<f64> {
        let (cost, horizon) = (self.config.step_cost, self.config.horizon as usize);
        let square = self.sizes.row() * self.sizes.row();
        let [first, last] = [thresholds[0], thresholds[thresholds.len() - 1]];
        // b at the time T of the lowest threshold; from there on an episode may be over.
        let over = last + horizon as f64 * cost - 1e-9;
        let at_limit = (first + horizon as f64 * cost).max(0.0);
        let mut later = vec![at_limit as f32; self.inside.len() * square];
        let mut now = vec![0.0_f32; later.len()];
        let mut found = Vec::with_capacity(thresholds.len());
        let steps = horizon + thresholds.len() - 1;
        for step in 1..=steps {
            let b = first + (horizon as f64 - step as f64) * cost;
            let lacks = |reward: f64| (b - reward).max(0.0) as f32;
            let PointConfig { goal_reward, lesser_goal_reward, lava_reward, .. } = *self.config;
            let ends = [goal_reward, lesser_goal_reward, lava_reward].map(lacks);
            let stop = if b >= over { lacks(0.0) } else { f32::INFINITY };
            let queue = Mutex::new(now.chunks_mut(square).enumerate());
            std::thread::scope(|scope| {
                for _ in 0..threads {
                    scope.spawn(|| {
                        let mut work = Work::new(self.sizes);
                        loop {
                            let next =
                                queue.lock().expect("no worker panics with the queue").next();
                            let Some((index, now)) = next else { break };
                            if let Some(reward) = self.inside[index] {
                                // The episode ended in the step before, which led here.
                                now.fill(lacks(reward + cost));
                                continue;
                            }
                            let (later, work) = (&later[..], &mut work);
                            let programme = self;
                            widest(Cell { programme, index, ends, stop, later, now, work });
                        }
                    });
                }
            });
            std::mem::swap(&mut later, &mut now);
            if step >= horizon {
                found.push(self.at_start(&later));
            }
            done(step as f64 / steps as f64);
        }
        found
    }

    /// S of the start, at rest: the largest of all cells that it touches, since each is a bound.
    fn at_start(&self, values: &[f32]) -> f64 {
        let square = self.sizes.row() * self.sizes.row();
        let at_rest = |(x, y)| {
            let cell: usize = x * self.axes[1].cells + y;
            f64::from(values[cell * square + square / 2])
        };
        self.start().into_iter().map(at_rest).fold(0.0, f64::max)
    }

    /// Cells that the start may lie in.
    fn start(&self) -> Vec<(usize, usize)> {
        let touched = [0, 1].map(|axis| {
            let place = (self.config.start[axis] - self.axes[axis].low) / self.cell;
            let last = self.axes[axis].cells - 1;
            let first = ((place - 1e-9).floor().max(0.0) as usize).min(last);
            first..=((place + 1e-9).floor().max(0.0) as usize).min(last)
        });
        let [xs, ys] = touched;
        xs.flat_map(|x| ys.clone().map(move |y| (x, y))).collect()
    }
}

impl Axis {
    fn new(config: &PointConfig, axis: usize, cell: f64, sizes: Sizes) -> Axis {
        let Sizes { far, band, .. } = sizes;
        let low = config.radius;
        // The last cell may reach beyond the wall.
        let wall = (config.arena[axis] - 2.0 * low) / cell;
        let cells = ((wall - 1e-9).ceil() as usize).max(1);
        let rho = config.velocity_retention;
        let mut landings = Vec::with_capacity(cells * (2 * far + 1));
        for own in 0..cells as i64 {
            for offset in -(far as i64)..=far as i64 {
                let to = own + offset;
                // p' in cells, from the lower borders of both cells to the upper ones.
                let lowest = rho * own as f64 + (1.0 - rho) * to as f64;
                let (first, last) = ((lowest + 1e-9).floor(), (lowest + 1.0 - 1e-9).floor());
                let landing = |p: i64, y: i64| {
                    let away = y - p + band as i64;
                    let away = (0..=2 * band as i64).contains(&away).then_some(away as usize);
                    Landing { p: p as usize, away }
                };
                let end = cells as i64 - 1;
                let runs_on =
                    (first.max(0.0) as i64..=last.min(end as f64) as i64).map(|p| landing(p, to));
                // At a wall the disc is at rest.
                let left = (lowest < -1e-9).then(|| landing(0, 0));
                let right = (lowest + 1.0 > wall + 1e-9).then(|| landing(end, end));
                landings.push(runs_on.chain(left).chain(right).collect());
            }
        }
        Axis { cells, low, landings }
    }
}

fn holds(Rectangle { min, max }: Rectangle, point: [f64; 2]) -> bool {
    (0..2).all(|axis| min[axis] <= point[axis] && point[axis] <= max[axis])
}

/// Whether a straight path meets a rectangle; an empty one is met by none.
fn crosses(Rectangle { min, max }: Rectangle, from: [f64; 2], to: [f64; 2]) -> bool {
    let path = [to[0] - from[0], to[1] - from[1]];
    let empty = (0..2).any(|axis| min[axis] > max[axis]);
    !empty && time_to_box(from, path, min, max).is_some()
}

/// A list made by several threads.
fn in_parallel<T: Send>(count: usize, threads: usize, make: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let mut made: Vec<Option<T>> = (0..count).map(|_| None).collect();
    let queue = Mutex::new(made.iter_mut().enumerate());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                loop {
                    let next = queue.lock().expect("no worker panics with the queue").next();
                    let Some((index, place)) = next else { break };
                    *place = Some(make(index));
                }
            });
        }
    });
    made.into_iter().map(|made| made.expect("every index is made")).collect()
}

/// Work space of a thread.
struct Work {
    /// By cell of y' - p, with a border of zeros.
    landed: Vec<f32>,
    /// The least of two rows of it.
    rows: Vec<f32>,
    /// By shifted box of y'.
    noisy: Vec<f32>,
    /// Summed over the noise along one axis, and along both.
    half: Vec<f32>,
    means: Vec<f32>,
    /// Least of 2^k neighbours, by k.
    least: Vec<Vec<f32>>,
}

impl Work {
    fn new(sizes: Sizes) -> Work {
        let Sizes { noisy, means, wide_means, wide_noisy, .. } = sizes;
        let window = FINER + 2 * sizes.push;
        Work {
            landed: vec![0.0; (sizes.far_row() + 2) * (sizes.far_row() + 2)],
            rows: vec![0.0; sizes.far_row() + 2],
            noisy: vec![0.0; noisy * wide_noisy],
            half: vec![0.0; noisy * wide_means],
            means: vec![0.0; means * wide_means],
            least: vec![vec![0.0; means * wide_means]; window.ilog2() as usize],
        }
    }
}

/// One cell of p.
struct Cell<'a> {
    programme: &'a Programme<'a>,
    index: usize,
    /// What goals, lesser goals and lava lack.
    ends: [f32; 3],
    /// What the end of time lacks, where it may have come.
    stop: f32,
    /// S of the next step.
    later: &'a [f32],
    /// Receives S of this step.
    now: &'a mut [f32],
    work: &'a mut Work,
}

impl Loops for Cell<'_> {
    #[inline(always)]
    fn run(self) {
        let Cell { programme, index, ends, stop, later, now, work } = self;
        programme.land(index, ends, later, work);
        programme.shift(work);
        programme.smooth(work);
        programme.best(stop, now, work);
    }
}

impl Programme<'_> {
    /// The least that is lacking, by cell of y'.
    #[inline(always)]
    fn land(&self, index: usize, [goal, lesser, lava]: [f32; 3], later: &[f32], work: &mut Work) {
        let (far, row) = (self.sizes.far_row(), self.sizes.row());
        let [own_x, own_y] = self.place(index);
        let (square, cells_y) = (row * row, self.axes[1].cells);
        let [x, y] = &self.axes;
        for (i, landings_x) in x.landings[own_x * far..][..far].iter().enumerate() {
            let landed = &mut work.landed[(i + 1) * (far + 2) + 1..][..far];
            for (k, (least, landings_y)) in
                landed.iter_mut().zip(&y.landings[own_y * far..][..far]).enumerate()
            {
                let code = self.codes[index].get(i * far + k).copied().unwrap_or(0);
                *least = f32::INFINITY;
                if code & code::LAVA != 0 {
                    *least = lava;
                } else {
                    for x in landings_x {
                        for y in landings_y {
                            let lacks = if let (Some(dx), Some(dy)) = (x.away, y.away) {
                                later[(x.p * cells_y + y.p) * square + dx * row + dy]
                            } else {
                                0.0
                            };
                            *least = least.min(lacks);
                        }
                    }
                }
                if code & code::GOAL != 0 {
                    *least = least.min(goal);
                }
                if code & code::LESSER != 0 {
                    *least = least.min(lesser);
                }
            }
        }
    }

    /// From cells of y' to boxes shifted by half a box, each grown by half a box.
    #[inline(always)]
    fn shift(&self, work: &mut Work) {
        let Sizes { noisy, wide_noisy, .. } = self.sizes;
        let wide = self.sizes.far_row() + 2;
        for (&[a, b], out) in self.shifted.iter().zip(work.noisy.chunks_exact_mut(wide_noisy)) {
            let (a, b) = (&work.landed[a * wide..][..wide], &work.landed[b * wide..][..wide]);
            for ((least, a), b) in work.rows.iter_mut().zip(a).zip(b) {
                *least = a.min(*b);
            }
            for (out, &[c, d]) in out[..noisy].iter_mut().zip(&self.shifted) {
                *out = work.rows[c].min(work.rows[d]);
            }
        }
    }

    /// The mean over the noise, at every node of m.
    #[inline(always)]
    fn smooth(&self, work: &mut Work) {
        let Sizes { means, wide_means, wide_noisy, .. } = self.sizes;
        for (i, half) in work.half.chunks_exact_mut(wide_means).enumerate() {
            combine(half, means, &self.weights, &work.noisy, i * wide_noisy, 1);
        }
        for (i, row) in work.means.chunks_exact_mut(wide_means).enumerate() {
            combine(row, means, &self.weights, &work.half, i * wide_means, wide_means);
        }
    }

    /// The least over all pushes from all places of the cell of y.
    #[inline(always)]
    fn best(&self, stop: f32, now: &mut [f32], work: &mut Work) {
        let Sizes { means, wide_means, push, .. } = self.sizes;
        let row = self.sizes.row();
        let Work { means: nodes, least, .. } = work;
        for level in 0..least.len() {
            let (before, after) = least.split_at_mut(level);
            let from: &[f32] = before.last().map_or(nodes, |of| of);
            let span = 1 << level;
            for (to, from) in
                after[0].chunks_exact_mut(wide_means).zip(from.chunks_exact(wide_means))
            {
                for k in 0..means - span {
                    to[k] = from[k].min(from[k + span]);
                }
            }
        }
        now.fill(stop);
        for (i, now) in now.chunks_exact_mut(row).enumerate() {
            for beyond_x in 0..FINER + 2 * push {
                let beyond = if beyond_x < push {
                    push - beyond_x
                } else {
                    (beyond_x + 1).saturating_sub(push + FINER)
                };
                let Some(reach) = self.reaches[beyond] else { continue };
                let width = FINER + 2 * reach;
                let level = width.ilog2() as usize;
                let span = 1 << level;
                let nodes = &least[level - 1][(i * FINER + beyond_x) * wide_means..][..wide_means];
                let first = push - reach;
                for (k, now) in now.iter_mut().enumerate() {
                    let first = first + k * FINER;
                    *now = now.min(nodes[first].min(nodes[first + width - span]));
                }
            }
        }
    }
}

/// The side of cells by default, in m: as many as the default world has at 0.2 m, or as many as fit into memory. `None`
/// where there is no such bound: with walls inside the arena, without damping, and where not even few cells fit.
pub fn default_cell(config: &PointConfig) -> Option<f64> {
    if !config.walls.is_empty() || config.velocity_retention > MOST_RETENTION {
        return None;
    }
    let [width, height] = config.arena;
    let mut cell = super::rounded((width * height / 1750.0).sqrt());
    while bytes(config, cell) > super::MOST_GIBIBYTES * super::GIBIBYTE {
        cell = super::rounded(1.25 * cell);
    }
    (cell <= super::widest(config)).then_some(cell)
}

/// Bytes that the programme takes, roughly.
pub fn bytes(config: &PointConfig, cell: f64) -> f64 {
    let kappa = reach(config) / (1.0 - config.velocity_retention);
    let sizes = Sizes::new(config, cell, kappa);
    let cells = config.arena.map(|side| side / cell + 1.0);
    let square = |row: usize| (row as f64).powi(2);
    // S of two steps in single precision, and the codes of ends.
    cells[0] * cells[1] * (8.0 * square(sizes.row()) + square(sizes.far_row()))
}

/// Computes the bound of a world that has a [`default_cell`], on cells of this side, for gamma = 1. `watch` is told
/// the share that is done.
pub fn upper_bound(
    config: &PointConfig,
    cell: f64,
    threads: usize,
    watch: &dyn Watch,
) -> UpperBound {
    let programme = Programme::new(config, cell, threads);
    let (cost, horizon) = (config.step_cost, config.horizon as usize);
    let mut goals: Vec<f64> = config.goals().map(|(_, reward)| reward).collect();
    goals.sort_by(|a, b| b.total_cmp(a));
    goals.dedup();
    let ends = goals.iter().chain([&config.lava_reward]);
    let mut returns: Vec<f64> = ends
        .flat_map(|reward| (0..horizon).map(move |time| reward - cost * time as f64))
        .chain([-cost * horizon as f64])
        .collect();
    returns.sort_by(|a, b| b.total_cmp(a));
    let mut bound = UpperBound { cell, shortfalls: Vec::new(), returns };
    let blocks = if cost > 0.0 { horizon.div_ceil(BLOCK) } else { 1 };
    for (goal, &reward) in goals.iter().enumerate() {
        for block in 0..blocks {
            let first = block * BLOCK;
            let count = if cost > 0.0 { BLOCK.min(horizon - first) } else { 1 };
            let thresholds: Vec<f64> =
                (first..first + count).map(|k| reward - k as f64 * cost).collect();
            if thresholds[0] < bound.at(LEAST_ALPHA) {
                break;
            }
            let done = |share: f64| {
                let block = block as f64 + share;
                watch.done((goal as f64 + block / blocks as f64) / goals.len() as f64);
            };
            let lacking = programme.shortfalls(&thresholds, threads, &done);
            bound.shortfalls.extend(thresholds.into_iter().zip(lacking));
        }
    }
    watch.done(1.0);
    bound
}

#[cfg(test)]
mod tests {
    use super::*;
    use lava_envs::point::Force;
    use lava_envs::random::{Purpose, stream};
    use lava_envs::{Action as _, End, LavaPoint, Step, World};
    use nalgebra::Vector2;
    use rand::RngExt;
    use rand_distr::StandardNormal;

    /// Cells along an axis that a number of cells lies in: two at a border, to the world's rounding.
    fn cells(place: f64) -> Vec<i64> {
        let mut cells = vec![(place - 1e-4).floor() as i64, (place + 1e-4).floor() as i64];
        cells.dedup();
        cells
    }

    /// Every step of the physical world is one that the relaxation allows: to its cells, with its end.
    #[test]
    fn steps_of_the_world_are_steps_of_the_relaxation() {
        let paper = PointConfig::default();
        let another =
            PointConfig { velocity_retention: 0.7, noise: 2.5, acceleration: 4.0, ..paper.clone() };
        for (config, cell) in [(&paper, 0.2), (&paper, 0.13), (&another, 0.3)] {
            let programme = Programme::new(config, cell, 2);
            let rho = config.velocity_retention;
            let kappa = reach(config) / (1.0 - rho);
            let mut world = LavaPoint::new(config, 1).unwrap();
            let mut random = stream(3, Purpose::EvaluationActions, 0);
            let [mut goals, mut walls, mut lavas, mut runs] = [0; 4];
            for _ in 0..60_000 {
                let position: [f64; 2] = std::array::from_fn(|axis| {
                    random.random_range(config.radius..config.arena[axis] - config.radius)
                });
                let velocity: [f64; 2] = std::array::from_fn(|_| random.random_range(-3.0..3.0));
                world.place(0, position, velocity);
                if world.clearance(0) == 0.0
                    || config.goals().any(|(goal, _)| holds(goal, position))
                {
                    continue;
                }
                let action = Force::uniform(&mut random);
                let xi: [f64; 2] = std::array::from_fn(|_| random.sample(StandardNormal));
                let mean: [f64; 2] = std::array::from_fn(|axis| {
                    position[axis]
                        + kappa * (velocity[axis] + config.acceleration * action.on_disc()[axis])
                });
                let mut step = [Step::IDLE];
                world.apply(&[action], &[Vector2::from(xi)], &mut step);

                // The push reaches the box of the mean from the cell of y.
                let side = cell / FINER as f64;
                let beyond: [i64; 2] = std::array::from_fn(|axis| {
                    let y = position[axis] + kappa * velocity[axis];
                    let first = ((y - config.radius) / cell).floor() as i64 * FINER as i64;
                    let box_ = ((mean[axis] - config.radius) / side).floor() as i64 - first;
                    (-box_).max(box_ + 1 - FINER as i64).max(0)
                });
                let reach = programme.reaches.get(beyond[0] as usize).copied().flatten();
                assert!(reach.is_some_and(|reach| beyond[1] as usize <= reach), "{beyond:?}");

                // In each cell of p that the position is in, and of y' that the noise leads to.
                let own = [0, 1].map(|axis| ((position[axis] - config.radius) / cell) as usize);
                let index = own[0] * programme.axes[1].cells + own[1];
                let noisy: [f64; 2] =
                    std::array::from_fn(|axis| mean[axis] + kappa * config.noise * xi[axis]);
                let far = programme.sizes.far as i64;
                let offset: [i64; 2] = std::array::from_fn(|axis| {
                    ((noisy[axis] - config.radius) / cell).floor() as i64 - own[axis] as i64 + far
                });
                let row = programme.sizes.far_row();
                if offset.iter().any(|offset| !(0..row as i64).contains(offset)) {
                    continue;
                }
                let [i, k] = offset.map(|offset| offset as usize);
                let code = programme.codes[index].get(i * row + k).copied().unwrap_or(0);
                match step[0].end {
                    Some(End::Goal) => {
                        goals += 1;
                        assert_ne!(code & code::GOAL, 0, "{position:?} to {noisy:?}");
                    }
                    Some(End::Lava) => lavas += usize::from(code & code::LAVA != 0),
                    _ => {
                        runs += 1;
                        assert_eq!(code & code::LAVA, 0, "{position:?} to {noisy:?}");
                        assert_eq!(programme.inside[index], None);
                        let (p, v) = (world.position(0), world.velocity(0));
                        for axis in 0..2 {
                            let landings =
                                &programme.axes[axis].landings[own[axis] * row + [i, k][axis]];
                            let ps = cells((p[axis] - config.radius) / cell);
                            let ys = cells((p[axis] + kappa * v[axis] - config.radius) / cell);
                            let band = programme.sizes.band as i64;
                            let known = landings.iter().any(|landing| {
                                let y = |away: usize| landing.p as i64 + away as i64 - band;
                                ps.contains(&(landing.p as i64))
                                    && landing.away.is_none_or(|away| ys.contains(&y(away)))
                            });
                            assert!(known, "{position:?} to {p:?} {v:?}: {landings:?}");
                            walls += usize::from(v[axis].abs() < 1e-5);
                        }
                    }
                }
            }
            assert!(
                goals > 100 && walls > 1000 && lavas > 100 && runs > 30_000,
                "{goals} {walls} {lavas} {runs}"
            );
        }
    }

    /// With one step left all that counts is whether it enters the goal, whose probability with the push that is best, to the right, is known by quadrature.
    #[test]
    fn the_bound_of_one_step_comes_down_to_its_value() {
        let config = PointConfig {
            horizon: 1,
            arena: [3.0, 2.0],
            start: [1.4, 0.5],
            lava: Rectangle { min: [0.0, 1.5], max: [1.0, 2.0] },
            goal: Rectangle { min: [2.0, 0.0], max: [3.0, 1.0] },
            ..PointConfig::default()
        };
        let c = reach(&config);
        // The best push is to the right; the path enters the goal if it passes its side x = 2 above y = 1.
        let value = |push: f64| {
            let mean = c * config.acceleration * push;
            let deviation = c * config.noise;
            let steps = 4000;
            (0..steps)
                .map(|k| {
                    let z = -6.0 + 12.0 * (f64::from(k) + 0.5) / f64::from(steps);
                    let x = mean + deviation * z;
                    if x < 0.6 {
                        return 0.0;
                    }
                    // At the goal's side y must be within half a metre, at 0.6 / x of the way; y >= 0.1 at the wall.
                    let y = normal::below(0.5 * x / 0.6 / deviation);
                    normal::density(z) * 12.0 / f64::from(steps) * y
                })
                .sum::<f64>()
        };
        let probability = value(1.0);
        let truth = probability - (1.0 - probability) * config.step_cost;
        let bounds = [0.2, 0.1, 0.05].map(|cell| upper_bound(&config, cell, 2, &()).at(1.0));
        assert!(
            bounds[0] > bounds[1] && bounds[1] > bounds[2] && bounds[2] >= truth,
            "{bounds:?} {truth}"
        );
        assert!(bounds[2] < truth + 0.15, "{bounds:?} {truth}");
    }
}
