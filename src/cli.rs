//! The verbs of the command line.
//!
//! There are two programs: `cvar-game`, which is not linked to libtorch, and `cvar-game-torch` (crate
//! `cvar-learn`), to which it hands over what needs the networks.
//!
//! Exit codes: 0 done, 1 a run failed, 2 bad input or usage, 75 stopped by SIGTERM and 130 by SIGINT,
//! with checkpoints written: the same command goes on.
//! Answers go to standard output, progress and errors to standard error.

pub mod answer;

use crate::exact::oracle;
use crate::experiment::artefacts::BUILD;
use crate::experiment::config::{
    Config, ConfigError, Device, RunConfig, Setting, WorldConfig, default_constants,
};
use crate::experiment::names::{RunId, WorldName};
use crate::experiment::plan;
use crate::experiment::runner;
use crate::experiment::slurm::{self, Wishes};
use crate::game::budget::Eta;
use crate::{exact, report};
use anyhow::{Context, Result, bail};
use clap::{Args, Parser, Subcommand, ValueEnum};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Exit code of usage errors and bad input.
const BAD_INPUT: u8 = 2;

/// A benchmark for risk-sensitive reinforcement learning by games, with exact yardsticks.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "\
Examples:
  cvar-game bench --config configs/quick.toml
      train and evaluate both worlds at eta 1, 25 and 100, and print the table
  cvar-game train --env lava-grid --eta 25 --seed 1 --steps 1000000
      one run
  cvar-game exact --env lava-grid --eta 25
      the best CVaR_0.04 there is on the grid
  cvar-game config --set env.slip=0.1
      what a configuration comes to; all options are explained in configs/default.toml

Exit codes:
  0 done, 1 a run failed, 2 bad input or usage;
  75 stopped by SIGTERM, 130 by Ctrl-C: the same command goes on where it was"
)]
pub struct Cli {
    #[command(subcommand)]
    /// What is to be done.
    pub verb: Verb,
}

/// A verb.
#[derive(Debug, Subcommand)]
pub enum Verb {
    /// What needs the networks.
    #[command(flatten)]
    Play(PlayVerb),
    /// What needs none.
    #[command(flatten)]
    Look(LookVerb),
}

/// What needs the networks: carried out by `cvar-game-torch`.
#[expect(missing_docs, reason = "the text of a verb stands on its arguments")]
#[derive(Debug, Subcommand)]
pub enum PlayVerb {
    Bench(BenchArgs),
    Train(TrainArgs),
    Evaluate(EvaluateArgs),
    Rollout(RolloutArgs),
    /// Carries out the run of a folder, for `bench`.
    #[command(hide = true)]
    Worker {
        /// Folder of the run.
        #[arg(long)]
        folder: PathBuf,
    },
}

/// What needs none: solving the worlds, reports.
#[expect(missing_docs, reason = "the text of a verb stands on its arguments")]
#[derive(Debug, Subcommand)]
pub enum LookVerb {
    Exact(ExactArgs),
    Table(TableArgs),
    Figures(FiguresArgs),
    Report(ReportArgs),
    Slurm(SlurmArgs),
    Envs(EnvsArgs),
    Config(PrintArgs),
}

/// Which configuration.
#[derive(Debug, Args)]
pub struct Overrides {
    /// Sets one option over file and default; the value is TOML. `env.KEY` means that key in every
    /// selected world that has it. May be repeated; a later one wins.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
}

impl Overrides {
    /// The configuration of these overrides, with `options` of the command line over them.
    ///
    /// # Errors
    /// If a setting is not one, or a key or value is refused.
    pub fn resolve(
        &self,
        file: Option<&Path>,
        options: Vec<Setting>,
    ) -> Result<Config, ConfigError> {
        let settings: Result<Vec<Setting>, _> =
            self.settings.iter().map(|text| Setting::parse(text)).collect();
        let mut settings = settings?;
        settings.extend(options);
        Config::resolve(file, &settings)
    }
}

