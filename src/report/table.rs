//! The table of results: one row per world and eta, statistics over its seeds.
//!
//! [`COLUMNS`] is the one description of the table: key, heading, what it means, how it is computed
//! and formatted. Every output format ([`super::render`]) is rendered from it, the legend too.
//!
//! Methods and variants in one folder, and several folders, make one table with a row per world, eta and
//! name; the first name (`game`, or the first folder) is what the others are compared with.
//!
//! Best values are marked by interval, not by digit: the best value of a column and all those whose
//! interval reaches into its interval.

use super::group::{Group, groups, references};
use super::runs::{AT_NEUTRAL, ORACLE, Regret, Run, Runs};
use super::settings::{Settings, Task, listed};
use super::statistics::{self, Estimate, Interval};
use crate::experiment::archive::FIRST_METHOD;
use crate::experiment::artefacts::{Audit, Chance, Close};
use crate::experiment::words::{counted, thousands};
use crate::game::returns::ReturnLaw;
use crate::learn::policy::Mode;
use std::collections::BTreeMap;

/// Standard errors below zero at which the slack of the bound is called a leak. Over a hundred runs
/// chance alone does that once in 300 tables.
const LEAK_ERRORS: f64 = 4.0;

/// Fewer seeds than this get a warning about the intervals.
const FEW_SEEDS: usize = 6;

/// A table that people see of a world. A column shown in none is only where programs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Block {
    /// Returns and ends of episodes.
    Returns,
    /// Comparison with eta = 1, the game, certificates.
    Game,
    /// Comparison with the first method or results folder.
    Comparison,
    /// The cross matrix: every policy at every level.
    Cross,
    /// Steps and time of training.
    Cost,
}

impl Block {
    /// All blocks, in order.
    pub const ALL: [Block; 5] =
        [Block::Returns, Block::Game, Block::Comparison, Block::Cross, Block::Cost];

    /// Its heading in a table of a world.
    pub fn title(self, world: &World) -> String {
        match self {
            Block::Returns => "greedy protagonist under nominal chance",
            Block::Game => "against eta = 1, the game, certificates",
            Block::Comparison => return format!("against {}", world.first),
            Block::Cross => "CVaR of the greedy protagonist at every level",
            Block::Cost => "what training took",
        }
        .to_owned()
    }
}

/// Which of a column's values is the best.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Best {
    /// None: they are not to be compared.
    None,
    /// The highest.
    Highest,
    /// The lowest.
    Lowest,
    /// The highest of those of one eta: the value means something else at each.
    HighestOfEta,
    /// The lowest of those of one eta.
    LowestOfEta,
}

/// Which kind of cell a column has, and how it is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A whole number.
    Count,
    /// An estimate with so many decimals.
    Estimate(usize),
    /// An estimate of a rate, in percent.
    Percent,
    /// The worst seed's number with so many decimals, and the seed.
    Worst(usize),
}

/// One cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cell {
    /// There is no such number.
    Missing,
    /// The row is the one that the others are compared with.
    Baseline,
    /// A whole number.
    Count(u64),
    /// A statistic over seeds.
    Estimate(Estimate),
    /// The worst seed; minus infinity if it failed.
    Worst {
        /// The seed.
        seed: u64,
        /// Its number.
        value: f64,
    },
}

/// Description of a column.
pub struct Column {
    /// Name for programs.
    pub key: &'static str,
    /// Heading for people.
    pub title: &'static str,
    /// Where it is shown.
    pub blocks: &'static [Block],
    /// How it is written.
    pub format: Format,
    /// Which value is marked.
    pub best: Best,
    /// What it is, in one sentence of the legend.
    pub meaning: &'static str,
    /// The same for the few lines below a table on a screen; empty where the heading says it.
    pub brief: &'static str,
    compute: fn(&Group, &Others) -> Cell,
}

/// What a row is compared with.
struct Others<'a> {
    /// The row of the same name at eta = 1.
    neutral: Option<&'a Group<'a>>,
    /// The row of the first name at the same eta, if there are several names and the task is the same.
    first: Option<&'a Group<'a>>,
    /// The best risk-neutral policy that is known of the same task.
    best_neutral: Option<&'a Group<'a>>,
}

fn estimate(estimate: Option<Estimate>) -> Cell {
    estimate.map_or(Cell::Missing, Cell::Estimate)
}

/// What compares a row with another one; that one itself is the baseline.
fn against(
    group: &Group,
    baseline: Option<&Group>,
    compare: impl Fn(&Group) -> Option<Cell>,
) -> Cell {
    match baseline {
        Some(baseline) if std::ptr::eq(group, baseline) => Cell::Baseline,
        Some(baseline) => compare(baseline).unwrap_or(Cell::Missing),
        None => Cell::Missing,
    }
}

fn gain(group: &Group, baseline: Option<&Group>) -> Cell {
    against(group, baseline, |baseline| {
        statistics::student_estimate(&group.differences(baseline)).map(Cell::Estimate)
    })
}

fn overall_gain(group: &Group, baseline: Option<&Group>) -> Cell {
    against(group, baseline, |baseline| group.overall_difference(baseline).map(Cell::Estimate))
}

fn pairs(group: &Group, baseline: Option<&Group>) -> Cell {
    against(group, baseline, |baseline| {
        let pairs = group.differences(baseline).len();
        (pairs > 0).then_some(Cell::Count(pairs as u64))
    })
}

/// The p value of a difference; [`correct`] makes Holm's of those of a table.
fn p_value(group: &Group, baseline: Option<&Group>) -> Cell {
    against(group, baseline, |baseline| {
        let value = statistics::student_p(&group.differences(baseline))?;
        Some(Cell::Estimate(Estimate { value, interval: None }))
    })
}

