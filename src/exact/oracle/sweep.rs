//! The dynamic programme, backwards in time.
//!
//! With the utility u of the return (J itself, or -(w - J)^+), acc(t) the reward of t running steps
//! and R the reward of an end,
//!
//!   Q(x, y, v+, t)   = u(acc(t) + gamma^t R) if the step from (x, y) with v+ ends,
//!                      V(x', y', rho v+ or 0 at a wall, t + 1) if not, and V(., T) = u(acc(T));
//!   W(x, y, vbar, t) = E Q(x, y, vbar + sigma xi, t),                  xi ~ N(0, I);
//!   V(x, y, v, t)    = max over |u| <= 1 of W(x, y, v + A u, t).
//!
//! While an episode runs its accumulated reward is a function of t, so (s, t) suffices as a state.
//! V is interpolated linearly in position and as [`super::lattice`] says in velocity; W is a product of two
//! one-dimensional convolutions on the velocity lattice, which for smooth Q and dv <= sigma/2 is
//! accurate to many digits; the maximum is over the fixed actions of [`actions`], whose stencils are
//! the same at every node because the lattices of v and vbar are aligned.
//!
//! Work is split by columns of the position lattice, each of which reads the later V and writes its
//! own part: the result does not depend on the number of threads.

use super::lattice::{ENDINGS, Halves, Space, cubic, shares};
use crate::exact::watch::Watch;
use crate::game::columns::{Loops, widest};
use lava_envs::PointConfig;
use std::sync::Mutex;

/// What is maximised in expectation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Utility {
    /// J.
    Return,
    /// -(w - J)^+ for the threshold w.
    Shortfall(f64),
}

impl Utility {
    /// u(J).
    pub fn of(self, value: f64) -> f64 {
        match self {
            Utility::Return => value,
            Utility::Shortfall(threshold) => -(threshold - value).max(0.0),
        }
    }
}

/// Rewards as functions of time.
#[derive(Debug, Clone, PartialEq)]
pub struct Rewards {
    /// acc(t) of t running steps, for t = 0..=T.
    pub running: Vec<f64>,
    /// gamma^t for t = 0..=T.
    pub discount: Vec<f64>,
}

impl Rewards {
    /// The rewards of a world under gamma.
    pub fn new(config: &PointConfig, gamma: f64) -> Rewards {
        let (mut running, mut discount) = (vec![0.0], vec![1.0]);
        for t in 0..config.horizon as usize {
            running.push(running[t] - config.step_cost * discount[t]);
            discount.push(discount[t] * gamma);
        }
        Rewards { running, discount }
    }

    /// The return of an episode whose step at time t ends it with a reward.
    pub fn ending(&self, time: usize, reward: f64) -> f64 {
        self.running[time] + self.discount[time] * reward
    }
}

/// Rings of pushes: lengths, and directions on each.
pub type Rings = &'static [(f64, usize)];

/// The pushes that the DP of a controller maximises over.
pub const SWEPT: Rings = &[(1.0, 16), (0.5, 8), (0.0, 1)];

/// The pushes among which a controller chooses.
pub const PLAYED: Rings = &[(1.0, 32), (0.75, 16), (0.5, 12), (0.25, 6), (0.0, 1)];

/// Pushes on rings, as vectors u.
pub fn actions(rings: Rings) -> Vec<[f64; 2]> {
    let ring = |&(length, count): &(f64, usize)| {
        (0..count).map(move |k| {
            let angle = std::f64::consts::TAU * k as f64 / count as f64;
            [length * angle.cos(), length * angle.sin()]
        })
    };
    rings.iter().flat_map(ring).collect()
}

/// Cubic interpolation at v + A u, relative to the node of v.
struct Stencil {
    /// Offset of the first of four nodes of vbar.
    offset: [i64; 2],
    weights: [[f32; 4]; 2],
}

impl Stencil {
    /// Those of all pushes, with the same u_x one after the other.
    fn all(space: &Space, pushes: Rings) -> Vec<Stencil> {
        let mut pushes = actions(pushes);
        pushes.sort_by(|a, b| a[0].total_cmp(&b[0]));
        pushes.into_iter().map(|push| Stencil::new(space, push)).collect()
    }

    fn new(space: &Space, push: [f64; 2]) -> Stencil {
        let places = push.map(|u| u * space.config.acceleration / space.spacing);
        let below = places.map(f64::floor);
        Stencil {
            offset: below.map(|node| node as i64 - 1),
            weights: [0, 1].map(|axis| space.weights(places[axis] - below[axis])),
        }
    }
}

