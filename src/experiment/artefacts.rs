//! The files that a run writes, and where.
//!
//! A run `WORLD/METHOD/eta-E/seed-N` owns one folder:
//!
//! | file | what |
//! |---|---|
//! | `config.toml` | the resolved configuration of the run |
//! | `manifest.json` | [`Manifest`]: where the run comes from |
//! | `progress.csv` | one line per update of a player |
//! | `events.out.tfevents.cvar-game` | the same for TensorBoard ([`super::tensorboard`]) |
//! | `final.safetensors` | weights of both players at the end, not the best ones |
//! | `figure_data.json` | [`super::figure_data`]: what figures need beyond numbers |
//! | `checkpoint-<update>.bin` | what an unfinished run continues from, see [`super::checkpoint`] |
//! | `evaluation.json` | [`Evaluation`]; written last, so that a run with it is finished |

use super::clock::Clock;
use super::names::RunId;
use crate::exact::yardstick::{Comparison, Exploitability};
use crate::game::returns::ReturnLaw;
use crate::learn::device::Device;
use crate::learn::policy::Mode;
use serde::{Deserialize, Serialize};
use std::num::NonZeroUsize;

/// Version of the on-disk formats. A folder with another one is refused and not overwritten.
pub const SCHEMA: u32 = 1;

/// Mark of all on which the bits of training depend: sources, crates, compiler and target (see `build.rs`).
pub const BUILD: &str = env!("CVAR_GAME_BUILD");

/// Where a run comes from: all that is needed to repeat it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the on-disk formats.
    pub schema: u32,
    /// `WORLD/METHOD/eta-E/seed-N`.
    pub run: String,
    /// Version of the program.
    pub version: String,
    /// Commit of the source, if the program was built in a checkout.
    pub commit: Option<String>,
    /// Version of libtorch: the one that tch is made for, as its build refuses any other; `None` for a
    /// program without it.
    #[serde(default)]
    pub libtorch: Option<String>,
    /// Device of the networks.
    pub device: String,
    /// Model name of the processor.
    pub cpu: String,
    /// Number of its cores that the program may use; former versions did not write it.
    #[serde(default)]
    pub cores: Option<usize>,
    /// Seconds of training.
    pub seconds: f64,
    /// Which time they are of, as the others here; former versions had wall-clock time, beside whatever else ran, and did
    /// not write it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock: Option<Clock>,
    /// Seconds of the evaluation and of the figures' data; `None` before it, and former versions did not write it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evaluation_seconds: Option<f64>,
    /// Environment steps of training.
    pub steps: u64,
    /// When the regret of the greedy protagonist was first measured to be at most 0.05; `None` if it never was, or
    /// cannot be measured in training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub close: Option<Close>,
    /// What was not done as it was asked for, such as a number of steps that was rounded up.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
    /// Set when the run failed: the update, the player and the quantity.
    pub failure: Option<String>,
}

impl Manifest {
    /// The manifest of a run of this program on this machine.
    pub fn of(run: &RunId, device: Device, steps: u64, seconds: f64) -> Self {
        Manifest {
            schema: SCHEMA,
            run: run.to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            commit: option_env!("CVAR_GAME_COMMIT").map(str::to_owned),
            libtorch: cfg!(feature = "torch").then(|| "2.13.0".to_owned()),
            device: device.to_string(),
            cpu: processor(),
            cores: std::thread::available_parallelism().ok().map(NonZeroUsize::get),
            seconds,
            clock: Some(Clock::of(device)),
            evaluation_seconds: None,
            steps,
            close: None,
            notes: Vec::new(),
            failure: None,
        }
    }
}

/// When a run came close to the optimum.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Close {
    /// Environment steps.
    pub steps: u64,
    /// Seconds of training.
    pub seconds: f64,
}

/// Model name of the processor, where the system provides it.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find_map(|line| line.strip_prefix("model name"));
    model.map_or("unknown", |name| name.trim_start_matches([' ', '\t', ':'])).to_owned()
}

/// Who decides the law of chance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Chance {
    /// No one: chance follows its nominal law.
    Nominal,
    /// The antagonist that was trained with the protagonist.
    #[value(name = "learned")]
    Antagonist,
    /// The exact worst case for the greedy protagonist (finite worlds, such as lava-grid).
    Exact,
}

