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
//!
//! # The risk level
//! As on the grid, the best CVaR is a search over thresholds w,
//!
//!   max_pi CVaR_alpha(J) = max_w { w - (1/alpha) min_pi E[(w - J)^+] },
//!
//! with w among the returns of episodes that reach the goal or the time limit. The maximum over w is
//! bracketed on a coarse lattice by its interpolated value; on the fine lattice the best candidates
//! are played, and the controller with the best played CVaR is chosen. It is then played afresh, on
//! streams that had no part in the choice, so that the certificate is not biased by it.
//! At eta = 1 there is no threshold: J itself is maximised, and the mean is the certificate.

pub mod controller;
pub mod lattice;
pub mod play;
pub mod sweep;

use super::{ExactError, require_eta};
use crate::files::write_in_place;
use crate::game::returns::ReturnLaw;
use controller::{Controller, Scripted};
use etcetera::base_strategy::{BaseStrategy as _, Xdg};
use lattice::Space;
use lava_envs::{ConfigError, End, PointConfig};
use play::{Played, play};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};
use std::io;
use std::path::{Path, PathBuf};
use std::time::Instant;
use sweep::{Rewards, Utility, sweep};

/// Name of the world in certificates.
pub const NAME: &str = "lava-point";

/// Version of the method and of its file; certificates of other versions are computed again.
const VERSION: u32 = 1;

/// Seed of the episodes that choose the threshold.
const SELECTION_SEED: u64 = 0x5e1e_c710;

/// Seed of the episodes that certify.
const CERTIFYING_SEED: u64 = 0xce47_1f1e;

/// Half-width of a 95 % interval in standard errors.
const NORMAL_95: f64 = 1.959_963_984_540_054;

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
    /// The lattice needs too much memory.
    #[error(
        "the oracle's tables would take {gibibytes:.1} GiB, more than {MOST_GIBIBYTES}; use a \
         coarser lattice or a shorter horizon"
    )]
    TooLarge {
        /// What they would take.
        gibibytes: f64,
    },
    /// The cache cannot be written.
    #[error("cannot write {path}: {source}", path = path.display())]
    Cache {
        /// Which file or folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

/// Most memory of the tables.
const MOST_GIBIBYTES: f64 = 6.0;

/// Resolution of the programme.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Lattice {
    /// Distance of position nodes in m; rounded so that the nodes reach from wall to wall.
    pub cell: f64,
    /// Distance of velocity nodes in m/s.
    pub velocity: f64,
}

impl Default for Lattice {
    /// A tenth of a metre, so that nodes lie on the borders of the default world's lava and goal, and
    /// a third of the default noise.
    fn default() -> Self {
        Lattice { cell: 0.1, velocity: 0.5 }
    }
}

