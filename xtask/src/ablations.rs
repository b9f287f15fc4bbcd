//! What each choice of `configs/paper.toml` is worth, and what the paper's alternatives to it are: sweeps
//! that differ from it in one thing each, in `results/ablations`.

use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::{Context, Result, bail};

/// A sweep: its name, its world, its budgets, and what differs from `configs/paper.toml`, whose options
/// stand in `[env.WORLD.train]`.
struct Ablation(&'static str, &'static str, &'static str, &'static [&'static str]);

const GRID: &str = "lava-grid";
const POINT: &str = "lava-point";
const AVERSE: &str = "[25, 100]";
const ALL: &str = "[1, 25, 100]";

const ABLATIONS: [Ablation; 19] = [
    Ablation("k-1", GRID, AVERSE, &["follower_updates=1"]),
    Ablation("k-4", GRID, AVERSE, &["follower_updates=4"]),
    Ablation("k-8", GRID, AVERSE, &["follower_updates=8"]),
    Ablation("antagonist-leads", GRID, AVERSE, &["leader=\"antagonist\""]),
    Ablation("budget-hidden", GRID, AVERSE, &["hide_budget=true"]),
    Ablation("random-adversary", GRID, AVERSE, &["adversary=\"random\""]),
    Ablation("credit-executed", GRID, ALL, &["credit=\"executed\""]),
    Ablation("time-aware", GRID, ALL, &["protagonist.time_aware=true"]),
    Ablation("budget-unpriced", GRID, AVERSE, &["price_budget=false"]),
    Ablation("minibatch-2500", GRID, AVERSE, &["antagonist.minibatch=2500"]),
    Ablation("budget-at-once", GRID, AVERSE, &["budget_wait=0", "budget_rise=0"]),
    Ablation(
        "entropy-0.01",
        GRID,
        AVERSE,
        &["protagonist.entropy=0.01", "protagonist.entropy_final=0.01"],
    ),
    Ablation("etas", GRID, "[2, 5, 10, 50]", &[]),
    Ablation("point-one-bump", POINT, AVERSE, &["bump.count=1"]),
    Ablation("point-budget-priced", POINT, AVERSE, &["price_budget=true"]),
    Ablation("point-timeless", POINT, AVERSE, &["protagonist.time_aware=false"]),
    Ablation("point-k-1", POINT, AVERSE, &["follower_updates=1"]),
    Ablation("point-k-4", POINT, AVERSE, &["follower_updates=4"]),
    Ablation("point-etas", POINT, "[2, 5, 10, 50]", &[]),
];

/// Runs the sweeps that are not there yet, or one of them, and compares all, and the paper's plain settings,
/// with `results/paper`.
pub fn run(repository: &Path, target: &Path, only: Option<&str>) -> Result<ExitCode> {
    let program = target.join("release/cvar-game");
    let program = || {
        let mut command = Command::new(&program);
        command.current_dir(repository);
        command
    };
    let selected = |name: &str| only.is_none_or(|only| only == name);
    if !ABLATIONS.iter().any(|Ablation(name, ..)| selected(name)) {
        let names: Vec<&str> = ABLATIONS.iter().map(|ablation| ablation.0).collect();
        bail!("no such ablation; there are {}", names.join(", "));
    }
    for Ablation(name, world, etas, options) in ABLATIONS {
        if !selected(name) {
            continue;
        }
        let mut command = program();
        command.args(["bench", "--config", "configs/paper.toml"]);
        command.args(["--out", &format!("results/ablations/{name}")]);
        let mut set = |text: String| {
            command.args(["--set", &text]);
        };
        set(format!("experiment.envs=[\"{world}\"]"));
        set(format!("experiment.etas={etas}"));
        set("experiment.seeds=[1, 2, 3, 4, 5]".to_owned());
        // The maps of the antagonist are drawn for results/paper alone, and its precision is not needed.
        set("evaluation.episodes=20000".to_owned());
        set("evaluation.exhibit_episodes=1000".to_owned());
        options.iter().for_each(|option| set(format!("env.{world}.train.{option}")));
        let status = command.status().context("cvar-game could not be started")?;
        if !status.success() {
            bail!("the sweep {name} ended with {status}");
        }
    }
    let mut command = program();
    command.args(["table", "results/paper"]);
    let ablations = ABLATIONS.map(|Ablation(name, ..)| format!("results/ablations/{name}"));
    for folder in std::iter::once("results/paper-plain".to_owned()).chain(ablations) {
        if repository.join(&folder).is_dir() {
            command.args(["--compare", &folder]);
        }
    }
    let status = command.status().context("cvar-game could not be started")?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