/// From the nodes of v to velocities rho v+: the first of four nodes, and their weights.
fn upsampling(space: &Space) -> Vec<(usize, [f32; 4])> {
    let (half, last) = (space.halves.before as f64, 2 * space.halves.before);
    (0..=2 * space.halves.plus)
        .map(|index| {
            let velocity = space.config.velocity_retention * space.plus(index);
            let place = (velocity / space.spacing + half).clamp(0.0, last as f64);
            let first = (place.floor() as usize).clamp(1, last - 2);
            let share = place - first as f64;
            // Beyond the outer stencils the cubic is continued, as far as the last node.
            (first - 1, space.weights(share))
        })
        .collect()
}

/// W for all times, and the value at the start.
#[derive(Debug, Clone)]
pub struct Swept {
    /// W by time, node, vbar_x, vbar_y; if not kept, only that of time 0.
    pub means: Vec<f32>,
    /// The largest E u(J) from the start, by interpolation; not certified.
    pub value: f64,
}

/// Operations that [`sweep`] takes, roughly.
pub fn cost(space: &Space, pushes: Rings) -> f64 {
    let count = |half: usize| 2.0 * half as f64 + 1.0;
    let Halves { before, mean, plus } = space.halves;
    let (before, mean, plus) = (count(before), count(mean), count(plus));
    let smoothing = space.kernel.len() as f64 * mean * (plus + mean);
    let maximum = 8.0 * actions(pushes).len() as f64 * before * before;
    let moving = 4.0 * plus * (before + 2.0 * plus);
    f64::from(space.config.horizon) * space.nodes() as f64 * (smoothing + maximum + moving)
}

/// Runs the programme, which maximises over these pushes. `keep` says whether W of all times is kept, as a controller needs it; `watch` is told
/// the share that is done.
pub fn sweep(
    space: &Space,
    rewards: &Rewards,
    utility: Utility,
    pushes: Rings,
    threads: usize,
    keep: bool,
    watch: &dyn Watch,
) -> Swept {
    let sizes = Sizes::of(space);
    let programme = Programme {
        space,
        sizes,
        stencils: Stencil::all(space, pushes),
        upsampling: upsampling(space),
        limited: space.blurs(),
        along_y: if space.blurs() {
            space.landings[1].iter().map(|landing| cubic(f64::from(landing.share))).collect()
        } else {
            Vec::new()
        },
    };
    let horizon = space.config.horizon as usize;
    let times = if keep { horizon } else { 1 };
    let nx = space.axes[0].nodes;
    let column = sizes.ny * sizes.mean * sizes.mean;
    let mut means = vec![0.0_f32; times * nx * column];
    let at_limit = utility.of(rewards.running[horizon]) as f32;
    let slab = sizes.plus * sizes.ny * sizes.plus;
    let mut later = vec![at_limit; nx * slab];
    let mut now = vec![0.0_f32; nx * slab];
    for time in (0..horizon).rev() {
        let config = &space.config;
        let ends = [config.lava_reward, config.goal_reward, config.lesser_goal_reward]
            .map(|reward| utility.of(rewards.ending(time, reward)) as f32);
        let place = if keep { time } else { 0 };
        let here = &mut means[place * nx * column..][..nx * column];
        let columns = here.chunks_mut(column).zip(now.chunks_mut(slab)).enumerate();
        let queue = Mutex::new(columns);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    let mut work = Work::new(sizes);
                    loop {
                        let next = queue.lock().expect("no worker panics with the queue").next();
                        let Some((x, (means, values))) = next else { break };
                        let (later, work) = (&later[..], &mut work);
                        let programme = &programme;
                        widest(Column { programme, x, ends, later, means, values, work });
                    }
                });
            }
        });
        std::mem::swap(&mut later, &mut now);
        watch.done((horizon - time) as f64 / horizon as f64);
    }
    let start = space.config.start;
    let [(x, fx), (y, fy)] = [0, 1].map(|axis| space.axes[axis].locate(start[axis]));
    let rest = space.halves.plus;
    let at =
        |x: usize, y: usize| f64::from(later[x * slab + (rest * sizes.ny + y) * sizes.plus + rest]);
    let low = at(x, y) * (1.0 - fy) + at(x, y + 1) * fy;
    let high = at(x + 1, y) * (1.0 - fy) + at(x + 1, y + 1) * fy;
    Swept { means, value: low * (1.0 - fx) + high * fx }
}