/// Train and evaluate every run of a configuration, then print the table of results.
///
/// Finished runs are kept and unfinished ones go on from their last checkpoint: the same command goes
/// on where it was stopped, with the same results. Several may work on one folder at once, on one
/// machine or many: no run is done twice.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game bench --config configs/quick.toml
  cvar-game bench --config configs/paper.toml --out results/slippery --set env.slip=0.1
  cvar-game bench --config configs/quick.toml --jobs 1 --set 'experiment.seeds=[1]' --out /tmp/try
  cvar-game bench --config configs/paper.toml --only lava-grid/eta-25/seed-3")]
pub struct BenchArgs {
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Output folder [default: results/ and the name of the configuration file].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Runs at the same time, one thread each [default: the processor's cores].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub jobs: Option<NonZeroUsize>,
    /// This run of the configuration alone, and no table: for schedulers, one task per run.
    #[arg(long, value_name = "RUN_ID")]
    pub only: Option<RunId>,
    /// Device of the networks: cpu, cuda or cuda:N.
    #[arg(long)]
    pub device: Option<Device>,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// Train and evaluate one run.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game train --env lava-grid --eta 25 --seed 1 --steps 1000000
  cvar-game train --env lava-point --eta 1 --seed 7 --set train.protagonist.minibatch=500 --json")]
pub struct TrainArgs {
    /// World: lava-grid or lava-point.
    #[arg(long)]
    pub env: WorldName,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true)]
    pub eta: f64,
    /// Seed of all that is random, a whole number from 0.
    #[arg(long, allow_negative_numbers = true, value_parser = clap::value_parser!(i64).range(0..))]
    pub seed: i64,
    /// Environment steps.
    #[arg(long, allow_negative_numbers = true)]
    pub steps: Option<i64>,
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Output folder; the run gets its own folder in it.
    #[arg(long, value_name = "DIR", default_value = "results/train")]
    pub out: PathBuf,
    /// Device of the networks: cpu, cuda or cuda:N.
    #[arg(long)]
    pub device: Option<Device>,
    /// End with one JSON object on standard output.
    #[arg(long)]
    pub json: bool,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// Play episodes with the players of a finished run.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game evaluate results/quick/lava-grid/eta-25/seed-1
  cvar-game evaluate results/quick/lava-point/eta-25/seed-1 --antagonist learned --episodes 1000000")]
pub struct EvaluateArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN_DIR")]
    pub folder: PathBuf,
    /// Who decides the law of chance.
    #[arg(long, value_enum, default_value_t = Antagonist::Nominal)]
    pub antagonist: Antagonist,
    /// Episodes of each play [default: as the run was evaluated].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub episodes: Option<u64>,
    /// Seed of the episodes [default: as the run was evaluated].
    #[arg(long)]
    pub seed: Option<u64>,
    /// Answer as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Play episodes with the players of a finished run and write every step of them.
///
/// A row per step, to standard output. CSV: `episode`, `t`, what the world's state is before the step
/// (grid: `x`, `y`, in cells; point: `x`, `y` in m, `vx`, `vy` in m/s), the chosen `action` (point:
/// `action_x`, `action_y`, before it is scaled onto the unit disc), what chance decided (grid:
/// `executed`, the move; point: `xi_x`, `xi_y`, the noise), its likelihood ratio `delta`, the remaining
/// `budget` before the step, `reward`, `clearance` to lava after the step, and how the episode `end`ed
/// with it (`goal`, `lava`, `timeout`, or nothing). JSON: an object per step and line, with these names.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game rollout --run results/quick/lava-grid/eta-25/seed-1 --episodes 1000 > episodes.csv
  cvar-game rollout --run results/quick/lava-point/eta-25/seed-1 --antagonist learned --format json")]
pub struct RolloutArgs {
    /// Folder of the run.
    #[arg(long, value_name = "DIR")]
    pub run: PathBuf,
    /// Number of episodes.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
    pub episodes: u64,
    /// Format of the rows.
    #[arg(long, value_enum, default_value_t = RowFormat::Csv)]
    pub format: RowFormat,
    /// How the protagonist picks its actions.
    #[arg(long, value_enum, default_value_t = Picking::Greedy)]
    pub protagonist: Picking,
    /// Who decides the law of chance.
    #[arg(long, value_enum, default_value_t = Antagonist::Nominal)]
    pub antagonist: Antagonist,
    /// Seed of the episodes [default: as the run was evaluated].
    #[arg(long)]
    pub seed: Option<u64>,
}

/// Format of rows.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum RowFormat {
    /// A table with a head.
    Csv,
    /// An object per line.
    Json,
}

