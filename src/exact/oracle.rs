//! The oracle of `lava-point`: a near-optimal controller, and what it certifiably attains.
//!
//! No exact solution is known of the continuous world. A dynamic programme over a lattice of position,
//! velocity and time gives a controller that is nearly optimal; its interpolated values are worth
//! nothing as yardsticks. The controller is therefore played in the physical world, and its CVaR with
//! its interval is the certificate: a lower bound on the best attainable CVaR_alpha(J), up to the
//! error of sampling.
//!
//! | step | file |
//! |---|---|
//! | the lattice, and one control step for a velocity after noise | [`lattice`] |
//! | the programme: smoothing over noise, maximum over pushes | [`mod@sweep`] |
//! | the controller, and scripted yardsticks | [`controller`] |
//! | episodes in the physical world | [`mod@play`] |
//! | what no policy can surpass | [`mod@upper_bound`] |
//!
//! # The risk level
//! As on the grid, the best CVaR is a search over thresholds w,
//!
//!   max_pi CVaR_alpha(J) = max_w { w - (1/alpha) min_pi E[(w - J)^+] },
//!
//! with w among the returns of episodes that end. The maximum over w is searched on a coarse lattice by
//! its interpolated value; on the fine lattice the best candidates are played, beside the best of some
//! scripts, and whoever has the best played CVaR is chosen. What certifies is another play of it, on
//! streams that had no part in the choice, so that the certificate is not biased by it.
//! At eta = 1 there is no threshold: J itself is maximised, and the mean is the certificate.
//!
//! # How good is it
//! The lattice fits the noise ([`Lattice::of`]). Its own value of the optimum is not certified, but a check:
//! [`Certified::doubt`] tells where it contradicts the certificate. A relaxation of the programme bounds the optimum from
//! above; [`Bracket`] has both.

pub mod controller;
pub mod lattice;
pub mod play;
pub mod sweep;
pub mod upper_bound;

use super::walk::Walk;
use super::watch::{Steps, Watch};
use super::{ExactError, require_eta};
use crate::files::{read_at_most, write_in_place};
use crate::game::returns::{NORMAL_95, ReturnLaw};
use controller::{Controller, Protagonist, Scripted};
use etcetera::base_strategy::{BaseStrategy as _, Xdg};
use lattice::Space;
use lava_envs::{ConfigError, End, PointConfig};
use play::{Played, play, walk};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};
use std::path::{Path, PathBuf};
use std::time::Instant;
use sweep::{PLAYED, Rewards, Rings, SWEPT, Utility, sweep};
use upper_bound::UpperBound;

/// Name of the world in certificates.
pub const NAME: &str = "lava-point";

/// Version of the method and of its file; certificates of other versions are computed again.
const VERSION: u32 = 2;

/// Version of the upper bound and of its file.
const BOUNDS_VERSION: u32 = 1;

/// Seed of the episodes that choose the threshold.
const SELECTION_SEED: u64 = 0x5e1e_c710;

/// Seed of an evaluation by default, and the number of its episodes that a certificate has step by step.
pub const WALKS_SEED: u64 = 0;
const WALKS: u64 = 6;

/// Seed of the episodes that certify.
const CERTIFYING_SEED: u64 = 0xce47_1f1e;

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum OracleError {
    /// The budget is out of range.
    #[error(transparent)]
    Exact(#[from] ExactError),
    /// The world's configuration is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The discount is out of range.
    #[error("gamma must lie in (0, 1], got {0}")]
    Gamma(f64),
    /// The lattice is out of range.
    #[error("the oracle's {field} = {value} is not allowed: {allowed}")]
    Lattice {
        /// Which number.
        field: &'static str,
        /// What it was.
        value: f64,
        /// What it may be.
        allowed: String,
    },
    /// The disc would have to be followed around walls.
    #[error(
        "the oracle knows no walls inside the arena; set env.lava-point.walls = [] or use another scene"
    )]
    Walls,
    /// The lattice needs too much memory.
    #[error("the oracle would take {gibibytes:.1} GiB, more than {MOST_GIBIBYTES}; {advice}")]
    TooLarge {
        /// What it would take.
        gibibytes: f64,
        /// What would fit.
        advice: String,
    },
}

/// Most memory of the table of a controller.
const MOST_GIBIBYTES: f64 = 2.5;

const GIBIBYTE: f64 = (1_u64 << 30) as f64;

/// Error of a programme in single precision, before it is divided by alpha.
const ROUNDING: f64 = 1e-5;

/// Who is played where no script is better.
const CONTROLLER: &str = "lattice";

/// Resolution of the programme.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lattice {
    /// Distance of position nodes in m; rounded so that the nodes reach from wall to wall.
    pub cell: f64,
    /// Distance of velocity nodes in m/s.
    pub velocity: f64,
}