fn improvement(group: &Group, baseline: Option<&Group>) -> Cell {
    against(group, baseline, |baseline| group.improvement(baseline).map(Cell::Estimate))
}

/// Mean over the runs of what their training took; runs of other programs do not say.
fn cost(group: &Group, of: impl Fn(&Run) -> Option<f64>) -> Cell {
    let told = group.runs.iter().filter(|run| run.steps > 0 && run.seconds > 0.0);
    let values: Vec<f64> = told.filter_map(of).collect();
    estimate(statistics::mean(&values).map(|value| Estimate { value, interval: None }))
}

/// The same of a time. That of former versions, beside whatever else the machine did, cannot be compared.
fn time(group: &Group, of: impl Fn(&Run) -> Option<f64>) -> Cell {
    if group.runs.iter().any(|run| run.clock().is_none()) {
        return Cell::Missing;
    }
    cost(group, of)
}

/// Median over the runs of when they came close to the optimum; none if more than half of them did not.
fn median(group: &Group, of: impl Fn(Close) -> f64) -> Cell {
    let values: Vec<f64> =
        group.runs.iter().map(|run| run.close().map_or(f64::INFINITY, &of)).collect();
    let value = statistics::median(&values).filter(|value| value.is_finite());
    estimate(value.map(|value| Estimate { value, interval: None }))
}

/// CVaR at a fixed level; levels of [`super::group::ALPHAS`] are always measured.
fn cvar(group: &Group, alpha: f64) -> Cell {
    let level = group.level(alpha);
    estimate(group.mean(|measures| measures.cvar[level]))
}

/// Violations over the audits of a group's runs.
fn violations(group: &Group) -> Option<u64> {
    let audits = group.runs.iter().filter_map(|run| run.evaluation.as_ref()?.audit);
    audits.map(|audit| audit.violations).reduce(|a, b| a + b)
}

/// Columns that results of former versions have no numbers for. CSV files leave them out where no row has
/// one, so that those of such results stay as they are.
const LATER: [&str; 6] = [
    "class_regret",
    "exploitability",
    "response_gain",
    "evaluation_seconds",
    "steps_to_close",
    "seconds_to_close",
];