/// Interpolation that stays between the two middle values, from the weights of a cubic: a cubic where that is
/// so, and no overshoot beside a border (Bermejo and Staniforth 1992).
#[inline(always)]
fn limited([a, b, c, d]: [f32; 4], weights: [f32; 4]) -> f32 {
    let cubic = weights[0] * a + weights[1] * b + weights[2] * c + weights[3] * d;
    cubic.clamp(b.min(c), b.max(c))
}

/// Utilities of the ends at one time, by [`super::lattice::Ending`].
type Ends = [f32; ENDINGS];

/// Numbers that are computed at once: an arithmetic operation on an array of them is one on a vector register.
pub(super) const LANES: usize = 8;

#[derive(Debug, Clone, Copy)]
struct Sizes {
    ny: usize,
    before: usize,
    mean: usize,
    plus: usize,
    /// Lengths of the rows of Q, W and V in the work space: whole lanes, and what is read beyond.
    wide_plus: usize,
    wide_mean: usize,
    wide_before: usize,
}

impl Sizes {
    fn of(space: &Space) -> Sizes {
        let count = |half: usize| 2 * half + 1;
        let Halves { before, mean, plus } = space.halves;
        let (before, mean, plus) = (count(before), count(mean), count(plus));
        Sizes {
            ny: space.axes[1].nodes,
            before,
            mean,
            plus,
            wide_plus: plus.next_multiple_of(LANES) + LANES,
            wide_mean: mean.next_multiple_of(LANES) + LANES,
            wide_before: (before + 3).next_multiple_of(LANES) + LANES,
        }
    }
}

/// Work space of a thread.
struct Work {
    /// V at x', by y and vy.
    slab: Vec<f32>,
    /// Q by y, v+_x, v+_y.
    outcomes: Vec<f32>,
    /// Q smoothed in v+_y.
    half_smooth: Vec<f32>,
    /// W by vbar_x, vbar_y.
    means: Vec<f32>,
    /// V by v_x, v_y, and by v_y, v_x.
    values: Vec<f32>,
    turned: Vec<f32>,
    /// V by rho v+_y, v_x, and by v_x, rho v+_y.
    half_up: Vec<f32>,
    half_turned: Vec<f32>,
    /// W at v_x + A u_x, by v_x, vbar_y.
    rows: Vec<f32>,
    sums: Vec<f32>,
}

impl Work {
    fn new(sizes: Sizes) -> Work {
        let Sizes { ny, before, mean, plus, wide_plus, wide_mean, wide_before } = sizes;
        Work {
            slab: vec![0.0; ny * plus],
            outcomes: vec![0.0; ny * plus * wide_plus],
            half_smooth: vec![0.0; plus * wide_mean],
            means: vec![0.0; mean * wide_mean],
            values: vec![0.0; before * wide_before],
            turned: vec![0.0; before * wide_before],
            half_up: vec![0.0; plus * wide_before],
            half_turned: vec![0.0; before * wide_plus],
            rows: vec![0.0; before * wide_mean],
            sums: vec![0.0; wide_plus],
        }
    }
}

/// `sums[k] = sum_m weights[m] terms[first + m stride + k]` for `count` numbers, and for what fills their last lanes.
#[inline(always)]
pub(super) fn combine(
    sums: &mut [f32],
    count: usize,
    weights: &[f32],
    terms: &[f32],
    first: usize,
    stride: usize,
) {
    let (mut at, lanes) = (0, count.div_ceil(LANES));
    while at < lanes {
        let (sums, first) = (&mut sums[at * LANES..], first + at * LANES);
        at += match lanes - at {
            1 => combine_lanes::<1>(sums, weights, terms, first, stride),
            2 => combine_lanes::<2>(sums, weights, terms, first, stride),
            3 => combine_lanes::<3>(sums, weights, terms, first, stride),
            _ => combine_lanes::<4>(sums, weights, terms, first, stride),
        };
    }
}

#[inline(always)]
fn combine_lanes<const N: usize>(
    sums: &mut [f32],
    weights: &[f32],
    terms: &[f32],
    first: usize,
    stride: usize,
) -> usize {
    let mut own = [[0.0_f32; LANES]; N];
    for (m, weight) in weights.iter().enumerate() {
        let terms = &terms[first + m * stride..][..N * LANES];
        for (own, terms) in own.iter_mut().zip(terms.as_chunks::<LANES>().0) {
            for (sum, term) in own.iter_mut().zip(terms) {
                *sum += weight * term;
            }
        }
    }
    sums[..N * LANES].copy_from_slice(own.as_flattened());
    N
}