impl Lattice {
    /// The lattice of a world. Its velocities are a third of the noise apart, but at least a fifth of the
    /// acceleration; its positions about as many as the default world's at 0.1 m, where nodes lie on the borders of
    /// its lava and goal, or as many as fit into memory.
    pub fn of(config: &PointConfig) -> Lattice {
        let [width, height] = config.arena;
        let mut fine = (width * height / 7000.0).sqrt();
        // A whole part of the radius, if it is about that or less: borders at whole metres then have nodes.
        let parts = config.radius / fine;
        if parts > 0.7 {
            fine = config.radius / parts.round();
        }
        let fine = fine.min(widest(config));
        let velocity = (config.noise / 3.0).max(config.acceleration / 5.0);
        let mut lattice =
            Lattice { cell: rounded(fine), velocity: if velocity > 0.0 { velocity } else { 1.0 } };
        while lattice.cell < widest(config)
            && Space::bytes(config, &lattice) > MOST_GIBIBYTES * GIBIBYTE
        {
            lattice.cell = rounded(1.25 * lattice.cell).min(widest(config));
        }
        lattice
    }

    /// The lattice on which thresholds are searched.
    fn coarse(self, config: &PointConfig) -> Lattice {
        Lattice { cell: (2.0 * self.cell).min(widest(config)), velocity: 1.5 * self.velocity }
    }

    fn check(self, config: &PointConfig) -> Result<(), OracleError> {
        let widest = widest(config);
        if !(self.cell > 0.0 && self.cell <= widest) {
            let allowed = format!("above 0 and at most {widest} m, a quarter of the shorter side");
            return Err(OracleError::Lattice { field: "cell", value: self.cell, allowed });
        }
        // The window of a controller bounds one end; the other is where pushes and noise are lost between nodes.
        let finest = config.acceleration / 14.0;
        let coarsest = config.acceleration.max(config.noise);
        if !(self.velocity > finest && (self.velocity <= coarsest || coarsest == 0.0)) {
            let allowed = format!(
                "above {finest:.4} m/s, a 14th of the acceleration, and at most {coarsest} m/s, the larger one of \
                 acceleration and noise"
            );
            return Err(OracleError::Lattice { field: "velocity", value: self.velocity, allowed });
        }
        Ok(())
    }
}

/// The largest distance of positions, a quarter of the shorter side.
fn widest(config: &PointConfig) -> f64 {
    config.arena[0].min(config.arena[1]) / 4.0
}

/// A positive number with two digits, for people.
fn rounded(number: f64) -> f64 {
    let unit = 10.0_f64.powf(number.log10().floor() - 1.0);
    (number / unit).round() * unit
}

/// How much is computed for a certificate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Effort {
    /// Resolution of the programme.
    pub lattice: Lattice,
    /// Episodes that certify.
    pub episodes: u64,
    /// Episodes that each candidate threshold plays for the choice.
    pub selection_episodes: u64,
    /// Candidates that are played for the choice.
    pub candidates: usize,
    /// Episodes of each scripted yardstick.
    pub baseline_episodes: u64,
    /// Threads; no number depends on it.
    #[serde(skip, default = "all_cores")]
    pub threads: usize,
}

fn all_cores() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get)
}

impl Effort {
    /// The effort by default, on the lattice of the world.
    pub fn of(config: &PointConfig) -> Self {
        Effort {
            lattice: Lattice::of(config),
            episodes: 250_000,
            selection_episodes: 100_000,
            candidates: 2,
            baseline_episodes: 20_000,
            threads: all_cores(),
        }
    }
}

/// What a scripted protagonist attains.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// Its name.
    pub name: String,
    /// Its mean return.
    pub mean: f64,
    /// Its CVaR_alpha.
    pub cvar: f64,
    /// Share of episodes that end in lava.
    pub lava_rate: f64,
    /// Share of episodes that reach the goal.
    pub goal_rate: f64,
}

impl Baseline {
    fn new(name: String, law: &ReturnLaw, alpha: f64) -> Baseline {
        Baseline {
            name,
            mean: law.mean(),
            cvar: law.cvar(alpha),
            lava_rate: law.probability(End::Lava),
            goal_rate: law.probability(End::Goal),
        }
    }
}

