//! The verbs of the command line.
//!
//! Exit codes: 0 done, 1 a run failed, 2 bad input or usage, 130 and 143 stopped by SIGINT and SIGTERM.
//! Answers go to standard output, progress and errors to standard error.

mod answer;
mod progress;

use anyhow::{Context, Result, bail};
use clap::{Args, Parser, Subcommand, ValueEnum};
use cvar_game::exact::oracle;
use cvar_game::experiment::config::{
    Config, ConfigError, Device, RunConfig, Setting, WorldConfig, default_constants,
};
use cvar_game::experiment::names::WorldName;
use cvar_game::experiment::plan;
use cvar_game::experiment::runner::{self, Launcher, Outcome, Prepared, Stop, Workers};
#[cfg(feature = "torch")]
use cvar_game::experiment::{artefacts::Chance, runner::InProcess};
use cvar_game::game::budget::Eta;
use cvar_game::{exact, report};
use progress::Progress;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Exit code of a program whose runs have failed.
const FAILED: u8 = 1;
/// Exit code of usage errors and bad input.
pub const BAD_INPUT: u8 = 2;

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
      what a configuration comes to; all options are explained in configs/default.toml"
)]
pub struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Bench(BenchArgs),
    Train(TrainArgs),
    Evaluate(EvaluateArgs),
    Exact(ExactArgs),
    Table(TableArgs),
    Envs(EnvsArgs),
    Config(PrintArgs),
    /// Carries out the run of a folder, for `bench`.
    #[command(hide = true)]
    Worker {
        #[arg(long)]
        folder: PathBuf,
    },
}

/// Which configuration.
#[derive(Debug, Args)]
struct Overrides {
    /// Sets one option over file and default; the value is TOML. `env.KEY` means that key in every
    /// selected world that has it. May be repeated; a later one wins.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

impl Overrides {
    /// The configuration of these overrides, with `options` of the command line over them.
    fn resolve(&self, file: Option<&Path>, options: Vec<Setting>) -> Result<Config, ConfigError> {
        let settings: Result<Vec<Setting>, _> =
            self.settings.iter().map(|text| Setting::parse(text)).collect();
        let mut settings = settings?;
        settings.extend(options);
        Config::resolve(file, &settings)
    }
}

/// Train and evaluate every run of a configuration, then print the table of results.
///
/// Finished runs are kept: the same command goes on where it was stopped.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game bench --config configs/quick.toml
  cvar-game bench --config configs/paper.toml --out results/slippery --set env.slip=0.1
  cvar-game bench --config configs/quick.toml --jobs 1 --set 'experiment.seeds=[1]' --out /tmp/try")]
struct BenchArgs {
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Output folder [default: results/ and the name of the configuration file].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Runs at the same time, one thread each [default: the processor's cores].
    #[arg(long, value_name = "N", value_parser = at_least_one)]
    jobs: Option<NonZeroUsize>,
    /// Device of the networks: cpu, cuda or cuda:N.
    #[arg(long)]
    device: Option<Device>,
    #[command(flatten)]
    overrides: Overrides,
}

/// Train and evaluate one run.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game train --env lava-grid --eta 25 --seed 1 --steps 1000000
  cvar-game train --env lava-point --eta 1 --seed 7 --set train.protagonist.minibatch=500 --json")]
struct TrainArgs {
    /// World: lava-grid or lava-point.
    #[arg(long)]
    env: WorldName,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true)]
    eta: f64,
    /// Seed of all that is random, a whole number from 0.
    #[arg(long, allow_negative_numbers = true, value_parser = clap::value_parser!(i64).range(0..))]
    seed: i64,
    /// Environment steps.
    #[arg(long, allow_negative_numbers = true)]
    steps: Option<i64>,
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Output folder; the run gets its own folder in it.
    #[arg(long, value_name = "DIR", default_value = "results/train")]
    out: PathBuf,
    /// Device of the networks: cpu, cuda or cuda:N.
    #[arg(long)]
    device: Option<Device>,
    /// End with one JSON object on standard output.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    overrides: Overrides,
}

/// Play episodes with the players of a finished run.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game evaluate results/quick/lava-grid/eta-25/seed-1
  cvar-game evaluate results/quick/lava-point/eta-25/seed-1 --antagonist learned --episodes 1000000")]
struct EvaluateArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN_DIR")]
    folder: PathBuf,
    /// Who decides the law of chance.
    #[arg(long, value_enum, default_value_t = Antagonist::Nominal)]
    antagonist: Antagonist,
    /// Episodes of each play [default: as the run was evaluated].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: Option<u64>,
    /// Seed of the episodes [default: as the run was evaluated].
    #[arg(long)]
    seed: Option<u64>,
    /// Answer as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Antagonist {
    /// None: chance follows its nominal law.
    Nominal,
    /// The antagonist that was trained with the protagonist.
    Learned,
    /// The exact worst case for the greedy protagonist (lava-grid).
    Exact,
}