/// Writes the transpose of a matrix with `rows` rows of `columns` numbers.
#[inline(always)]
fn turn(
    from: &[f32],
    [rows, columns]: [usize; 2],
    from_stride: usize,
    to: &mut [f32],
    to_stride: usize,
) {
    for (k, to) in to.chunks_exact_mut(to_stride).take(columns).enumerate() {
        for (i, to) in to[..rows].iter_mut().enumerate() {
            *to = from[i * from_stride + k];
        }
    }
}

struct Programme<'a> {
    space: &'a Space,
    sizes: Sizes,
    stencils: Vec<Stencil>,
    upsampling: Vec<(usize, [f32; 4])>,
    /// Whether positions are interpolated by limited cubics.
    limited: bool,
    /// Weights of the cubics along y, by node and v+_y; empty without them.
    along_y: Vec<[f32; 4]>,
}

/// All nodes of one x.
struct Column<'a> {
    programme: &'a Programme<'a>,
    x: usize,
    ends: Ends,
    /// V of the next time, by x, v_x, y, v_y with v on rho times the lattice of v+.
    later: &'a [f32],
    /// Receives W of this time.
    means: &'a mut [f32],
    /// Receives V of this time.
    values: &'a mut [f32],
    work: &'a mut Work,
}

impl Loops for Column<'_> {
    #[inline(always)]
    fn run(self) {
        let Column { programme, x, ends, later, means, values, work } = self;
        let sizes = programme.sizes;
        let Sizes { ny, mean, plus, wide_plus, wide_mean, .. } = sizes;
        let space = programme.space;
        programme.outcomes(x, later, work);
        for y in 0..ny {
            let node = x * ny + y;
            let means = &mut means[y * mean * mean..][..mean * mean];
            if let Some(end) = space.stopped[node] {
                let value = ends[end as usize];
                means.fill(value);
                for i in 0..plus {
                    values[(i * ny + y) * plus..][..plus].fill(value);
                }
                continue;
            }
            let outcomes = &mut work.outcomes[y * plus * wide_plus..][..plus * wide_plus];
            let codes = space.events[node].chunks_exact(plus);
            for (row, codes) in outcomes.chunks_exact_mut(wide_plus).zip(codes) {
                for (outcome, &code) in row.iter_mut().zip(codes) {
                    if code != 0 {
                        let shares = shares(code);
                        let goes_on = 1.0 - shares[0] - shares[1] - shares[2];
                        *outcome *= goes_on;
                        for (share, end) in shares.iter().zip(ends) {
                            *outcome += end * share;
                        }
                    }
                }
            }
            smooth(&work.outcomes, y, &space.kernel, sizes, &mut work.half_smooth, &mut work.means);
            for (row, from) in means.chunks_exact_mut(mean).zip(work.means.chunks_exact(wide_mean))
            {
                row.copy_from_slice(&from[..mean]);
            }
            programme.best(work);
            programme.upsample(work, y, values);
        }
    }
}