/// A certificate. Its [`Display`] is a readable page.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Certified {
    /// Name of the world.
    pub env: String,
    /// Budget.
    pub eta: f64,
    /// Risk level 1/eta.
    pub alpha: f64,
    /// Discount per step.
    pub gamma: f64,
    /// Played mean of J.
    pub certified_mean: f64,
    /// Lower end of its 95 % interval.
    pub certified_mean_lo: f64,
    /// Upper end of its 95 % interval.
    pub certified_mean_hi: f64,
    /// Played CVaR_alpha of J; at eta = 1 the mean.
    pub certified_cvar: f64,
    /// Lower end of its 95 % interval.
    pub certified_cvar_lo: f64,
    /// Upper end of its 95 % interval.
    pub certified_cvar_hi: f64,
    /// Share of episodes that end in lava.
    pub lava_rate: f64,
    /// Share of episodes that reach the goal.
    pub goal_rate: f64,
    /// Share of episodes that reach the time limit.
    pub timeout_rate: f64,
    /// Mean y in m at which episodes first pass the middle of the arena in x (x = 5 by default).
    pub crossing_y: Option<f64>,
    /// Who attains it: `lattice`, the controller of the programme, or the name of a script that is better.
    pub controller: String,
    /// Threshold w of the controller; `None` at eta = 1 and for a script.
    pub threshold: Option<f64>,
    /// The programme's own, interpolated value of the optimum: not certified. What more pushes would add to it
    /// is taken from a coarse lattice.
    pub lattice_value: f64,
    /// How far that may be from the truth: what it differs by on a lattice of twice the cell and 1.5 times the
    /// distance of velocities, what more pushes add, rounding, and where noise is so small that returns are
    /// a matter of whole steps, one step's cost.
    pub lattice_error: f64,
    /// Resolution of the programme.
    pub lattice: Lattice,
    /// Nodes in x, y, v_x, v_y.
    pub lattice_nodes: [usize; 4],
    /// Episodes that certify.
    pub episodes: u64,
    /// Scripted protagonists in the same world.
    pub baselines: Vec<Baseline>,
    /// Seconds that the computation took.
    pub seconds: f64,
    /// The law of J over the certifying episodes.
    pub law: ReturnLaw,
    /// The first episodes of an evaluation with the seed [`WALKS_SEED`].
    #[serde(default)]
    pub walks: Vec<Walk>,
}

/// The certificate of a world. `watch` is told how far it is.
///
/// # Errors
/// If an argument is out of range.
pub fn certify(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
    watch: &dyn Watch,
) -> Result<Certified, OracleError> {
    let began = Instant::now();
    let alpha = check(config, gamma, eta, effort)?;
    let problem = Problem { config, gamma, alpha, effort, rewards: Rewards::new(config, gamma) };
    let space = Space::new(config, &effort.lattice, problem.threads());
    let coarse = Space::new(config, &effort.lattice.coarse(config), problem.threads());
    let thresholds = problem.thresholds();
    let mut steps = Steps::new(watch, problem.cost(&coarse, &space, thresholds.len()));

    let ranked = rank(&thresholds, |threshold| {
        let step = steps.next(sweep::cost(&coarse, SWEPT));
        problem.value_on(&coarse, threshold, SWEPT, &step)
    });
    let passed_over = looks(thresholds.len()).saturating_sub(ranked.len());
    steps.next(passed_over as f64 * sweep::cost(&coarse, SWEPT)).done(1.0);
    let (coarse_value, threshold) = ranked[0];
    let step = steps.next(sweep::cost(&coarse, PLAYED));
    let more_pushes = problem.value_on(&coarse, threshold, PLAYED, &step) - coarse_value;
    drop(coarse);

    let scripts = Scripted::all(config);
    let mut baselines = Vec::new();
    for scripted in &scripts {
        let step = steps.next(problem.playing(effort.baseline_episodes));
        let law = problem.play(scripted, effort.baseline_episodes, CERTIFYING_SEED, &step)?.law;
        baselines.push(Baseline::new(scripted.name(), &law, alpha));
    }

    // The best script, then the controllers, one table at a time.
    let script = (0..scripts.len())
        .max_by(|&a, &b| baselines[a].cvar.total_cmp(&baselines[b].cvar))
        .expect("there are scripts");
    let mut selection = problem.select(&scripts[script], &mut steps)?;
    let (mut best, mut walks) = (None, None);
    let mut chosen = (baselines[script].name.clone(), None);
    let mut lattice_value = f64::NEG_INFINITY;
    for &(_, threshold) in ranked.iter().take(effort.candidates.max(1)) {
        let utility = threshold.map_or(Utility::Return, Utility::Shortfall);
        let step = steps.next(sweep::cost(&space, SWEPT));
        let controller =
            Controller::new(space.clone(), &problem.rewards, utility, problem.threads(), &step);
        lattice_value = lattice_value.max(problem.risk(threshold, controller.value()));
        let selected = problem.select(&controller, &mut steps)?;
        if selected >= selection {
            selection = selected;
            best = Some(problem.certify(&controller, &mut steps)?);
            walks = Some(problem.walks(&controller)?);
            chosen = (CONTROLLER.to_owned(), threshold);
        } else {
            steps.next(problem.playing(effort.episodes)).done(1.0);
        }
    }
    let (mut best, mut walks) = match best.zip(walks) {
        Some(best) => best,
        None => (problem.certify(&scripts[script], &mut steps)?, problem.walks(&scripts[script])?),
    };

    // A script whose few episodes say that it is better is heard in as many.
    for (scripted, baseline) in scripts.iter().zip(&mut baselines) {
        if baseline.cvar > best.law.cvar(alpha) {
            let played = problem.play(scripted, effort.episodes, CERTIFYING_SEED, &())?;
            *baseline = Baseline::new(scripted.name(), &played.law, alpha);
            if baseline.cvar > best.law.cvar(alpha) {
                best = played;
                walks = problem.walks(scripted)?;
                chosen = (scripted.name(), None);
            }
        }
    }

    let Played { law, crossing_y, .. } = best;
    let mean = Interval::new(law.mean(), law.mean_standard_error());
    let cvar = if alpha == 1.0 {
        mean
    } else {
        Interval::new(law.cvar(alpha), law.cvar_standard_error(alpha))
    };
    let speeds = 2 * space.halves.before + 1;
    Ok(Certified {
        env: NAME.to_owned(),
        eta,
        alpha,
        gamma,
        certified_mean: mean.value,
        certified_mean_lo: mean.low,
        certified_mean_hi: mean.high,
        certified_cvar: cvar.value,
        certified_cvar_lo: cvar.low,
        certified_cvar_hi: cvar.high,
        lava_rate: law.probability(End::Lava),
        goal_rate: law.probability(End::Goal),
        timeout_rate: law.probability(End::Timeout),
        crossing_y,
        controller: chosen.0,
        threshold: chosen.1,
        lattice_value: lattice_value + more_pushes,
        lattice_error: (lattice_value - coarse_value).abs()
            + more_pushes
            + ROUNDING / alpha
            + if space.is_coarse() { config.step_cost } else { 0.0 },
        lattice: effort.lattice,
        lattice_nodes: [space.axes[0].nodes, space.axes[1].nodes, speeds, speeds],
        episodes: effort.episodes,
        baselines,
        seconds: began.elapsed().as_secs_f64(),
        law,
        walks,
    })
}