#[cfg(feature = "torch")]
impl From<Antagonist> for Chance {
    fn from(antagonist: Antagonist) -> Self {
        match antagonist {
            Antagonist::Nominal => Chance::Nominal,
            Antagonist::Learned => Chance::Antagonist,
            Antagonist::Exact => Chance::Exact,
        }
    }
}

/// Solve a world: the best CVaR there is, and how to reach it.
///
/// lava-grid is solved exactly. On lava-point a near-optimal controller is computed on a lattice and
/// played in the physical world, which takes minutes; what it attains there is a lower bound on the
/// best CVaR. The certificate is kept in $XDG_CACHE_HOME/cvar-game/oracle, by default under ~/.cache.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game exact --env lava-grid --eta 25
  cvar-game exact --env lava-grid --eta 100 --set env.slip=0.1 --json
  cvar-game exact --env lava-point --eta 25")]
struct ExactArgs {
    /// World: lava-grid or lava-point.
    #[arg(long)]
    env: WorldName,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true)]
    eta: f64,
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Answer as JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    overrides: Overrides,
}

/// Make the table of results of a folder again and print it.
#[derive(Debug, Args)]
struct TableArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Print the table as JSON and write nothing.
    #[arg(long)]
    json: bool,
}

/// List the worlds with their constants.
#[derive(Debug, Args)]
struct EnvsArgs {
    /// Answer as JSON.
    #[arg(long)]
    json: bool,
}

/// Print the resolved configuration as TOML.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game config --config configs/quick.toml
  cvar-game config --env lava-point --set env.noise=2 > windy.toml")]
struct PrintArgs {
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// This world alone.
    #[arg(long)]
    env: Option<WorldName>,
    #[command(flatten)]
    overrides: Overrides,
}

fn at_least_one(text: &str) -> Result<NonZeroUsize, String> {
    text.parse().map_err(|_| "use a whole number of at least 1".to_owned())
}

/// Carries out what the command line asks for.
///
/// # Errors
/// On bad input, before anything is overwritten.
pub fn run(cli: Cli) -> Result<ExitCode> {
    match cli.verb {
        Verb::Bench(args) => bench(&args),
        Verb::Train(args) => train(&args),
        Verb::Evaluate(args) => evaluate(&args),
        Verb::Exact(args) => exact(&args),
        Verb::Table(args) => table(&args),
        Verb::Envs(args) => envs(&args),
        Verb::Config(args) => {
            let options = args.env.map(select).into_iter().collect();
            let config = args.overrides.resolve(args.config.as_deref(), options)?;
            answer::print(&config.to_toml())
        }
        Verb::Worker { folder } => {
            Ok(if runner::work(&folder) { ExitCode::SUCCESS } else { ExitCode::from(FAILED) })
        }
    }
}

fn bench(args: &BenchArgs) -> Result<ExitCode> {
    let options = args.device.map(device).into_iter().collect();
    let config = args.overrides.resolve(Some(&args.config), options)?;
    let out = match &args.out {
        Some(out) => out.clone(),
        None => {
            Path::new("results").join(args.config.file_stem().context("--config names no file")?)
        }
    };
    let prepared = prepare(&config, &out)?;
    let jobs = match args.jobs {
        Some(jobs) => jobs,
        None => std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN),
    };
    let stop = Stop::on_signals().context("cannot listen to signals")?;
    let outcome = sweep(&prepared, jobs, &Workers::of_this_program()?, &stop);
    if let Some(signal) = outcome.stopped {
        eprintln!("stopped; finished runs are kept, and the same command goes on with the rest");
        return Ok(ExitCode::from(128 + signal as u8));
    }
    let code = tell_failures(&outcome);
    if code == ExitCode::SUCCESS || outcome.finished > 0 {
        answer::print(&report::write(&out)?)?;
        eprintln!("written to {}", out.display());
    }
    Ok(code)
}

fn train(args: &TrainArgs) -> Result<ExitCode> {
    let mut options = vec![
        select(args.env),
        budget(args.eta)?,
        Setting::option("--seed", "experiment.seeds", vec![args.seed]),
    ];
    options.extend(args.steps.map(|steps| Setting::option("--steps", "train.steps", steps)));
    options.extend(args.device.map(device));
    let config = args.overrides.resolve(args.config.as_deref(), options)?;
    let id = plan::runs(&config)[0];
    let prepared = prepare(&config, &args.out)?;
    let outcome = if prepared.todo.is_empty() {
        eprintln!("{id} has finished before; remove its folder to run it again");
        Outcome::default()
    } else {
        Stop::by_ending_the_process().context("cannot listen to signals")?;
        sweep(&prepared, NonZeroUsize::MIN, &InProcess, &Stop::default())
    };
    let folder = id.folder(&args.out);
    let code = tell_failures(&outcome);
    match runner::read_evaluation(&folder)? {
        Some(evaluation) if code == ExitCode::SUCCESS => {
            let summary = answer::Summary::new(&evaluation, &folder);
            answer::give(&summary, args.json)
        }
        _ => Ok(code),
    }
}