/// The columns, in order. World, eta, alpha, seeds and failures stand before them in every format.
pub static COLUMNS: [Column; 45] = [
    Column {
        key: FAILURE_RATE,
        title: "failed %",
        blocks: &[Block::Returns],
        format: Format::Percent,
        best: Best::None,
        meaning: "share of the seeds that fail: the run stopped, or its greedy protagonist reaches the goal in fewer than \
                  half of its episodes, though the best policy that is known reaches it. Where a seed fails and others do \
                  not, the columns that do not say otherwise are of the others",
        brief: "seeds that do not reach the goal; the other columns are mostly of the others",
        compute: |group, _| estimate(group.failure_rate()),
    },
    Column {
        key: "mean",
        title: "mean",
        blocks: &[Block::Returns, Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean return of the greedy protagonist under nominal chance",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.mean)),
    },
    Column {
        key: "cvar",
        title: "CVaR_1/eta",
        blocks: &[Block::Returns],
        format: Format::Estimate(3),
        best: Best::HighestOfEta,
        meaning: "mean of the worst 1/eta of its returns: what the row was trained for",
        brief: "mean of the worst 1/eta of the returns",
        compute: |group, _| cvar(group, group.alpha()),
    },
    Column {
        key: "cvar_all",
        title: "CVaR_1/eta, all",
        blocks: &[Block::Returns],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "the same over all seeds, failed ones too. Its interval covers what a share of failures as high as the \
                  seeds allow would do, whatever the failed ones return",
        brief: "",
        compute: |group, _| estimate(group.overall(group.alpha())),
    },
    Column {
        key: "cvar_0.5",
        title: "CVaR_0.5",
        blocks: &[Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 50 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.5),
    },
    Column {
        key: "cvar_0.25",
        title: "CVaR_0.25",
        blocks: &[Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 25 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.25),
    },
    Column {
        key: "cvar_0.1",
        title: "CVaR_0.1",
        blocks: &[Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 10 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.1),
    },
    Column {
        key: "cvar_0.05",
        title: "CVaR_0.05",
        blocks: &[Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 5 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.05),
    },
    Column {
        key: "cvar_0.04",
        title: "CVaR_0.04",
        blocks: &[Block::Returns, Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 4 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.04),
    },
    Column {
        key: "cvar_0.01",
        title: "CVaR_0.01",
        blocks: &[Block::Returns, Block::Cross],
        format: Format::Estimate(3),
        best: Best::Highest,
        meaning: "mean of its worst 1 % of returns",
        brief: "",
        compute: |group, _| cvar(group, 0.01),
    },
    Column {
        key: "lava",
        title: "lava %",
        blocks: &[Block::Returns],
        format: Format::Percent,
        best: Best::Lowest,
        meaning: "share of its episodes that end in lava",
        brief: "",
        compute: |group, _| estimate(group.rate(|measures| measures.lava)),
    },
    Column {
        key: "goal",
        title: "goal %",
        blocks: &[Block::Returns],
        format: Format::Percent,
        best: Best::Highest,
        meaning: "share of its episodes that reach the goal; the rest runs into the time limit",
        brief: "",
        compute: |group, _| estimate(group.rate(|measures| measures.goal)),
    },
    Column {
        key: "clearance",
        title: "clearance",
        blocks: &[Block::Returns],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "least distance to lava in an episode, on average (lava-grid: cells; lava-point: metres)",
        brief: "least distance to lava",
        compute: |group, _| estimate(group.mean(|measures| measures.clearance)),
    },
    Column {
        key: "cvar_iqm",
        title: "IQM",
        blocks: &[Block::Game],
        format: Format::Estimate(3),
        best: Best::HighestOfEta,
        meaning: "interquartile mean over all seeds of CVaR_1/eta: the middle half of the runs",
        brief: "CVaR_1/eta of the middle half of the seeds",
        compute: |group, _| {
            // Of three seeds it is the mean once more.
            if group.runs.len() < 4 {
                return Cell::Missing;
            }
            let level = group.level(group.alpha());
            estimate(group.iqm(|measures| measures.cvar[level]))
        },
    },
    Column {
        key: "cvar_worst",
        title: "worst seed",
        blocks: &[Block::Game],
        format: Format::Worst(3),
        best: Best::None,
        meaning: "CVaR_1/eta of the worst seed; a failed run is worse than any number",
        brief: "its CVaR_1/eta",
        compute: |group, _| {
            let level = group.level(group.alpha());
            let worst = group.worst(|measures| measures.cvar[level]);
            worst.map_or(Cell::Missing, |(seed, value)| Cell::Worst { seed, value })
        },
    },
    Column {
        key: "gain_best_neutral",
        title: "gain over best",
        blocks: &[Block::Game],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "CVaR_1/eta minus CVaR at that same level of the best risk-neutral policy there is (lava-point: of \
                  the oracle's): the gain that is due to risk aversion, not to the slack of the learned eta = 1 policy",
        brief: "CVaR_1/eta over that of the best risk-neutral policy",
        compute: |group, others| estimate(others.best_neutral.and_then(|best| group.above(best))),
    },
    Column {
        key: "gain_best_neutral_all",
        title: "gain over best, all",
        blocks: &[],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "the same over all seeds, failed ones too",
        brief: "",
        compute: |group, others| {
            estimate(others.best_neutral.and_then(|best| group.overall_above(best)))
        },
    },
    Column {
        key: "gain",
        title: "gain",
        blocks: &[Block::Game],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "CVaR_1/eta minus CVaR at that same level of the eta = 1 policy of the same seed \
                  (positive: better than eta = 1), of the seeds at which neither fails",
        brief: "CVaR_1/eta over that of eta = 1",
        compute: |group, others| gain(group, others.neutral),
    },
    Column {
        key: "gain_all",
        title: "gain, all",
        blocks: &[Block::Game],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "the same difference over all seeds of both rows, failed ones too",
        brief: "",
        compute: |group, others| overall_gain(group, others.neutral),
    },
    Column {
        key: "gain_pairs",
        title: "pairs",
        blocks: &[],
        format: Format::Count,
        best: Best::None,
        meaning: "number of seeds in gain: those at which neither row fails",
        brief: "",
        compute: |group, others| pairs(group, others.neutral),
    },
    Column {
        key: "improvement",
        title: "P(better)",
        blocks: &[Block::Game],
        format: Format::Estimate(2),
        best: Best::None,
        meaning: "probability that a run of the row beats a run of eta = 1 in CVaR at level 1/eta",
        brief: "probability that a run beats one that it is compared with",
        compute: |group, others| improvement(group, others.neutral),
    },
    Column {
        key: "share_above_best_neutral",
        title: "above best %",
        blocks: &[],
        format: Format::Percent,
        best: Best::None,
        meaning: "share of the seeds whose CVaR_1/eta is above that of the best risk-neutral policy",
        brief: "",
        compute: |group, others| {
            estimate(others.best_neutral.and_then(|best| group.share_above(best)))
        },
    },
    Column {
        key: "game_value",
        title: "game value",
        blocks: &[Block::Game],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "mean return of the sampled protagonist under its learned antagonist (eta = 1: which can do nothing)",
        brief: "mean return against the learned antagonist",
        compute: |group, _| estimate(group.mean(|measures| measures.game_value)),
    },
    Column {
        key: "regret",
        title: "regret",
        blocks: &[Block::Game],
        format: Format::Estimate(4),
        best: Best::LowestOfEta,
        meaning: "the best possible CVaR_1/eta minus that of the greedy protagonist",
        brief: "CVaR_1/eta of the optimum, or of the oracle where that is not known, minus that of the row",
        compute: |group, _| estimate(group.mean(|measures| measures.regret)),
    },
    Column {
        key: "class_regret",
        title: "class regret",
        blocks: &[Block::Game],
        format: Format::Estimate(4),
        best: Best::None,
        meaning: "CVaR_1/eta of the best policy that a local search finds among those that do not see the time, \
                  minus that of the greedy protagonist, which is one of them",
        brief: "the regret among policies that do not see the time",
        compute: |group, _| estimate(group.mean(|measures| measures.class_regret)),
    },
    Column {
        key: "antagonist_gap",
        title: "antagonist gap",
        blocks: &[Block::Game],
        format: Format::Estimate(4),
        best: Best::None,
        meaning: "value of the greedy protagonist under its antagonist minus its CVaR_1/eta: \
                  how far the antagonist is from the worst case (0: perfect)",
        brief: "0 for a perfect antagonist",
        compute: |group, _| estimate(group.mean(|measures| measures.antagonist_gap)),
    },
    Column {
        key: "bound_slack",
        title: "gap, sampled",
        blocks: &[Block::Game],
        format: Format::Estimate(4),
        best: Best::None,
        meaning: "game value minus CVaR_1/eta of the sampled protagonist: the gap of the antagonist against the protagonist \
                  that it has learned against; not below 0, else the budget leaks",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.bound_slack)),
    },
    Column {
        key: "exploitability",
        title: "exploitability",
        blocks: &[Block::Game],
        format: Format::Estimate(4),
        best: Best::None,
        meaning: "the larger one of the regret and of what the best response to the antagonist gains over the best \
                  possible CVaR_1/eta; that response may see the budget, so it is an upper bound",
        brief: "the most that a better player of either side would gain",
        compute: |group, _| estimate(group.mean(|measures| measures.exploitability)),
    },
    Column {
        key: "response_gain",
        title: "response gain",
        blocks: &[],
        format: Format::Estimate(4),
        best: Best::None,
        meaning: "mean return of the best response to the antagonist minus the best possible CVaR_1/eta",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.response_gain)),
    },
    Column {
        key: "timeout",
        title: "timeout %",
        blocks: &[],
        format: Format::Percent,
        best: Best::None,
        meaning: "share of its episodes that run into the time limit",
        brief: "",
        compute: |group, _| estimate(group.rate(|measures| measures.timeout)),
    },
    Column {
        key: "steps_to_goal",
        title: "steps to goal",
        blocks: &[],
        format: Format::Estimate(1),
        best: Best::None,
        meaning: "mean length of its episodes that reach the goal",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.steps_to_goal)),
    },
    Column {
        key: "sampled_mean",
        title: "sampled mean",
        blocks: &[],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "mean return of the sampled protagonist under nominal chance",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.sampled_mean)),
    },
    Column {
        key: "sampled_cvar",
        title: "sampled CVaR_1/eta",
        blocks: &[],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "CVaR_1/eta of the sampled protagonist under nominal chance",
        brief: "",
        compute: |group, _| estimate(group.mean(|measures| measures.sampled_cvar)),
    },
    Column {
        key: "budget_violations",
        title: "violations",
        blocks: &[],
        format: Format::Count,
        best: Best::None,
        meaning: "steps or trajectories on which an antagonist overran its budget, over all seeds",
        brief: "",
        compute: |group, _| violations(group).map_or(Cell::Missing, Cell::Count),
    },
    Column {
        key: "versus",
        title: "difference",
        blocks: &[Block::Comparison],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "CVaR_1/eta minus that of the first method or folder at the same eta and seed",
        brief: "CVaR_1/eta over that of the first name",
        compute: |group, others| gain(group, others.first),
    },
    Column {
        key: "versus_p",
        title: "Holm p",
        blocks: &[Block::Comparison],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "p value of the difference (Student's t test over the pairs), corrected by Holm's method for all \
                  differences of this file: below 0.05 it is distinguishable from 0 though so many were looked at",
        brief: "p value of the difference, corrected for their number",
        compute: |group, others| p_value(group, others.first),
    },
    Column {
        key: "versus_all",
        title: "difference, all",
        blocks: &[Block::Comparison],
        format: Format::Estimate(3),
        best: Best::None,
        meaning: "the same difference over all seeds of both rows, failed ones too",
        brief: "",
        compute: |group, others| overall_gain(group, others.first),
    },
    Column {
        key: "versus_pairs",
        title: "pairs",
        blocks: &[Block::Comparison],
        format: Format::Count,
        best: Best::None,
        meaning: "number of seeds in difference: those at which neither row fails",
        brief: "seeds in the difference",
        compute: |group, others| pairs(group, others.first),
    },
    Column {
        key: "versus_improvement",
        title: "P(better)",
        blocks: &[Block::Comparison],
        format: Format::Estimate(2),
        best: Best::None,
        meaning: "probability that a run of the row beats a run of the first method or folder in CVaR_1/eta",
        brief: "probability that a run beats one that it is compared with",
        compute: |group, others| improvement(group, others.first),
    },
    Column {
        key: "steps",
        title: "steps",
        blocks: &[Block::Cost],
        format: Format::Estimate(0),
        best: Best::None,
        meaning: "environment steps of training, mean over seeds",
        brief: "",
        compute: |group, _| cost(group, |run| Some(run.steps as f64)),
    },
    Column {
        key: "seconds",
        title: "seconds",
        blocks: &[Block::Cost],
        format: Format::Estimate(1),
        best: Best::None,
        meaning: "seconds of training, mean over seeds: processor time of its one thread (with a graphics card wall-clock \
                  time); none where a run has wall-clock time beside other work",
        brief: "",
        compute: |group, _| time(group, |run| Some(run.seconds)),
    },
    Column {
        key: "evaluation_seconds",
        title: "evaluation",
        blocks: &[Block::Cost],
        format: Format::Estimate(1),
        best: Best::None,
        meaning: "the same of the evaluation and of the figures' data",
        brief: "",
        compute: |group, _| time(group, Run::evaluation_seconds),
    },
    Column {
        key: "steps_to_close",
        title: "steps to 0.05",
        blocks: &[Block::Cost],
        format: Format::Estimate(0),
        best: Best::None,
        meaning: "environment steps when the regret was first measured to be at most 0.05, median over seeds; none if \
                  more than half of them never came so close",
        brief: "when the regret was first at most 0.05",
        compute: |group, _| median(group, |close| close.steps as f64),
    },
    Column {
        key: "seconds_to_close",
        title: "seconds to 0.05",
        blocks: &[Block::Cost],
        format: Format::Estimate(1),
        best: Best::None,
        meaning: "the same in seconds of training",
        brief: "",
        compute: |group, _| match time(group, |run| Some(run.seconds)) {
            Cell::Missing => Cell::Missing,
            _ => median(group, |close| close.seconds),
        },
    },
    Column {
        key: "steps_per_second",
        title: "steps/s",
        blocks: &[Block::Cost],
        format: Format::Estimate(0),
        best: Best::None,
        meaning: "environment steps per second of training, mean over seeds",
        brief: "",
        compute: |group, _| time(group, |run| Some(run.steps as f64 / run.seconds)),
    },
];