/// What is to be solved.
struct Problem<'a> {
    config: &'a PointConfig,
    gamma: f64,
    alpha: f64,
    effort: &'a Effort,
    rewards: Rewards,
}

impl Problem<'_> {
    fn threads(&self) -> usize {
        self.effort.threads.max(1)
    }

    /// The returns of all episodes that end, ascending, as thresholds; at alpha = 1 there is none.
    fn thresholds(&self) -> Vec<Option<f64>> {
        if self.alpha == 1.0 {
            return vec![None];
        }
        let horizon = self.config.horizon as usize;
        let mut ends = vec![self.config.goal_reward, self.config.lava_reward];
        if !self.config.lesser_goals.is_empty() {
            ends.push(self.config.lesser_goal_reward);
        }
        let mut all: Vec<f64> = (0..horizon)
            .flat_map(|time| ends.iter().map(move |&reward| (time, reward)))
            .map(|(time, reward)| self.rewards.ending(time, reward))
            .collect();
        all.push(self.rewards.running[horizon]);
        all.sort_by(f64::total_cmp);
        all.dedup_by(|a, b| (*a - *b).abs() < 1e-12);
        all.into_iter().map(Some).collect()
    }

    /// CVaR_alpha for an expected utility; the mean return without a threshold.
    fn risk(&self, threshold: Option<f64>, value: f64) -> f64 {
        threshold.map_or(value, |w| w + value / self.alpha)
    }

    /// What the programme gives a threshold on a lattice, by interpolation.
    fn value_on(
        &self,
        space: &Space,
        threshold: Option<f64>,
        pushes: Rings,
        watch: &dyn Watch,
    ) -> f64 {
        let utility = threshold.map_or(Utility::Return, Utility::Shortfall);
        let swept = sweep(space, &self.rewards, utility, pushes, self.threads(), false, watch);
        self.risk(threshold, swept.value)
    }

    fn play(
        &self,
        protagonist: &dyn Protagonist,
        episodes: u64,
        seed: u64,
        watch: &dyn Watch,
    ) -> Result<Played, ConfigError> {
        play(self.config, self.gamma, protagonist, episodes, seed, self.threads(), watch)
    }

    /// The CVaR_alpha of a protagonist over the episodes that choose.
    fn select(
        &self,
        protagonist: &dyn Protagonist,
        steps: &mut Steps<'_>,
    ) -> Result<f64, ConfigError> {
        let episodes = self.effort.selection_episodes;
        let step = steps.next(self.playing(episodes));
        let played = self.play(protagonist, episodes, SELECTION_SEED, &step)?;
        Ok(played.law.cvar(self.alpha))
    }

    /// The episodes that certify a protagonist.
    fn certify(
        &self,
        protagonist: &dyn Protagonist,
        steps: &mut Steps<'_>,
    ) -> Result<Played, ConfigError> {
        let episodes = self.effort.episodes;
        let step = steps.next(self.playing(episodes));
        self.play(protagonist, episodes, CERTIFYING_SEED, &step)
    }

    /// A few episodes of a protagonist, step by step.
    fn walks(&self, protagonist: &dyn Protagonist) -> Result<Vec<Walk>, ConfigError> {
        let walk = |index| walk(self.config, self.gamma, protagonist, WALKS_SEED, index);
        (0..WALKS).map(walk).collect()
    }

    /// Cost of playing, in the unit of [`sweep::cost`]: half an episode of a controller and of the engine.
    fn playing(&self, episodes: u64) -> f64 {
        let step = 1e4 + 5e2 * f64::from(self.config.substeps);
        episodes as f64 * 0.5 * f64::from(self.config.horizon) * step
    }

    /// Cost of everything.
    fn cost(&self, coarse: &Space, fine: &Space, thresholds: usize) -> f64 {
        let Effort { candidates, selection_episodes, episodes, baseline_episodes, .. } =
            *self.effort;
        let candidates = candidates.clamp(1, thresholds) as f64;
        let scripts = Scripted::all(self.config).len() as u64;
        looks(thresholds) as f64 * sweep::cost(coarse, SWEPT)
            + sweep::cost(coarse, PLAYED)
            + candidates * sweep::cost(fine, SWEPT)
            + candidates * self.playing(selection_episodes + episodes)
            + self.playing(selection_episodes)
            + self.playing(scripts * baseline_episodes)
    }
}