impl Programme<'_> {
    /// Q of a column but for the ends, by y, v+_x, v+_y.
    #[inline(always)]
    fn outcomes(&self, x: usize, later: &[f32], work: &mut Work) {
        let Sizes { ny, plus, wide_plus, .. } = self.sizes;
        let nx = self.space.axes[0].nodes;
        let [along_x, along_y] = &self.space.landings;
        let size = ny * plus;
        for i in 0..plus {
            let landing = along_x[x * plus + i];
            let slab = |x: usize| &later[(x * plus + landing.velocity) * size..][..size];
            let (low, high) = (slab(landing.node), slab(landing.node + 1));
            if self.limited && 0 < landing.node && landing.node + 2 < nx {
                let (before, after) = (slab(landing.node - 1), slab(landing.node + 2));
                let weights = cubic(f64::from(landing.share));
                for (k, value) in work.slab.iter_mut().enumerate() {
                    *value = limited([before[k], low[k], high[k], after[k]], weights);
                }
            } else {
                for ((value, low), high) in work.slab.iter_mut().zip(low).zip(high) {
                    *value = low + landing.share * (high - low);
                }
            }
            for y in 0..ny {
                let outcomes = &mut work.outcomes[(y * plus + i) * wide_plus..][..plus];
                let landings = &along_y[y * plus..][..plus];
                for (k, (outcome, landing)) in outcomes.iter_mut().zip(landings).enumerate() {
                    let place = landing.node * plus + landing.velocity;
                    let (low, high) = (work.slab[place], work.slab[place + plus]);
                    *outcome = if self.limited && 0 < landing.node && landing.node + 2 < ny {
                        let (before, after) =
                            (work.slab[place - plus], work.slab[place + 2 * plus]);
                        limited([before, low, high, after], self.along_y[y * plus + k])
                    } else {
                        low + landing.share * (high - low)
                    };
                }
            }
        }
    }

    /// V = max over the actions of W at v + A u.
    #[inline(always)]
    fn best(&self, work: &mut Work) {
        let Sizes { before, mean, wide_mean, wide_before, .. } = self.sizes;
        let margin = (self.space.halves.mean - self.space.halves.before) as i64;
        let Work { means, values, rows, sums, .. } = work;
        values.fill(f32::NEG_INFINITY);
        let mut last = None;
        for Stencil { offset, weights: [across, along] } in &self.stencils {
            let [first_x, first_y] = offset.map(|offset| (offset + margin) as usize);
            // Along all of W: the next push may have the same u_x.
            if last.replace((first_x, across)) != Some((first_x, across)) {
                for (i, row) in rows.chunks_exact_mut(wide_mean).enumerate() {
                    let first = (i + first_x) * wide_mean;
                    combine(row, mean, across, means, first, wide_mean);
                }
            }
            for (i, values) in values.chunks_exact_mut(wide_before).enumerate() {
                combine(sums, before, along, rows, i * wide_mean + first_y, 1);
                let lanes = before.div_ceil(LANES);
                let values = values.as_chunks_mut::<LANES>().0[..lanes].iter_mut();
                for (values, here) in values.zip(sums.as_chunks::<LANES>().0) {
                    for (value, &here) in values.iter_mut().zip(here) {
                        *value = if here > *value { here } else { *value };
                    }
                }
            }
        }
    }

    /// From the lattice of v to velocities rho v+, into the column's part at y.
    #[inline(always)]
    fn upsample(&self, work: &mut Work, y: usize, up: &mut [f32]) {
        let Sizes { ny, before, plus, wide_plus, wide_before, .. } = self.sizes;
        let Work { values, turned, half_up, half_turned, sums, .. } = work;
        turn(values, [before, before], wide_before, turned, wide_before);
        for ((first, weights), half) in
            self.upsampling.iter().zip(half_up.chunks_exact_mut(wide_before))
        {
            combine(half, before, weights, turned, first * wide_before, wide_before);
        }
        turn(half_up, [plus, before], wide_before, half_turned, wide_plus);
        for (i, (first, weights)) in self.upsampling.iter().enumerate() {
            combine(sums, plus, weights, half_turned, first * wide_plus, wide_plus);
            up[(i * ny + y) * plus..][..plus].copy_from_slice(&sums[..plus]);
        }
    }
}

/// W from Q at y: Gaussian smoothing along both axes, from `plus`^2 to `mean`^2 velocities.
#[inline(always)]
fn smooth(
    outcomes: &[f32],
    y: usize,
    kernel: &[f32],
    sizes: Sizes,
    half: &mut [f32],
    means: &mut [f32],
) {
    let Sizes { mean, plus, wide_plus, wide_mean, .. } = sizes;
    for (i, half) in half.chunks_exact_mut(wide_mean).enumerate() {
        combine(half, mean, kernel, outcomes, (y * plus + i) * wide_plus, 1);
    }
    for (i, row) in means.chunks_exact_mut(wide_mean).enumerate() {
        combine(row, mean, kernel, half, i * wide_mean, wide_mean);
    }
}

/// W, on the square of nodes of vbar, from Q on that of v+.
pub fn smoothed(space: &Space, outcomes: &[f32]) -> Vec<f32> {
    let sizes = Sizes { ny: 1, ..Sizes::of(space) };
    let Sizes { mean, plus, wide_plus, wide_mean, .. } = sizes;
    let Work { outcomes: mut wide, mut half_smooth, mut means, .. } = Work::new(sizes);
    for (row, outcomes) in wide.chunks_exact_mut(wide_plus).zip(outcomes.chunks_exact(plus)) {
        row[..plus].copy_from_slice(outcomes);
    }
    smooth(&wide, 0, &space.kernel, sizes, &mut half_smooth, &mut means);
    means.chunks_exact(wide_mean).flat_map(|row| &row[..mean]).copied().collect()
}