/// One world and eta, of one method and variant in one results folder.
#[derive(Debug, Clone)]
pub struct Row {
    /// Budget eta.
    pub eta: f64,
    /// Name of the results folder.
    pub folder: String,
    /// Method of training.
    pub method: String,
    /// Variant of the method.
    pub variant: Option<String>,
    /// What tables with several names call it.
    pub name: String,
    /// What tells its settings apart from others of the method and variant.
    pub settings: Option<String>,
    /// Whether it is a policy that the others are compared with: no method trained it.
    pub reference: bool,
    /// Rows of one number have the same task, and their values may be compared.
    task: usize,
    /// Number of seeds, failed ones included.
    pub seeds: usize,
    /// Number of failed ones.
    pub failures: usize,
    /// One cell per entry of [`COLUMNS`].
    pub cells: Vec<Cell>,
    /// Whether the cell is the best of its column, or not distinguishable from it.
    pub best: Vec<bool>,
}

/// The rows of a world.
#[derive(Debug, Clone)]
pub struct World {
    /// Its name.
    pub name: String,
    /// The name that the others are compared with.
    pub first: String,
    /// By eta, then in the order of the names.
    pub rows: Vec<Row>,
    /// How many episodes its numbers rest on.
    pub episodes: String,
    /// What the budget audits and the bound say.
    pub checks: String,
}