/// How the protagonist picks its actions.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum Picking {
    /// The mode of its policy.
    Greedy,
    /// A draw from its policy.
    Sampled,
}

/// Who decides the law of chance.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum Antagonist {
    /// None: chance follows its nominal law.
    Nominal,
    /// The antagonist that was trained with the protagonist.
    Learned,
    /// The exact worst case for the greedy protagonist (lava-grid).
    Exact,
}

/// Solve a world: the best CVaR there is, and how to reach it.
///
/// lava-grid is solved exactly. On lava-point a near-optimal controller is computed on a lattice and
/// played in the physical world, which takes minutes; what it attains there is a lower bound on the
/// best CVaR. The certificates of the default world at eta 1, 2, 5, 10, 25, 50 and 100 come with the
/// program; others are kept in $XDG_CACHE_HOME/cvar-game/oracle, by default under ~/.cache.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game exact --env lava-grid --eta 25
  cvar-game exact --env lava-grid --eta 100 --set env.slip=0.1 --json
  cvar-game exact --env lava-point --eta 25
  cvar-game exact --env lava-point --eta 25 --cell 0.2 --velocity 0.75")]
pub struct ExactArgs {
    /// World: lava-grid or lava-point.
    #[arg(long)]
    pub env: WorldName,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true)]
    pub eta: f64,
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// lava-point: distance of the lattice's positions, in m [default: 0.1].
    #[arg(long, value_name = "M")]
    pub cell: Option<f64>,
    /// lava-point: distance of the lattice's velocities, in m/s [default: 0.5].
    #[arg(long, value_name = "M/S")]
    pub velocity: Option<f64>,
    /// lava-point: compute, though a certificate is known.
    #[arg(long)]
    pub anew: bool,
    /// Answer as JSON.
    #[arg(long)]
    pub json: bool,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// Make the table of results of a folder again and print it.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game table results/quick
  cvar-game table results/paper --compare results/ablations/executed --compare my-method")]
pub struct TableArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// Another such folder, to be put beside DIR in comparison.md, .csv and .tex. May be repeated.
    #[arg(long, value_name = "DIR")]
    pub compare: Vec<PathBuf>,
    /// Print the table as JSON and write nothing.
    #[arg(long)]
    pub json: bool,
}

/// Draw the figures of a results folder into its subfolder `figures`, as SVG and PNG.
#[derive(Debug, Args)]
pub struct FiguresArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Write everything about a results folder anew: tables, figures and report.html.
///
/// The page needs no network and no other file.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Hand a sweep to Slurm: a job array with one task per run, then a job that makes the table.
///
/// Writes the scripts to DIR/slurm. A task that reaches its time limit writes a checkpoint and is put
/// into the queue again; the runs that are finished are left out.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game slurm --config configs/paper.toml --out /scratch/me/paper --time 2:00:00 --submit
  cvar-game slurm --config configs/paper.toml --out sweep --array-limit 50 --extra=--mem=2G
      then look at sweep/slurm and run sweep/slurm/submit.sh")]
pub struct SlurmArgs {
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Output folder, on a file system that all nodes share and that has locks.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Time limit of a task, as sbatch takes it [default: the partition's].
    #[arg(long)]
    pub time: Option<String>,
    /// Partition [default: the cluster's].
    #[arg(long)]
    pub partition: Option<String>,
    /// Most tasks at a time [default: as many as the cluster gives].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    pub array_limit: Option<NonZeroUsize>,
    /// Another option of sbatch, such as --extra=--mem=2G. May be repeated.
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true)]
    pub extra: Vec<String>,
    /// Submit the jobs as well.
    #[arg(long)]
    pub submit: bool,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// List the worlds with their constants.