/// Checks everything that can be checked before the first run starts.
fn prepare(config: &Config, out: &Path) -> Result<Prepared> {
    let prepared = runner::prepare(config, out)?;
    if !prepared.todo.is_empty() {
        require_device(config.device)?;
    }
    Ok(prepared)
}

/// Carries out the runs with progress on standard error.
fn sweep(prepared: &Prepared, jobs: NonZeroUsize, launcher: &dyn Launcher, stop: &Stop) -> Outcome {
    let mut progress = Progress::new(prepared.todo.len(), prepared.finished.len());
    let outcome = runner::sweep(prepared, jobs, launcher, stop, &mut |event| progress.event(event));
    progress.finish();
    outcome
}

fn tell_failures(outcome: &Outcome) -> ExitCode {
    for (run, reason) in &outcome.failed {
        eprintln!("error: {run} failed: {reason}");
    }
    if outcome.failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn select(world: WorldName) -> Setting {
    Setting::option("--env", "experiment.envs", vec![world.as_str()])
}

fn budget(eta: f64) -> Result<Setting> {
    let eta = Eta::new(eta).context("--eta")?;
    Ok(Setting::option("--eta", "experiment.etas", vec![eta.get()]))
}

fn device(device: Device) -> Setting {
    Setting::option("--device", "device", device.to_string())
}

#[cfg(feature = "torch")]
fn require_device(device: Device) -> Result<()> {
    if let Device::Cuda(number) = device {
        let devices = tch::Cuda::device_count();
        if number as i64 >= devices {
            bail!(
                "device {device} is not there: libtorch sees {devices} CUDA devices; use --device \
                 cpu, or build against a libtorch with CUDA (set LIBTORCH to it) on a machine that \
                 has the device"
            );
        }
    }
    Ok(())
}

#[cfg(not(feature = "torch"))]
fn require_device(_: Device) -> Result<()> {
    bail!("{NO_TORCH}")
}

#[cfg(not(feature = "torch"))]
const NO_TORCH: &str = "this build has no torch, so it cannot train or play; run `cargo xtask setup` \
                        and build with the default features";

#[cfg(not(feature = "torch"))]
struct InProcess;

#[cfg(not(feature = "torch"))]
impl Launcher for InProcess {
    fn launch(
        &self,
        _: &RunConfig,
        _: &Path,
        _: &Stop,
        _: &mut dyn FnMut(runner::Tick),
    ) -> Result<(), runner::Failure> {
        Err(runner::Failure::Failed(NO_TORCH.to_owned()))
    }
}

#[cfg(feature = "torch")]
fn evaluate(args: &EvaluateArgs) -> Result<ExitCode> {
    use cvar_game::experiment::evaluation::{Request, evaluate_run};
    let request =
        Request { chance: args.antagonist.into(), episodes: args.episodes, seed: args.seed };
    let run = read_run(&args.folder)?;
    require_device(run.device)?;
    let plays = evaluate_run(&args.folder, &request)?;
    answer::give(&answer::Plays::new(run.id(), &plays, &run.evaluation.alphas), args.json)
}

#[cfg(not(feature = "torch"))]
fn evaluate(args: &EvaluateArgs) -> Result<ExitCode> {
    read_run(&args.folder)?;
    bail!("{NO_TORCH}")
}

/// The configuration of a finished run.
fn read_run(folder: &Path) -> Result<RunConfig> {
    let path = folder.join("config.toml");
    if !path.exists() {
        bail!(
            "{} holds no run; give the folder of one, such as results/quick/lava-grid/eta-25/seed-1",
            folder.display()
        );
    }
    let run = RunConfig::load(&path)?;
    if runner::read_evaluation(folder)?.is_none() {
        bail!(
            "the run in {} has not finished; go on with the `bench` or `train` that began it",
            folder.display()
        );
    }
    Ok(run)
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
            let effort = oracle::Effort::default();
            let certified = match oracle::cache_folder() {
                Some(folder) => oracle::certify_cached(point, gamma, eta, &effort, &folder)?,
                None => oracle::certify_with(point, gamma, eta, &effort)?,
            };
            answer::give(&certified, args.json)
        }
    }
}

fn table(args: &TableArgs) -> Result<ExitCode> {
    if args.json {
        answer::print_json(&report::table_json(&args.folder)?)
    } else {
        answer::print(&report::write(&args.folder)?)
    }
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

/// An error and its causes in one line.
pub fn one_line(error: &anyhow::Error) -> String {
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