impl World {
    /// Whether the world has a number in the column.
    pub fn has(&self, column: usize) -> bool {
        let number = |row: &Row| !matches!(row.cells[column], Cell::Missing | Cell::Baseline);
        self.rows.iter().any(number)
    }

    /// Whether the best that is known here is a certified controller and not the optimum.
    pub fn has_oracle(&self) -> bool {
        self.rows.iter().any(|row| row.reference && row.method.starts_with(ORACLE))
    }

    /// The heading of a column here.
    pub fn heading(&self, column: &Column) -> &'static str {
        if column.key == REGRET && self.has_oracle() { REGRET_TO_ORACLE } else { column.title }
    }
}

const REGRET: &str = "regret";

const FAILURE_RATE: &str = "failure_rate";

/// The heading of a regret to what may not be the best.
pub const REGRET_TO_ORACLE: &str = "regret to oracle";

/// The results of one method and variant in one folder.
pub struct Results<'a> {
    /// Heading of the column of names, `folder` or `method`, in tables that need one.
    heading: Option<&'static str>,
    folder: String,
    name: String,
    /// Its runs, measured.
    pub groups: Vec<Group<'a>>,
    /// The policies that those of its folder can be compared with; the folder's first results have them.
    references: Vec<Group<'a>>,
    /// What its reader must know.
    notes: Vec<String>,
}