#[derive(Debug, Clone, Copy)]
struct Interval {
    value: f64,
    low: f64,
    high: f64,
}

impl Interval {
    fn new(value: f64, standard_error: f64) -> Interval {
        let half = NORMAL_95 * standard_error;
        Interval { value, low: value - half, high: value + half }
    }
}

fn check(config: &PointConfig, gamma: f64, eta: f64, effort: &Effort) -> Result<f64, OracleError> {
    config.validate()?;
    if !config.walls.is_empty() {
        return Err(OracleError::Walls);
    }
    let alpha = require_eta(eta)?;
    if !(gamma > 0.0 && gamma <= 1.0) {
        return Err(OracleError::Gamma(gamma));
    }
    effort.lattice.check(config)?;
    for (field, episodes) in
        [("episodes", effort.episodes), ("selection_episodes", effort.selection_episodes)]
    {
        if episodes == 0 {
            let allowed = "at least 1".to_owned();
            return Err(OracleError::Lattice { field, value: 0.0, allowed });
        }
    }
    let gibibytes = Space::bytes(config, &effort.lattice) / GIBIBYTE;
    if gibibytes > MOST_GIBIBYTES {
        let Lattice { cell, velocity } = Lattice::of(config);
        let fits = Space::bytes(config, &Lattice::of(config)) <= MOST_GIBIBYTES * GIBIBYTE;
        let advice = if fits && effort.lattice != Lattice::of(config) {
            format!("--cell {cell} --velocity {velocity} fits, and so does a shorter horizon")
        } else {
            "use a shorter horizon".to_owned()
        };
        return Err(OracleError::TooLarge { gibibytes, advice });
    }
    Ok(alpha)
}

/// How many thresholds [`rank`] looks at first.
const FIRST_LOOKS: usize = 12;

/// The distance of the thresholds that [`rank`] looks at first, a power of two.
fn first_stride(thresholds: usize) -> usize {
    thresholds.div_ceil(FIRST_LOOKS).next_power_of_two()
}

/// How many thresholds [`rank`] looks at, at most.
fn looks(thresholds: usize) -> usize {
    let stride = first_stride(thresholds);
    thresholds.div_ceil(stride) + 1 + 2 * stride.ilog2() as usize
}

/// The thresholds that were looked at, with their values, best first: some over the whole range, and then ever
/// closer ones around the best. A threshold w below the two best values so far is passed over: its own is at most w,
/// since a shortfall is never negative.
fn rank(
    thresholds: &[Option<f64>],
    mut value: impl FnMut(Option<f64>) -> f64,
) -> Vec<(f64, Option<f64>)> {
    let last = thresholds.len() - 1;
    let mut known: BTreeMap<usize, f64> = BTreeMap::new();
    let [mut best, mut second] = [f64::NEG_INFINITY; 2];
    let mut look = |index: usize, known: &mut BTreeMap<usize, f64>| {
        let hopeless = thresholds[index].is_some_and(|w| w < second);
        if hopeless || known.contains_key(&index) {
            return;
        }
        let found = value(thresholds[index]);
        known.insert(index, found);
        second = second.max(found.min(best));
        best = best.max(found);
    };
    let mut stride = first_stride(thresholds.len());
    look(last, &mut known);
    (0..last).step_by(stride).rev().for_each(|index| look(index, &mut known));
    while stride > 1 {
        stride /= 2;
        let (&best, _) = (known.iter().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(a.0))))
            .expect("the first look has values");
        look(best.saturating_sub(stride), &mut known);
        look((best + stride).min(last), &mut known);
    }
    let mut ranked: Vec<(f64, usize)> = known.into_iter().map(|(index, v)| (v, index)).collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.into_iter().map(|(value, index)| (value, thresholds[index])).collect()
}