impl Lattice {
    /// The lattice on which thresholds are searched.
    fn coarse(self) -> Lattice {
        Lattice { cell: 2.0 * self.cell, velocity: 1.5 * self.velocity }
    }
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

impl Default for Effort {
    fn default() -> Self {
        Effort {
            lattice: Lattice::default(),
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
    /// Threshold w of the controller; `None` at eta = 1.
    pub threshold: Option<f64>,
    /// The programme's own, interpolated value: not certified.
    pub lattice_value: f64,
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
}

/// The certificate of a world at the default effort, on a given lattice.
///
/// # Errors
/// If an argument is out of range.
pub fn certify(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    lattice: &Lattice,
) -> Result<Certified, OracleError> {
    certify_with(config, gamma, eta, &Effort { lattice: *lattice, ..Effort::default() })
}

/// The certificate of a world.
///
/// # Errors
/// If an argument is out of range.
pub fn certify_with(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
) -> Result<Certified, OracleError> {
    let began = Instant::now();
    let alpha = check(config, gamma, eta, effort)?;
    let rewards = Rewards::new(config, gamma);
    let threads = effort.threads.max(1);
    let space = Space::new(config, &effort.lattice, threads);
    let (chosen, threshold) = if alpha == 1.0 {
        (Controller::new(space, &rewards, Utility::Return, threads), None)
    } else {
        let (controller, w) = choose(config, gamma, alpha, effort, &space, &rewards)?;
        (controller, Some(w))
    };
    let Played { law, crossing_y, .. } =
        play(config, gamma, &chosen, effort.episodes, CERTIFYING_SEED, threads)?;
    let baselines = Scripted::all(config)
        .iter()
        .map(|scripted| {
            let episodes = effort.baseline_episodes;
            let law = play(config, gamma, scripted, episodes, CERTIFYING_SEED, threads)?.law;
            Ok(Baseline {
                name: scripted.name(),
                mean: law.mean(),
                cvar: law.cvar(alpha),
                lava_rate: law.probability(End::Lava),
                goal_rate: law.probability(End::Goal),
            })
        })
        .collect::<Result<_, ConfigError>>()?;
    let mean = Interval::new(law.mean(), law.mean_standard_error());
    let cvar = if alpha == 1.0 {
        mean
    } else {
        Interval::new(law.cvar(alpha), law.cvar_standard_error(alpha))
    };
    let value = chosen.value();
    let space = chosen.space();
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
        threshold,
        lattice_value: threshold.map_or(value, |w| w + value / alpha),
        lattice: effort.lattice,
        lattice_nodes: [space.axes[0].nodes, space.axes[1].nodes, speeds, speeds],
        episodes: effort.episodes,
        baselines,
        seconds: began.elapsed().as_secs_f64(),
        law,
    })
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
    let alpha = require_eta(eta)?;
    if !(gamma > 0.0 && gamma <= 1.0) {
        return Err(OracleError::Gamma(gamma));
    }
    let Lattice { cell, velocity } = effort.lattice;
    let widest = config.arena[0].min(config.arena[1]) / 4.0;
    if !(cell > 0.0 && cell <= widest) {
        let allowed = format!("above 0 and at most {widest} m, a quarter of the shorter side");
        return Err(OracleError::Lattice { field: "cell", value: cell, allowed });
    }
    // The smoothing is accurate while the noise spans the cells of the velocity lattice; the window
    // of a controller bounds the other end.
    let finest = config.acceleration / 14.0;
    if !(velocity > finest && velocity.is_finite()) {
        let allowed = format!("above {finest} m/s, a 14th of the acceleration");
        return Err(OracleError::Lattice { field: "velocity", value: velocity, allowed });
    }
    for (field, episodes) in
        [("episodes", effort.episodes), ("selection_episodes", effort.selection_episodes)]
    {
        if episodes == 0 {
            let allowed = "at least 1".to_owned();
            return Err(OracleError::Lattice { field, value: 0.0, allowed });
        }
    }
    let tables = if alpha == 1.0 { 1 } else { effort.candidates.clamp(1, 2) };
    let gibibytes = Space::bytes(config, &effort.lattice, tables) / f64::from(1 << 30);
    if gibibytes > MOST_GIBIBYTES {
        return Err(OracleError::TooLarge { gibibytes });
    }
    Ok(alpha)
}

/// The threshold and its controller.
fn choose(
    config: &PointConfig,
    gamma: f64,
    alpha: f64,
    effort: &Effort,
    space: &Space,
    rewards: &Rewards,
) -> Result<(Controller, f64), OracleError> {
    let threads = effort.threads.max(1);
    let thresholds = thresholds(config, rewards);
    let coarse = Space::new(config, &effort.lattice.coarse(), threads);
    let ranked = rank(&thresholds, |w| {
        w + sweep(&coarse, rewards, Utility::Shortfall(w), threads, false).value / alpha
    });
    let mut best: Option<(f64, Controller, f64)> = None;
    let candidates = ranked.iter().take(effort.candidates.max(1));
    for &w in candidates {
        // One table at a time besides the best one.
        let controller = Controller::new(space.clone(), rewards, Utility::Shortfall(w), threads);
        let law = if effort.candidates > 1 {
            play(config, gamma, &controller, effort.selection_episodes, SELECTION_SEED, threads)?
                .law
                .cvar(alpha)
        } else {
            0.0
        };
        if best.as_ref().is_none_or(|(highest, ..)| law > *highest) {
            best = Some((law, controller, w));
        }
    }
    let (_, controller, w) = best.expect("there is at least one threshold");
    Ok((controller, w))
}

/// Returns of episodes that reach the goal or the time limit, ascending.
fn thresholds(config: &PointConfig, rewards: &Rewards) -> Vec<f64> {
    let horizon = config.horizon as usize;
    let mut all: Vec<f64> =
        (0..horizon).map(|time| rewards.ending(time, config.goal_reward)).collect();
    all.push(rewards.running[horizon]);
    all.sort_by(f64::total_cmp);
    all.dedup_by(|a, b| (*a - *b).abs() < 1e-12);
    all
}

/// Thresholds by their value, best first, as far as a section search on a function that rises and
/// falls has looked at them; the neighbours of the best one are among them.
fn rank(thresholds: &[f64], mut value: impl FnMut(f64) -> f64) -> Vec<f64> {
    let mut known: BTreeMap<usize, f64> = BTreeMap::new();
    let mut at = |index: usize| *known.entry(index).or_insert_with(|| value(thresholds[index]));
    let (mut low, mut high) = (0, thresholds.len() - 1);
    while high - low > 3 {
        let golden = 0.381_966;
        let width = (high - low) as f64;
        let left = low + (golden * width).round() as usize;
        let right = (high - (golden * width).round() as usize).max(left + 1);
        if at(left) < at(right) { low = left } else { high = right }
    }
    (low..=high).for_each(|index| {
        at(index);
    });
    let mut ranked: Vec<(f64, usize)> = known.into_iter().map(|(index, v)| (v, index)).collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.into_iter().map(|(_, index)| thresholds[index]).collect()
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

/// A certificate on disk.
#[derive(Serialize, Deserialize)]
struct Entry {
    key: String,
    certified: Certified,
}

/// The certificates that come with the program: those of the default world at the paper's budgets,
/// computed by it (`cvar-game exact --env lava-point --eta E --anew`).
const SHIPPED: &str = include_str!("../../configs/oracle.json");

/// The certificate that comes with the program, if there is one of just these arguments. Tables show
/// regret against it without computing for minutes, and the same on every machine.
pub fn shipped(config: &PointConfig, gamma: f64, eta: f64, effort: &Effort) -> Option<Certified> {
    let key = key(config, gamma, eta, effort);
    let entries: Vec<Entry> = serde_json::from_str(SHIPPED).expect("a test reads the file");
    entries.into_iter().find(|entry| entry.key == key).map(|entry| entry.certified)
}

/// As [`certify_with`], but looks among the shipped certificates and into a folder first, and leaves
/// a new certificate there. A file that does not fit is computed anew and replaced.
///
/// # Errors
/// If an argument is out of range or the folder cannot be written.
pub fn certify_cached(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
    folder: &Path,
) -> Result<Certified, OracleError> {
    if let Some(certified) = shipped(config, gamma, eta, effort) {
        return Ok(certified);
    }
    let key = key(config, gamma, eta, effort);
    let found = std::fs::read(file_of(&key, folder)).ok();
    let found = found.and_then(|bytes| serde_json::from_slice::<Entry>(&bytes).ok());
    match found.filter(|entry| entry.key == key) {
        Some(entry) => Ok(entry.certified),
        None => certify_anew(config, gamma, eta, effort, folder),
    }
}

/// As [`certify_with`], and leaves the certificate in a folder for [`certify_cached`].
///
/// # Errors
/// If an argument is out of range or the folder cannot be written.
pub fn certify_anew(
    config: &PointConfig,
    gamma: f64,
    eta: f64,
    effort: &Effort,
    folder: &Path,
) -> Result<Certified, OracleError> {
    let certified = certify_with(config, gamma, eta, effort)?;
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| OracleError::Cache { path, source }
    };
    std::fs::create_dir_all(folder).map_err(failed(folder))?;
    let entry = Entry { key: key(config, gamma, eta, effort), certified };
    let path = file_of(&entry.key, folder);
    let text = serde_json::to_string(&entry).expect("a certificate has a JSON form");
    write_in_place(&path, text.as_bytes()).map_err(failed(&path))?;
    // Reading rounds the last bit of some numbers: all callers get the same ones, the first too.
    let Entry { certified, .. } = serde_json::from_str(&text).expect("its own form is read");
    Ok(certified)
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
        writeln!(
            f,
            "Lattice {x} x {y} x {vx} x {vy}, {:.0} s; its own value, not certified, {:.4}.\n",
            self.seconds, self.lattice_value
        )?;
        writeln!(f, "Scripted protagonists{:>9}{:>9}{:>10}{:>10}", "CVaR", "mean", "lava", "goal")?;
        for Baseline { name, mean, cvar, lava_rate, goal_rate } in &self.baselines {
            let (lava, goal) = (100.0 * lava_rate, 100.0 * goal_rate);
            writeln!(f, "  {name:<19}{cvar:>9.4}{mean:>9.4}{lava:>8.2} %{goal:>8.2} %")?;
        }
        Ok(())
    }
}
