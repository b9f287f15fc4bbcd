//! `figure_data.json`: what figures need beyond numbers, written once at the end of a run, so that no
//! report has to play a network.
//!
//! | data | of |
//! |---|---|
//! | [`CellData`] | worlds of cells: where the greedy protagonist goes when chance does as intended, and where its antagonists do otherwise |
//! | [`PlaneData`] | worlds in the plane: the greedy protagonist's trajectories, and how its antagonist shifts the noise |
//! | [`BudgetByTime`] | how the antagonist spends its budget |
//! | [`StoredEpisode`] | whole episodes, step by step |
//!
//! The file is an addition to a run: a run without it is reported as well. It stays below a few megabytes,
//! whatever the world: maps have at most [`MOST_CELLS`] cells or [`MOST_BINS`] bins along a side, and long
//! episodes are thinned. Former versions called it `exhibits.json`.

mod collect;

pub use collect::{Collector, collect, perturbed};

/// Name of the file in a run's folder.
pub const FILE: &str = "figure_data.json";

/// Its name in former versions.
pub const FORMER_FILE: &str = "exhibits.json";

use super::artefacts::Chance;
use lava_envs::End;
use serde::{Deserialize, Serialize};

/// Side in m of the bins of maps over a plane, where the plane is not too large for it.
pub const BIN: f64 = 0.5;

/// Most bins along a side of a plane: those of a larger plane are wider.
pub const MOST_BINS: f64 = 100.0;

/// Most cells of a map: a world with more of them has none.
pub const MOST_CELLS: f64 = 10_000.0;

/// Most steps of a stored episode. Longer ones are not stored, and their trajectories are thinned.
pub const MOST_STEPS: usize = 2_000;

/// Most times at which the remaining budget is recorded.
pub const MOST_TIMES: u32 = 1_000;

/// Classes of the remaining budget: equal parts of log eta_t / log eta in [0, 1], the last one open
/// above.
pub const BUDGET_CLASSES: usize = 3;

/// All figure data of a run. Its protagonist is the greedy one throughout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FigureData {
    /// Version of the on-disk formats.
    pub schema: u32,
    /// The name of the run; former versions did not write it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<String>,
    /// Trajectories that counts and averages are of.
    pub episodes: u64,
    /// Those that only this world has.
    pub world: WorldData,
    /// The remaining budget under the learned antagonist; `None` at eta = 1.
    pub budget: Option<BudgetByTime>,
    /// A few episodes: of each kind of chance the first ones, then the first that end in lava.
    pub stored: Vec<StoredEpisode>,
}

impl FigureData {
    /// Checks what the types do not guarantee: that lists which belong together have the same length.
    ///
    /// # Errors
    /// If a part is damaged; the error names it.
    pub fn check(&self) -> Result<(), String> {
        let sound = match &self.world {
            WorldData::Cells(grid) => {
                [&grid.learned, &grid.exact].into_iter().flatten().all(|of| {
                    of.visits.len() == of.deviations.len()
                        && of.visits.len() == grid.occupancy.len()
                })
            }
            WorldData::Plane(point) => {
                let bins = point.bins[0].checked_mul(point.bins[1]);
                let whole = |map: &ShiftMap| {
                    [map.visits.len(), map.shift.len(), map.divergence.len()]
                        .into_iter()
                        .all(|length| Some(length) == bins)
                };
                bins.is_some()
                    && point.bin.is_finite()
                    && point.bin > 0.0
                    && (point.shifts.is_empty() || point.shifts.len() == BUDGET_CLASSES)
                    && point.shifts.iter().all(whole)
            }
        };
        if !sound {
            return Err("its maps are of unequal size".to_owned());
        }
        let whole = |of: &StoredEpisode| {
            let steps = of.actions.len();
            of.path.len() == steps + 1
                && of.budgets.len() == steps + 1
                && of.outcomes.len() == steps
                && of.ratios.len() == steps
        };
        if !self.stored.iter().all(whole) {
            return Err("a stored episode lacks a part".to_owned());
        }
        Ok(())
    }
}

/// The figure data of one kind of world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldData {
    /// Of a world of cells.
    #[serde(alias = "lava-grid")]
    Cells(CellData),
    /// Of a world in the plane.
    #[serde(alias = "lava-point")]
    Plane(PlaneData),
}

/// Per cell of the map, row by row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CellData {
    /// Expected visits of an episode when no move slips (p = 0).
    pub occupancy: Vec<f64>,
    /// Under the learned antagonist, counted; `None` at eta = 1.
    pub learned: Option<Deviations>,
    /// Under the exact worst-case antagonist, expected of as many trajectories.
    pub exact: Option<Deviations>,
    /// `E[log eta_t]` / log eta by time under the exact worst-case antagonist, of running episodes.
    pub exact_budget: Vec<f64>,
}

/// Per cell: steps that began there, and those of them whose executed move was not the chosen one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Deviations {
    /// Steps.
    pub visits: Vec<f64>,
    /// Those with another move.
    pub deviations: Vec<f64>,
}

/// Of a world in the plane.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlaneData {
    /// Positions (m) of the first nominal episodes, step by step.
    pub trajectories: Vec<Vec<[f64; 2]>>,
    /// Bins along x and y.
    pub bins: [usize; 2],
    /// Side of a bin in m.
    #[serde(default = "bin")]
    pub bin: f64,
    /// How the antagonist shifts chance, by class of the remaining budget from the least on; empty at
    /// eta = 1.
    pub shifts: Vec<ShiftMap>,
}

/// The bins of former versions.
fn bin() -> f64 {
    BIN
}

/// Per bin, row by row, averaged over the steps that began in it under the learned antagonist.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShiftMap {
    /// Steps.
    pub visits: Vec<u64>,
    /// Mean of the noise xi, which nominally is 0.
    pub shift: Vec<[f64; 2]>,
    /// Mean of log delta_t(o_t), which is the divergence KL(P_t delta_t || P_t) in nats.
    pub divergence: Vec<f64>,
}

/// log eta_t / log eta by time, of the episodes that still run at that time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BudgetByTime {
    /// Steps from one entry to the next; the first one is of time 0.
    #[serde(default = "each")]
    pub every: u32,
    /// Their number.
    pub running: Vec<u64>,
    /// Mean.
    pub mean: Vec<f64>,
    /// 10 % quantile.
    pub low: Vec<f64>,
    /// 90 % quantile.
    pub high: Vec<f64>,
}

/// Every step, as in former versions.
fn each() -> u32 {
    1
}

/// One episode of n steps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredEpisode {
    /// Who decided the outcomes.
    pub chance: Chance,
    /// Index of the episode in the evaluation's streams.
    pub index: u64,
    /// How it ended.
    pub end: End,
    /// Its return J.
    pub value: f64,
    /// Where it was, from the start on: n + 1 places (cells or m).
    pub path: Vec<[f64; 2]>,
    /// Chosen actions: the move as a unit vector, or the push on the unit disc.
    pub actions: Vec<[f64; 2]>,
    /// Realised outcomes: the executed move as a unit vector, or the noise xi.
    pub outcomes: Vec<[f64; 2]>,
    /// Likelihood ratios delta_t(o_t); in nominal episodes those that the learned antagonist would
    /// have given to what happened.
    pub ratios: Vec<f64>,
    /// Remaining budgets eta_t, before each step and at the end: n + 1.
    pub budgets: Vec<f64>,
}