/// The user's cache folder of certificates by the XDG specification; `None` for a user without a home.
pub fn cache_folder() -> Option<PathBuf> {
    let base = Xdg::new().ok()?.cache_dir();
    base.is_absolute().then(|| base.join("cvar-game").join("oracle"))
}

/// All that a certificate depends on.
#[derive(Serialize)]
struct Key<'a> {
    version: u32,
    world: &'a PointConfig,
    gamma: f64,
    eta: f64,
    effort: &'a Effort,
}

/// Most bytes of a certificate on disk; that of the default world has a hundredth.
const LARGEST_ENTRY: u64 = 1 << 26;

/// What is kept on disk.
#[derive(Serialize, Deserialize)]
struct Entry<T> {
    key: String,
    certified: T,
}

/// The certificates that come with the program: those of the default world at the paper's budgets,
/// computed by it (`cvar-game exact --env lava-point --eta E --anew`).
const SHIPPED: &str = include_str!("../../configs/oracle.json");

/// The certificate that comes with the program, if there is one of just these arguments. Tables show
/// regret against it without computing for minutes, and the same on every machine.
pub fn shipped(config: &PointConfig, gamma: f64, eta: f64, effort: &Effort) -> Option<Certified> {
    let key = key(config, gamma, eta, effort);
    let entries: Vec<Entry<Certified>> =
        serde_json::from_str(SHIPPED).expect("a test reads the file");
    entries.into_iter().find(|entry| entry.key == key).map(|entry| entry.certified)
}

/// As [`certify`], but looks among the shipped certificates and into a folder first, and leaves a new
/// certificate there. A file that does not fit is computed anew and replaced.
///
/// # Errors
/// If an argument is out of range.
pub fn certify_cached(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
    folder: &Path,
    watch: &dyn Watch,
) -> Result<Certified, OracleError> {
    if let Some(certified) = shipped(config, gamma, eta, effort) {
        return Ok(certified);
    }
    match kept(&key(config, gamma, eta, effort), folder) {
        Some(certified) => Ok(certified),
        None => certify_anew(config, gamma, eta, effort, folder, watch),
    }
}

/// As [`certify`], and leaves the certificate in a folder for [`certify_cached`]. Where that cannot be
/// done `watch` is told why: the certificate is not lost.
///
/// # Errors
/// If an argument is out of range.
pub fn certify_anew(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
    folder: &Path,
    watch: &dyn Watch,
) -> Result<Certified, OracleError> {
    let certified = certify(config, gamma, eta, effort, watch)?;
    Ok(keep(key(config, gamma, eta, effort), certified, folder, watch))
}

/// What a folder has under a key; a file that does not fit is nothing.
fn kept<T: DeserializeOwned>(key: &str, folder: &Path) -> Option<T> {
    let bytes = read_at_most(&file_of(key, folder), LARGEST_ENTRY).ok()?;
    let entry = serde_json::from_slice::<Entry<T>>(&bytes).ok()?;
    (entry.key == key).then_some(entry.certified)
}

/// Leaves something under a key in a folder. Where that cannot be done `watch` is told why: it is not lost.
fn keep<T: Serialize + DeserializeOwned>(
    key: String,
    certified: T,
    folder: &Path,
    watch: &dyn Watch,
) -> T {
    let entry = Entry { key, certified };
    let path = file_of(&entry.key, folder);
    let text = serde_json::to_string(&entry).expect("a certificate has a JSON form");
    let kept =
        std::fs::create_dir_all(folder).and_then(|()| write_in_place(&path, text.as_bytes()));
    if let Err(error) = kept {
        watch.note(&format!(
            "the answer is not kept for the next time: cannot write {}: {error}; set XDG_CACHE_HOME to a folder \
             that can be written to",
            path.display()
        ));
    }
    // Reading rounds the last bit of some numbers: all callers get the same ones, the first too.
    let Entry { certified, .. } =
        serde_json::from_str::<Entry<T>>(&text).expect("its own form is read");
    certified
}

/// The upper bounds that come with the program: those of its scenes (`cvar-game exact --env lava-point/SCENE --eta 1
/// --upper-cell M`).
const SHIPPED_BOUNDS: &str = include_str!("../../configs/upper-bounds.json");