#[derive(Debug, Args)]
pub struct EnvsArgs {
    /// Answer as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Print the resolved configuration as TOML.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game config --config configs/quick.toml
  cvar-game config --env lava-point --set env.noise=2 > windy.toml")]
pub struct PrintArgs {
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// This world alone.
    #[arg(long)]
    pub env: Option<WorldName>,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

fn at_least_one(text: &str) -> Result<NonZeroUsize, String> {
    text.parse().map_err(|_| "use a whole number of at least 1".to_owned())
}

/// Carries out what the command line asks for, and hands over to the program beside this one what
/// needs the networks: loading libtorch takes longer than solving the grid.
///
/// # Errors
/// On bad input, before anything is overwritten.
pub fn run(cli: Cli) -> Result<ExitCode> {
    match cli.verb {
        Verb::Look(verb) => look(verb),
        Verb::Play(_) => hand_over(),
    }
}

/// The program that plays, beside this one.
const PLAYER: &str = "cvar-game-torch";
/// How the one tells it to the other.
const BUILD_VARIABLE: &str = "CVAR_GAME_BUILD";

/// Becomes the program that plays.
fn hand_over() -> Result<ExitCode> {
    let this = std::env::current_exe().context("the system does not tell this program's path")?;
    let player = this.with_file_name(format!("{PLAYER}{}", std::env::consts::EXE_SUFFIX));
    if !player.exists() {
        bail!(
            "training and playing need {}, which is not there; run `cargo xtask setup`, then \
             `cargo build --release`, which makes both programs",
            player.display()
        );
    }
    let mut command = Command::new(&player);
    command.args(std::env::args_os().skip(1)).env(BUILD_VARIABLE, BUILD);
    #[cfg(unix)]
    let error = std::os::unix::process::CommandExt::exec(&mut command);
    #[cfg(not(unix))]
    let error = match command.status() {
        Ok(status) => return Ok(ExitCode::from(status.code().unwrap_or(1) as u8)),
        Err(error) => error,
    };
    Err(error).with_context(|| format!("cannot start {}", player.display()))
}

/// For the program that plays: refuses to work for a `cvar-game` of other sources.
///
/// # Errors
/// If the two are not of one build.
pub fn check_build() -> Result<()> {
    if std::env::var(BUILD_VARIABLE).is_ok_and(|build| build != BUILD) {
        bail!("cvar-game and {PLAYER} beside it are not of one build; run `cargo build --release`");
    }
    Ok(())
}

/// Carries out what needs no network.
///
/// # Errors
/// On bad input, before anything is overwritten.
pub fn look(verb: LookVerb) -> Result<ExitCode> {
    match verb {
        LookVerb::Exact(args) => exact(&args),
        LookVerb::Table(args) => table(&args),
        LookVerb::Figures(args) => figures(&args),
        LookVerb::Report(args) => report(&args.folder),
        LookVerb::Slurm(args) => slurm(&args),
        LookVerb::Envs(args) => envs(&args),
        LookVerb::Config(args) => {
            let options = args.env.map(select).into_iter().collect();
            let config = args.overrides.resolve(args.config.as_deref(), options)?;
            answer::print(&config.to_toml())
        }
    }
}

/// The option `--env`.
pub fn select(world: WorldName) -> Setting {
    Setting::option("--env", "experiment.envs", vec![world.as_str()])
}

/// The option `--eta`.
///
/// # Errors
/// If it is no budget.
pub fn budget(eta: f64) -> Result<Setting> {
    let eta = Eta::new(eta).context("--eta")?;
    Ok(Setting::option("--eta", "experiment.etas", vec![eta.get()]))
}

fn exact(args: &ExactArgs) -> Result<ExitCode> {
    let options = vec![select(args.env), budget(args.eta)?];
    let config = args.overrides.resolve(args.config.as_deref(), options)?;
    let (gamma, eta) = (config.gamma, config.experiment.etas[0].get());
    match &config.world(args.env).constants {
        WorldConfig::LavaGrid(grid) => {
            answer::give(&exact::grid::solve(grid, gamma, eta)?, args.json)
        }
        WorldConfig::LavaPoint(point) => {
            let mut effort = oracle::Effort::default();
            effort.lattice.cell = args.cell.unwrap_or(effort.lattice.cell);
            effort.lattice.velocity = args.velocity.unwrap_or(effort.lattice.velocity);
            let certified = match (oracle::cache_folder(), args.anew) {
                (None, _) => oracle::certify_with(point, gamma, eta, &effort)?,
                (Some(folder), true) => oracle::certify_anew(point, gamma, eta, &effort, &folder)?,
                (Some(folder), false) => {
                    oracle::certify_cached(point, gamma, eta, &effort, &folder)?
                }
            };
            answer::give(&certified, args.json)
        }
    }
}

fn table(args: &TableArgs) -> Result<ExitCode> {
    if args.json {
        return answer::print_json(&report::table_json(&args.folder, &args.compare)?);
    }
    answer::print(&if args.compare.is_empty() {
        report::write(&args.folder)?
    } else {
        report::write_comparison(&args.folder, &args.compare)?
    })
}

fn figures(args: &FiguresArgs) -> Result<ExitCode> {
    let figures = report::write_figures(&args.folder)?;
    tell_missing(&figures);
    answer::print(&format!(
        "{} figures written to {}",
        figures.drawn.len(),
        args.folder.join("figures").display()
    ))
}

fn report(folder: &Path) -> Result<ExitCode> {
    let written = report::write_all(folder)?;
    tell_missing(&written.figures);
    answer::print(&folder.join("report.html").display().to_string())
}

/// Says which figures the artefacts did not allow.
fn tell_missing(figures: &report::figures::Figures) {
    if !figures.missing.is_empty() {
        eprintln!("left out, for want of artefacts: {}", figures.missing.join("; "));
    }
}

fn slurm(args: &SlurmArgs) -> Result<ExitCode> {
    let config = args.overrides.resolve(Some(&args.config), Vec::new())?;
    let prepared = runner::prepare(&config, &plan::runs(&config), &args.out)?;
    if prepared.todo.is_empty() {
        return answer::print("all runs are finished; `cvar-game table` makes their table");
    }
    let runs: Vec<RunId> = prepared.todo.iter().map(RunConfig::id).collect();
    let wishes = Wishes {
        time: args.time.clone(),
        partition: args.partition.clone(),
        array_limit: args.array_limit,
        extra: args.extra.clone(),
    };
    let program =
        std::env::current_exe().context("the system does not tell this program's path")?;
    let submit = slurm::write(&config, &runs, &args.out, &program, &wishes)
        .with_context(|| format!("cannot write to {}", args.out.display()))?;
    if !args.submit {
        let (count, submit) = (runs.len(), submit.display());
        return answer::print(&format!("{count} runs to do; submit them with: sh '{submit}'"));
    }
    let status = Command::new("sh").arg(&submit).status().context("cannot start sh")?;
    if !status.success() {
        bail!("sbatch refused the sweep; its scripts are in {}", args.out.join("slurm").display());
    }
    Ok(ExitCode::SUCCESS)
}

fn envs(args: &EnvsArgs) -> Result<ExitCode> {
    if !args.json {
        let texts: Vec<&str> = WorldName::ALL.into_iter().map(default_constants).collect();
        return answer::print(&texts.join("\n"));
    }
    let config = Config::resolve(None, &[])?;
    let mut constants = serde_json::Map::new();
    for settings in config.worlds.values() {
        // An enum with its name outside: one object with one entry per world.
        if let serde_json::Value::Object(world) = serde_json::to_value(&settings.constants)? {
            constants.extend(world);
        }
    }
    answer::print_json(&constants)
}

/// The exit code of a result; an error is told in one line.
pub fn tell(result: Result<ExitCode>) -> ExitCode {
    result.unwrap_or_else(|error| {
        eprintln!("error: {}", one_line(&error));
        ExitCode::from(BAD_INPUT)
    })
}

/// An error and its causes in one line.
fn one_line(error: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        // Most errors of the library tell their cause themselves.
        if !line.contains(&cause) {
            line = if line.is_empty() { cause } else { format!("{line}: {cause}") };
        }
    }
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}