impl<'a> Results<'a> {
    /// The results of folders, by folder, then by method and variant.
    pub fn of(folders: &[(&str, &'a Runs)]) -> Vec<Results<'a>> {
        let several = folders.len() > 1;
        folders
            .iter()
            .flat_map(|(folder, runs)| Results::of_folder(folder, runs, several))
            .collect()
    }

    fn of_folder(folder: &str, runs: &'a Runs, several: bool) -> Vec<Results<'a>> {
        let mut results: Vec<Results> = Vec::new();
        for group in groups(runs) {
            let same = |of: &&mut Results| of.method() == group.method.as_ref();
            if let Some(known) = results.iter_mut().find(same) {
                known.groups.push(group);
                continue;
            }
            let (heading, name) = match &group.method {
                None if several => (Some("folder"), folder.to_owned()),
                None if !runs.references.is_empty() => (Some("method"), FIRST_METHOD.to_owned()),
                None => (None, folder.to_owned()),
                Some(method) if several => (Some("folder"), format!("{folder}/{method}")),
                Some(method) => (Some("method"), method.clone()),
            };
            let (folder, notes, references) = (folder.to_owned(), Vec::new(), Vec::new());
            results.push(Results { heading, folder, name, groups: vec![group], references, notes });
        }
        let own = (runs.runs.iter().flat_map(warnings))
            .chain(without_goal(&runs.runs))
            .chain(runs.notes.iter().cloned());
        let said = |note| if several { format!("{folder}: {note}") } else { note };
        if let Some(first) = results.first_mut() {
            first.notes = own.map(said).collect();
            first.references = references(runs);
        }
        results
    }

    fn method(&self) -> Option<&String> {
        self.groups.first().and_then(|group| group.method.as_ref())
    }
}

/// All that is printed.
#[derive(Debug, Clone)]
pub struct Table {
    /// Heading of the column of names; `None` if there is only one and it goes without saying.
    pub heading: Option<&'static str>,
    /// By name.
    pub worlds: Vec<World>,
    /// What a reader must know before trusting a number: failures, violations, runs left out.
    pub notes: Vec<String>,
}

impl Table {
    /// Whether CSV files have the column.
    pub fn lists(&self, column: usize) -> bool {
        let later = LATER.contains(&COLUMNS[column].key);
        !later || self.worlds.iter().any(|world| world.has(column))
    }

    /// Computes every cell. The first results are what the others are compared with.
    pub fn new(results: &[Results]) -> Table {
        let groups = || results.iter().flat_map(|results| &results.groups);
        let mut names: Vec<&str> = groups().map(|group| group.env).collect();
        names.sort_unstable();
        names.dedup();
        let mut worlds: Vec<World> = names.iter().map(|name| world(name, results)).collect();
        correct(&mut worlds);
        let mut notes: Vec<String> =
            results.iter().flat_map(|results| results.notes.iter().cloned()).collect();
        for name in &names {
            let in_world = |of: &&Results| of.groups.iter().any(|group| group.env == *name);
            let here: Vec<&Results> = results.iter().filter(in_world).collect();
            notes.extend(comparability(name, &here));
            notes.extend(without_regret(name, &here));
        }
        let fewest = groups().map(|group| group.runs.len()).min().unwrap_or_default();
        if fewest == 1 {
            notes.push(
                "Rows of one seed have no interval: one seed does not show how seeds differ."
                    .to_owned(),
            );
        } else if fewest < FEW_SEEDS {
            notes.push(format!(
                "Some rows have only {fewest} seeds. So few hardly show how often a run fails, and their intervals cover \
                 less than 95 % where seeds are skewed: 91 % with three (results/coverage.md)."
            ));
        }
        let heading = results.iter().find_map(|of| of.heading);
        Table { heading, worlds, notes }
    }
}

fn world(name: &str, results: &[Results]) -> World {
    let mut rows = Vec::new();
    let mut all: Vec<&Group> = Vec::new();
    let mut tasks: Vec<&Task> = Vec::new();
    // The first folder and method, with whatever settings they have here.
    let named = |of: &Results| {
        let run = &of.groups[0].runs[0].name;
        (of.folder.clone(), run.method.clone(), run.variant.clone())
    };
    let is_here = |of: &&Results| of.groups.iter().any(|group| group.env == name);
    let first = results.iter().filter(is_here).find(|of| named(of) == named(&results[0]));
    let find = |results: &'_ Results<'_>, eta: f64| {
        results.groups.iter().position(|group| group.env == name && group.eta == eta)
    };
    let known: Vec<&Group> =
        results.iter().flat_map(|of| &of.references).filter(|group| group.env == name).collect();
    for of in results {
        for group in of.groups.iter().filter(|group| group.env == name) {
            let task = &group.runs[0].settings.task;
            let place = tasks.iter().position(|known| *known == task);
            let place = place.unwrap_or_else(|| {
                tasks.push(task);
                tasks.len() - 1
            });
            let first = first.filter(|_| results.len() > 1);
            let first = first
                .and_then(|first| find(first, group.eta).map(|place| &first.groups[place]))
                .filter(|first| first.runs[0].settings.task == *task);
            let neutral = find(of, 1.0).map(|place| &of.groups[place]);
            let best_neutral = known.iter().copied().find(|known| {
                let run = &known.runs[0];
                let same = known.eta == group.eta && run.settings.task == *task;
                same && (group.eta == 1.0 || run.name.method.ends_with(AT_NEUTRAL))
            });
            let others = Others { neutral, first, best_neutral };
            rows.push(Row {
                eta: group.eta,
                folder: of.folder.clone(),
                method: group.runs[0].name.method.clone(),
                variant: group.runs[0].name.variant.clone(),
                name: of.name.clone(),
                settings: group.runs[0].label.clone(),
                reference: false,
                task: place,
                seeds: group.runs.len(),
                failures: group.failures(),
                cells: COLUMNS.iter().map(|column| (column.compute)(group, &others)).collect(),
                best: vec![false; COLUMNS.len()],
            });
            all.push(group);
        }
    }
    let nobody = Others { neutral: None, first: None, best_neutral: None };
    for group in &known {
        let run = &group.runs[0];
        let place = tasks.iter().position(|known| **known == run.settings.task);
        let task = place.expect("the task of some row");
        let twin = |row: &Row| {
            row.reference
                && row.task == task
                && row.eta == group.eta
                && row.method == run.name.method
        };
        if rows.iter().any(twin) {
            continue;
        }
        let cell = |column: &Column| {
            let shown = [Block::Returns, Block::Cross].iter().any(|of| column.blocks.contains(of));
            let of_seeds = column.key == FAILURE_RATE;
            if shown && !of_seeds { (column.compute)(group, &nobody) } else { Cell::Missing }
        };
        let settings = told_apart(&tasks, task);
        let method = run.name.method.clone();
        rows.push(Row {
            eta: group.eta,
            folder: String::new(),
            name: settings.as_ref().map_or(method.clone(), |of| format!("{method}, {of}")),
            method,
            variant: None,
            settings,
            reference: true,
            task,
            seeds: 0,
            failures: 0,
            cells: COLUMNS.iter().map(cell).collect(),
            best: vec![false; COLUMNS.len()],
        });
    }
    // Stable: within an eta the names keep their order.
    rows.sort_by(|a, b| a.eta.total_cmp(&b.eta));
    mark(&mut rows);
    let first = first.map_or(results[0].name.clone(), |first| first.name.clone());
    World { name: name.to_owned(), first, rows, episodes: episodes(&all), checks: checks(&all) }
}

/// Corrects the p values of a table for their number.
fn correct(worlds: &mut [World]) {
    let place = COLUMNS.iter().position(|column| column.key == "versus_p").expect("a column");
    let rows = worlds.iter_mut().flat_map(|world| &mut world.rows);
    let mut cells: Vec<&mut Estimate> = rows
        .filter_map(|row| match &mut row.cells[place] {
            Cell::Estimate(of) => Some(of),
            _ => None,
        })
        .collect();
    let found: Vec<f64> = cells.iter().map(|of| of.value).collect();
    for (cell, corrected) in cells.iter_mut().zip(statistics::holm(&found)) {
        cell.value = corrected;
    }
}

/// What tells a task apart from others of its world, such as `slip=0.3`; `None` if there are no others.
fn told_apart(tasks: &[&Task], place: usize) -> Option<String> {
    let other = tasks.get(usize::from(place == 0))?;
    let differences = tasks[place].differences(other);
    let words = differences.iter().map(|of| format!("{}={}", of.key, of.values[0]));
    Some(words.collect::<Vec<String>>().join(", "))
}

/// What a reader must know before comparing the rows of a world: other tasks, other training (of other
/// folders; within one it is what the rows are about), other evaluations.
fn comparability(world: &str, here: &[&Results]) -> Vec<String> {
    // All runs of a name and world have the same task and training.
    fn settings<'a>(of: &'a Results, world: &str) -> Option<&'a Settings> {
        let group = of.groups.iter().find(|group| group.env == world)?;
        Some(&group.runs[0].settings)
    }
    let mut notes = Vec::new();
    if let Some((first, others)) = here.split_first()
        && let Some(own) = settings(first, world)
    {
        for other in others {
            let Some(theirs) = settings(other, world) else { continue };
            let names = format!("{} and {}", first.name, other.name);
            if own.task != theirs.task {
                let what = listed(&own.task.differences(&theirs.task));
                notes.push(format!(
                    "{world}: {names} are different tasks: {what}. CVaR compares policies of one task, so \
                     no difference is shown."
                ));
            } else if first.folder != other.folder {
                let differences = own.training_differences(theirs);
                if !differences.is_empty() {
                    let what = listed(&differences);
                    notes.push(format!("{world}: {names} were trained differently: {what}."));
                }
            }
        }
    }
    let runs = || {
        let groups = here.iter().flat_map(|of| &of.groups).filter(|group| group.env == world);
        groups.flat_map(|group| group.runs)
    };
    let mut values: BTreeMap<&String, Vec<(String, u64)>> = BTreeMap::new();
    for (key, value) in runs().flat_map(|run| run.settings.evaluation()) {
        let (known, value) = (values.entry(key).or_default(), value.to_string());
        match known.iter_mut().find(|(of, _)| *of == value) {
            Some((_, count)) => *count += 1,
            None => known.push((value, 1)),
        }
    }
    for (key, values) in values.iter().filter(|(_, values)| values.len() > 1) {
        let said =
            |(value, count): &(String, u64)| format!("{value} in {}", counted(*count, "run"));
        let said: Vec<String> = values.iter().map(said).collect();
        notes.push(format!(
            "{world}: the runs were evaluated differently: {key} is {}.",
            said.join(", ")
        ));
    }
    notes
}

/// Why rows of a world have no regret, and what to do about it.
fn without_regret(world: &str, here: &[&Results]) -> Vec<String> {
    let mut found: Vec<(&Regret, Vec<f64>)> = Vec::new();
    for group in here.iter().flat_map(|of| &of.groups).filter(|group| group.env == world) {
        let unknown = |regret: &&Regret| matches!(regret, Regret::NotShipped | Regret::Refused(_));
        for regret in group.runs.iter().map(|run| &run.regret).filter(unknown) {
            match found.iter_mut().find(|(known, _)| *known == regret) {
                Some((_, etas)) if etas.contains(&group.eta) => {}
                Some((_, etas)) => etas.push(group.eta),
                None => found.push((regret, vec![group.eta])),
            }
        }
    }
    let said = |(why, etas): &(&Regret, Vec<f64>)| {
        let why = match why {
            Regret::Refused(why) => format!("the best CVaR cannot be computed: {why}"),
            _ => format!(
                "no certificate of the best CVaR comes with the program for these constants and budgets. \
                 Runs have it that are trained with --set evaluation.oracle=computed, which takes \
                 minutes; cvar-game exact --env {world} --eta {} (with the --set of your constants) \
                 gives the number alone",
                etas[0]
            ),
        };
        let etas: Vec<String> = etas.iter().map(f64::to_string).collect();
        format!("{world}, eta = {}: some rows have no regret, because {why}.", etas.join(", "))
    };
    found.iter().map(said).collect()
}

/// Marks, among the rows of each task, the best value of each column and what is not distinguishable from
/// it.
fn mark(rows: &mut [Row]) {
    let tasks = rows.iter().map(|row| row.task + 1).max().unwrap_or_default();
    for task in 0..tasks {
        // What some seeds of a row do not reach is not its best.
        let trained = |row: &&mut Row| row.task == task && !row.reference && row.failures == 0;
        let mut rows: Vec<&mut Row> = rows.iter_mut().filter(trained).collect();
        for (place, column) in COLUMNS.iter().enumerate() {
            match column.best {
                Best::None => {}
                Best::Highest => mark_among(&mut rows, place, 1.0),
                Best::Lowest => mark_among(&mut rows, place, -1.0),
                Best::HighestOfEta | Best::LowestOfEta => {
                    let sign = if column.best == Best::HighestOfEta { 1.0 } else { -1.0 };
                    for rows in rows.chunk_by_mut(|a, b| a.eta == b.eta) {
                        mark_among(rows, place, sign);
                    }
                }
            }
        }
    }
}

fn mark_among(rows: &mut [&mut Row], place: usize, sign: f64) {
    // The interval, turned so that more is better, with the value in front.
    let score = |row: &&mut Row| match row.cells[place] {
        Cell::Estimate(Estimate { value, interval: Some(Interval { low, high }) }) => {
            let (worst, best) = if sign > 0.0 { (low, high) } else { (-high, -low) };
            Some((sign * value, worst, best))
        }
        _ => None,
    };
    let scores: Vec<Option<(f64, f64, f64)>> = rows.iter().map(score).collect();
    let known = || scores.iter().flatten();
    let Some(best) = known().max_by(|a, b| a.0.total_cmp(&b.0)) else { return };
    if known().count() > 1 {
        for (row, score) in rows.iter_mut().zip(&scores) {
            row.best[place] = score.is_some_and(|(_, _, reach)| reach >= best.1);
        }
    }
}

/// The runs that do not reach the goal, by row.
fn without_goal(runs: &[Run]) -> Option<String> {
    let failed = runs.iter().filter(|run| run.failed && run.evaluation.is_some());
    let mut rows: Vec<(String, Vec<String>)> = Vec::new();
    for run in failed {
        let (of, seed) = (&run.name, run.name.seed.to_string());
        let label = run.label.as_ref().map_or(String::new(), |label| format!(", {label}"));
        let row = format!("{}, {}{label}, eta = {}", of.world, of.label(), of.eta);
        match rows.last_mut() {
            Some((last, seeds)) if *last == row => seeds.push(seed),
            _ => rows.push((row, vec![seed])),
        }
    }
    let said: Vec<String> =
        rows.iter().map(|(row, seeds)| format!("{row}: {}", seeds.join(", "))).collect();
    (!said.is_empty()).then(|| format!("Seeds that do not reach the goal: {}.", said.join("; ")))
}

/// What is wrong with a run.
fn warnings(run: &Run) -> Vec<String> {
    let mut warnings = Vec::new();
    let name = &run.name;
    if let Some(failure) = &run.failure {
        let counted = if run.evaluation.is_some() {
            "Its evaluation counts all the same."
        } else {
            "It has no returns: IQM, worst seed and P(better) rank it below all, and the columns `all` count it as the \
             least return that is possible."
        };
        warnings.push(format!("FAILED: {name} ({failure}). {counted}"));
    }
    if let Some(audit) = run.evaluation.as_ref().and_then(|evaluation| evaluation.audit)
        && audit.violations > 0
    {
        warnings.push(format!(
            "BUDGET VIOLATED: {name}, {} in {} (largest use {:.6} of the budget): \
             its game value proves nothing.",
            counted(audit.violations, "violation"),
            counted(audit.trajectories, "trajectory"),
            audit.max_budget_use
        ));
    }
    if let Some((slack, error)) = slack(run)
        && leaks(slack, error)
    {
        warnings.push(format!(
            "BUDGET LEAKS: {name}, its game value lies {:.4} (standard error {error:.4}) below the \
             sampled CVaR_1/eta, which no admissible antagonist can do.",
            -slack
        ));
    }
    warnings
}

/// Game value minus sampled CVaR_1/eta of a run with an antagonist, and its standard error.
fn slack(run: &Run) -> Option<(f64, f64)> {
    let nominal = run.law(Mode::Sampled, Chance::Nominal).filter(|_| run.name.eta > 1.0)?;
    let game = run.game_law(Mode::Sampled)?;
    let slack = game.mean() - statistics::cvar(nominal, run.alpha())?;
    Some((slack, game.mean_standard_error().hypot(nominal.cvar_standard_error(run.alpha()))))
}

fn leaks(slack: f64, error: f64) -> bool {
    slack < -LEAK_ERRORS * error - 1e-9
}

/// The audits and the bound over all runs of a world, in words.
fn checks(groups: &[&Group]) -> String {
    let runs = || groups.iter().flat_map(|group| group.runs);
    let mut checks = String::new();
    let audits: Vec<Audit> = runs().filter_map(|run| run.evaluation.as_ref()?.audit).collect();
    if !audits.is_empty() {
        let trajectories = audits.iter().map(|audit| audit.trajectories).sum();
        let violations: u64 = audits.iter().map(|audit| audit.violations).sum();
        let most = audits.iter().map(|audit| audit.max_budget_use).fold(0.0, f64::max);
        checks += &format!(
            "Budget audit: {} in {}, largest use {most:.6} of the budget. ",
            counted(violations, "violation"),
            counted(trajectories, "trajectory")
        );
    }
    let slacks: Vec<(f64, f64)> = runs().filter_map(slack).collect();
    if !slacks.is_empty() {
        let kept = slacks.iter().filter(|(slack, error)| !leaks(*slack, *error)).count();
        let least = slacks.iter().map(|(slack, _)| *slack).fold(f64::INFINITY, f64::min);
        checks += &format!(
            "Bound: game value not below the sampled CVaR_1/eta beyond sampling error in {kept} of {} \
             (least difference {least:.4}).",
            counted(slacks.len() as u64, "run")
        );
    }
    checks.trim_end().to_owned()
}

/// What the laws of a world's runs rest on, kind by kind.
fn episodes(groups: &[&Group]) -> String {
    let kinds = [
        ("greedy", Mode::Greedy, Chance::Nominal),
        ("sampled", Mode::Sampled, Chance::Nominal),
        ("greedy under antagonist", Mode::Greedy, Chance::Antagonist),
        ("sampled under antagonist", Mode::Sampled, Chance::Antagonist),
    ];
    let said = |count: Option<u64>| count.map_or("exact law".to_owned(), thousands);
    let parts = kinds.into_iter().filter_map(|(name, mode, chance)| {
        let runs = groups.iter().flat_map(|group| group.runs);
        let counts: Vec<Option<u64>> =
            runs.filter_map(|run| run.law(mode, chance)).map(ReturnLaw::episodes).collect();
        let (least, most) = (*counts.iter().min()?, *counts.iter().max()?);
        let range = if least == most { String::new() } else { format!("{} to ", said(least)) };
        Some(format!("{name} {range}{}", said(most)))
    });
    format!("Episodes per run: {}", parts.collect::<Vec<String>>().join(", "))
}