/// All that an upper bound depends on, but for the side of its cells.
#[derive(Serialize)]
struct BoundKey<'a> {
    version: u32,
    world: &'a PointConfig,
}

/// The upper bound that comes with the program, if there is one of this world, for gamma = 1.
pub fn shipped_bound(world: &PointConfig) -> Option<UpperBound> {
    let entries: Vec<Entry<UpperBound>> =
        serde_json::from_str(SHIPPED_BOUNDS).expect("a test reads the file");
    let key = bound_key(world);
    entries.into_iter().find(|entry| entry.key == key).map(|entry| entry.certified)
}

fn bound_key(world: &PointConfig) -> String {
    let key = BoundKey { version: BOUNDS_VERSION, world };
    serde_json::to_string(&key).expect("numbers have a JSON form")
}

/// The upper bound of a world, for gamma = 1, on cells of this side in m, or of the side that comes with the program or by
/// default. It is looked for in a folder first, if there is one, and left there. `None` where there is no bound.
///
/// # Errors
/// If the side is out of range.
pub fn bound_cached(
    world: &PointConfig,
    cell: Option<f64>,
    folder: Option<&Path>,
    watch: &dyn Watch,
) -> Result<Option<UpperBound>, OracleError> {
    let Some(default) = upper_bound::default_cell(world) else { return Ok(None) };
    if let (None, Some(bound)) = (cell, shipped_bound(world)) {
        return Ok(Some(bound));
    }
    let cell = cell.unwrap_or(default);
    if !(cell > 0.0 && cell <= widest(world)) {
        let allowed =
            format!("above 0 and at most {} m, a quarter of the shorter side", widest(world));
        return Err(OracleError::Lattice { field: "upper-cell", value: cell, allowed });
    }
    let gibibytes = upper_bound::bytes(world, cell) / GIBIBYTE;
    if gibibytes > MOST_GIBIBYTES {
        let advice = format!("--upper-cell {default} fits");
        return Err(OracleError::TooLarge { gibibytes, advice });
    }
    let key = format!("{} {cell}", bound_key(world));
    if let Some(bound) = folder.and_then(|folder| kept(&key, folder)) {
        return Ok(Some(bound));
    }
    let bound = upper_bound::upper_bound(world, cell, all_cores(), watch);
    Ok(Some(match folder {
        Some(folder) => keep(key, bound, folder, watch),
        None => bound,
    }))
}

/// What is known of the best CVaR: a controller that attains it from below, and a bound from above.
#[derive(Debug, Clone, Serialize)]
pub struct Bracket {
    /// The certificate of the controller.
    #[serde(flatten)]
    pub certified: Certified,
    /// No policy has a CVaR above this; `None` where there is no bound.
    pub upper_bound: Option<f64>,
    /// Side of the cells of that bound in m.
    pub upper_cell: Option<f64>,
}

impl Bracket {
    /// Both ends.
    pub fn new(certified: Certified, bound: Option<&UpperBound>) -> Bracket {
        Bracket {
            upper_bound: bound.map(|bound| bound.at(certified.alpha)),
            upper_cell: bound.map(|bound| bound.cell),
            certified,
        }
    }
}

impl Display for Bracket {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.certified)?;
        if let (Some(bound), Some(cell)) = (self.upper_bound, self.upper_cell) {
            writeln!(
                f,
                "\nNo policy has a CVaR above {bound:.4}: the bound of a relaxation on cells of {cell} m. Smaller cells \
                 (--upper-cell) bring it down."
            )?;
        }
        Ok(())
    }
}

fn key(world: &PointConfig, gamma: f64, eta: f64, effort: &Effort) -> String {
    let key = Key { version: VERSION, world, gamma, eta, effort };
    serde_json::to_string(&key).expect("numbers have a JSON form")
}

fn file_of(key: &str, folder: &Path) -> PathBuf {
    folder.join(format!("{:016x}.json", fnv(key.as_bytes())))
}

/// FNV-1a; a file name, whose entry contains its whole key.
fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

impl Certified {
    /// Whether the two values of the optimum, the certified one and the lattice's own, contradict each other, in
    /// words: then the controller may be far from optimal. What is certified holds nevertheless.
    pub fn doubt(&self) -> Option<String> {
        let half = (self.certified_cvar_hi - self.certified_cvar_lo) / 2.0;
        let apart = (self.lattice_value - self.certified_cvar).abs();
        let allowed = self.lattice_error + 1.5 * half; // three standard errors
        (apart > allowed).then(|| {
            format!(
                "the lattice's own value is {apart:.4} from the certified one, more than both errors allow \
                 ({allowed:.4}); the best may be far above what is certified, and a finer lattice may find it \
                 (--cell, --velocity)"
            )
        })
    }
}