/// Episodes of one protagonist mode under one kind of chance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Play {
    /// How the protagonist picked its actions.
    pub protagonist: Mode,
    /// Who decided the law of chance.
    pub chance: Chance,
    /// Whether `law` is exact or of recorded episodes follows from its `episodes`.
    pub law: ReturnLaw,
    /// Mean over episodes of the least distance to lava; `None` where it was not recorded.
    pub mean_clearance: Option<f64>,
}

/// The budget audit (paper Eq. 5) over recorded trajectories.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Audit {
    /// Trajectories audited.
    pub trajectories: u64,
    /// max prod delta / eta over all trajectories; at most 1.
    pub max_budget_use: f64,
    /// max |`E_P[delta_t]` - 1| over all steps audited.
    pub max_normalisation_error: f64,
    /// Steps or trajectories beyond tolerance.
    pub violations: u64,
    /// Mean return of the sampled protagonist against the antagonist.
    pub antagonist_mean: f64,
    /// Its standard error.
    pub antagonist_standard_error: f64,
    /// The same mean from nominal episodes weighted by prod delta.
    pub weighted_nominal_mean: f64,
    /// Its standard error.
    pub weighted_nominal_standard_error: f64,
}

/// How far a run is from the optimum and from the worst case. On the grid exact; on lava-point against
/// the oracle and from recorded episodes, with standard errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Certificate {
    /// V*(eta): the optimal CVaR_{1/eta}; the certified CVaR of the oracle's controller on lava-point.
    pub optimum: f64,
    /// V*(eta) - CVaR_{1/eta} of the greedy policy; negative where it beats the oracle.
    pub regret: f64,
    /// Standard error of `regret`; 0 where that is exact.
    #[serde(default)]
    pub regret_standard_error: f64,
    /// Value of the greedy protagonist under the learned antagonist minus its CVaR_{1/eta}.
    pub antagonist_gap: f64,
    /// Standard error of `antagonist_gap`; 0 where that is exact.
    pub antagonist_gap_standard_error: f64,
    /// CVaR_{1/eta} of the best stationary policy found, minus that of the greedy policy; `None` where that sees
    /// the time, where the world is not finite, and in files of former versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class_regret: Option<f64>,
    /// How far both players are from an equilibrium; `None` where the best response to the antagonist is not
    /// known, and in files of former versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exploitability: Option<Exploitability>,
}

impl From<Comparison> for Certificate {
    fn from(found: Comparison) -> Self {
        Certificate {
            optimum: found.optimum,
            regret: found.regret,
            regret_standard_error: found.regret_standard_error,
            antagonist_gap: found.antagonist_gap,
            antagonist_gap_standard_error: found.antagonist_gap_standard_error,
            class_regret: found.class_regret,
            exploitability: found.exploitability,
        }
    }
}

/// What the evaluation protocol finds of trained players.
#[derive(Debug)]
pub struct Findings {
    /// Greedy and sampled, nominal and (where there is one) under the antagonist.
    pub plays: Vec<Play>,
    /// The budget audit; `None` without an antagonist.
    pub audit: Option<Audit>,
    /// Certificates where the world has a yardstick.
    pub certificate: Option<Certificate>,
}

/// What the evaluation protocol found of a finished run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Version of the on-disk formats.
    pub schema: u32,
    /// Name of the world.
    pub env: String,
    /// Budget eta.
    pub eta: f64,
    /// Seed.
    pub seed: u64,
    /// Environment steps of training.
    pub steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// All plays: greedy and sampled, nominal and (eta > 1) antagonist.
    pub plays: Vec<Play>,
    /// The budget audit; `None` at eta = 1.
    pub audit: Option<Audit>,
    /// Certificates where the world has a yardstick.
    pub certificate: Option<Certificate>,
}

impl Evaluation {
    /// The results of a run, with its steps and seconds of training.
    pub fn new(run: &RunId, (steps, seconds): (u64, f64), found: Findings) -> Self {
        let Findings { plays, audit, certificate } = found;
        Evaluation {
            schema: SCHEMA,
            env: run.world.to_string(),
            eta: run.eta.get(),
            seed: run.seed,
            steps,
            seconds,
            plays,
            audit,
            certificate,
        }
    }

    /// The play of this kind.
    pub fn play(&self, protagonist: Mode, chance: Chance) -> Option<&Play> {
        self.plays.iter().find(|play| play.protagonist == protagonist && play.chance == chance)
    }
}