impl Display for Certified {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Certified { env, eta, alpha, gamma, .. } = self;
        writeln!(f, "{env}, budget eta = {eta}, so CVaR at alpha = {alpha:.4}, gamma = {gamma}\n")?;
        writeln!(f, "What the oracle's controller attains in the physical world:\n")?;
        let mut line = |label: &str, value: f64, low: f64, high: f64| {
            writeln!(f, "{label:<12}{value:>9.4}  [{low:.4}, {high:.4}]")
        };
        let Certified { certified_mean, certified_mean_lo, certified_mean_hi, .. } = self;
        let Certified { certified_cvar, certified_cvar_lo, certified_cvar_hi, .. } = self;
        line("CVaR", *certified_cvar, *certified_cvar_lo, *certified_cvar_hi)?;
        line("mean return", *certified_mean, *certified_mean_lo, *certified_mean_hi)?;
        let percent = |rate: f64| format!("{:.3} %", 100.0 * rate);
        writeln!(
            f,
            "\nlava {}, goal {}, timeout {}",
            percent(self.lava_rate),
            percent(self.goal_rate),
            percent(self.timeout_rate)
        )?;
        if let Some(y) = self.crossing_y {
            writeln!(f, "it passes the middle of the arena at y = {y:.2} on average")?;
        }
        if let Some(w) = self.threshold {
            writeln!(f, "threshold w = {w:.4}")?;
        }
        writeln!(
            f,
            "\nThe best attainable CVaR is at least this, to sampling error (95 % intervals over {} \
             episodes).",
            self.episodes
        )?;
        let [x, y, vx, vy] = self.lattice_nodes;
        let Lattice { cell, velocity } = self.lattice;
        writeln!(
            f,
            "Lattice {x} x {y} x {vx} x {vy} ({cell} m, {velocity} m/s), {:.0} s; its own value of the optimum, not \
             certified, {:.4} +- {:.4}.",
            self.seconds, self.lattice_value, self.lattice_error
        )?;
        if let Some(doubt) = self.doubt() {
            writeln!(f, "WARNING: {doubt}")?;
        }
        if self.controller != CONTROLLER {
            writeln!(
                f,
                "The script `{}` does better than the lattice's controller.",
                self.controller
            )?;
        }
        writeln!(f)?;
        writeln!(f, "Scripted protagonists{:>9}{:>9}{:>10}{:>10}", "CVaR", "mean", "lava", "goal")?;
        for Baseline { name, mean, cvar, lava_rate, goal_rate } in &self.baselines {
            let (lava, goal) = (100.0 * lava_rate, 100.0 * goal_rate);
            writeln!(f, "  {name:<19}{cvar:>9.4}{mean:>9.4}{lava:>8.2} %{goal:>8.2} %")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use lava_envs::random::ChaCha8Rng;
    use rand::{RngExt, SeedableRng};

    /// Random policies, each a law of three returns: v(w) = w - min E (w - J)^+ / alpha.
    #[test]
    fn thresholds_passed_over_are_none_of_the_two_best() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let (mut looked, mut all) = (0, 0);
        for round in 0..300 {
            let alpha = [0.01, 0.04, 0.5][round % 3];
            let laws: Vec<[(f64, f64); 3]> = (0..5)
                .map(|_| {
                    let weights: [f64; 3] = std::array::from_fn(|_| random.random_range(0.01..1.0));
                    let sum: f64 = weights.iter().sum();
                    weights.map(|weight| (random.random_range(-2.0..1.0), weight / sum))
                })
                .collect();
            let thresholds: Vec<f64> = (0..81).map(|i| -2.4 + 3.4 / 80.0 * f64::from(i)).collect();
            let value = |w: f64| {
                let shortfall = |law: &[(f64, f64); 3]| {
                    law.iter().map(|(j, p)| p * (w - j).max(0.0)).sum::<f64>()
                };
                w - laws.iter().map(shortfall).fold(f64::INFINITY, f64::min) / alpha
            };
            let some: Vec<Option<f64>> = thresholds.iter().copied().map(Some).collect();
            let ranked = rank(&some, |w| value(w.unwrap()));
            for &(own, w) in &ranked {
                assert_eq!(own, value(w.unwrap()));
            }
            // What was passed over is no better than the second of the ranking.
            let first = (0..80).step_by(first_stride(81)).chain([80]);
            for w in first.map(|index| thresholds[index]) {
                if ranked.iter().all(|of| of.1 != Some(w)) {
                    assert!(value(w) <= w && w < ranked[1].0);
                }
            }
            looked += ranked.len();
            all += looks(81);
        }
        assert!(5 * looked < 4 * all, "{looked} of {all}");
        assert_eq!(rank(&[None], |_| 0.5), [(0.5, None)]);
    }
}
