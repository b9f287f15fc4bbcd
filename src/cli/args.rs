//! The arguments of the command line.

use crate::experiment::archive::PackedWeights;
use crate::experiment::artefacts::Chance;
use crate::experiment::config::Shift;
use crate::experiment::config::{
    BYTES_OF_AN_EPISODE, Catalogue, Config, ConfigError, MOST_EPISODES, Setting, Source,
};
use crate::experiment::names::{MethodName, RunId, WorldName};
use crate::experiment::steps::Format;
use crate::learn::device::Device;
use crate::learn::policy::Mode;
use clap::{Args, Parser, Subcommand};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::str::FromStr;

/// A benchmark for risk-sensitive reinforcement learning by games, with exact yardsticks.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "\
Examples:
  cvar-game bench
      train and evaluate both worlds at eta 1, 25 and 100, and print the table
  cvar-game train --env lava-grid --eta 25 --seed 1 --steps 1000000
      one run
  cvar-game exact --env lava-grid --eta 25
      the best CVaR_0.04 there is on the grid
  cvar-game config --set env.slip=0.1
      the resolved configuration; `cvar-game config --default` explains all options

Exit codes:
  0 done, 1 a run failed, 2 bad input or usage;
  75 stopped by SIGTERM, 130 by Ctrl-C: the same command continues where it was"
)]
pub struct Cli {
    #[command(subcommand)]
    /// What to do.
    pub verb: Verb,
}

/// A verb.
#[expect(missing_docs, reason = "the text of a verb is on its arguments")]
#[derive(Debug, Subcommand)]
pub enum Verb {
    Bench(BenchArgs),
    Train(TrainArgs),
    Evaluate(EvaluateArgs),
    Rollout(RolloutArgs),
    Exact(ExactArgs),
    Table(TableArgs),
    Figures(FiguresArgs),
    Report(ReportArgs),
    Shifts(ShiftsArgs),
    Pack(PackArgs),
    Slurm(SlurmArgs),
    Envs(EnvsArgs),
    Config(PrintArgs),
    Completions(CompletionsArgs),
    Man(ManArgs),
    /// Carry out the run of a folder, for `bench`.
    #[command(hide = true)]
    Worker {
        /// Folder of the run.
        #[arg(long)]
        folder: PathBuf,
    },
}

/// Which configuration.
#[derive(Debug, Args)]
pub struct Overrides {
    /// Sets one option over file and default; the value is TOML. `env.KEY` means that key in every
    /// selected world that has it. May be repeated; a later one wins.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    /// Plays every selected world on this scene: a name that `cvar-game envs` lists, or a TOML file with a map. May be
    /// repeated.
    #[arg(long = "scene", value_name = "NAME|FILE")]
    pub scenes: Vec<String>,
    /// Plays the world `table` on the transitions in this CSV file. May be repeated.
    #[arg(long = "file", value_name = "CSV")]
    pub files: Vec<String>,
}

impl Overrides {
    /// The configuration of these overrides, with `options` of the command line over them.
    ///
    /// # Errors
    /// If a setting is not one, or a key or value is refused.
    pub fn resolve(
        &self,
        catalogue: &Catalogue,
        file: Source<'_>,
        options: Vec<Setting>,
    ) -> Result<Config, ConfigError> {
        let settings: Result<Vec<Setting>, _> =
            self.settings.iter().map(|text| Setting::parse(text)).collect();
        let mut settings = settings?;
        settings.extend(options);
        let scenes = [&self.scenes[..], &self.files].concat();
        Config::resolve_on(catalogue, file, &settings, &scenes)
    }
}

/// Train and evaluate every run of a configuration, then print the table of results.
///
/// Finished runs are kept and unfinished ones continue from their last checkpoint: the same command
/// continues where it was stopped, with the same results. Several may work on one folder at once, on one
/// machine or many: no run is done twice.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game bench --config configs/quick.toml
  cvar-game bench --config configs/paper.toml --out results/slippery --set env.slip=0.1
  cvar-game bench --config configs/quick.toml --jobs 1 --set 'experiment.seeds=[1]' --out /tmp/try
  cvar-game bench --config configs/paper.toml --only lava-grid/game/eta-25/seed-3")]
pub struct BenchArgs {
    /// Configuration file; those of the repository's configs/ are embedded in the program [default:
    /// configs/quick.toml].
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Output folder [default: results/ and the name of the configuration file].
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Runs at the same time, one thread each [default: the processor's cores].
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = at_least_one)]
    pub jobs: Option<NonZeroUsize>,
    /// Carry out only this run of the configuration and write no table: for schedulers, one task per run.
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
  cvar-game train --env lava-grid --scene detour --eta 25 --seed 1
  cvar-game train --env lava-point --eta 1 --seed 7 --set train.protagonist.minibatch=500 --json")]
pub struct TrainArgs {
    /// World, such as lava-grid or lava-point.
    #[arg(long)]
    pub env: WorldName,
    /// Method of training [default: game, the paper's Algorithm 1].
    #[arg(long)]
    pub method: Option<MethodName>,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true)]
    pub eta: f64,
    /// Seed of all that is random, a whole number from 0.
    #[arg(long, allow_negative_numbers = true, value_parser = seed_of_training)]
    pub seed: i64,
    /// Environment steps.
    #[arg(long, allow_negative_numbers = true, value_parser = whole::<i64>)]
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
  cvar-game evaluate results/quick/lava-grid/game/eta-25/seed-1
  cvar-game evaluate results/quick/lava-point/game/eta-25/seed-1 --antagonist learned --episodes 1000000")]
pub struct EvaluateArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN_DIR")]
    pub folder: PathBuf,
    /// Who decides the law of chance.
    #[arg(long, value_enum, default_value_t = Chance::Nominal)]
    pub antagonist: Chance,
    /// Episodes of each play [default: as the run was evaluated].
    #[arg(long, allow_negative_numbers = true, value_parser = kept_episodes)]
    pub episodes: Option<u64>,
    /// Seed of the episodes [default: as the run was evaluated].
    #[arg(long, allow_negative_numbers = true, value_parser = whole::<u64>)]
    pub seed: Option<u64>,
    /// Plays in a world with another constant than in training, such as `env.slip=0.1`. May be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
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
/// `budget` before the step, `reward`, `clearance` to lava after the step, how the episode `end`ed
/// with it (`goal`, `lava`, `timeout`, or empty), and the state after the step (`next_x`, `next_y`, and on
/// lava-point `next_vx`, `next_vy`). JSON: an object per step and line, with these names.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game rollout results/quick/lava-grid/game/eta-25/seed-1 --episodes 1000 > episodes.csv
  cvar-game rollout results/quick/lava-point/game/eta-25/seed-1 --antagonist learned --format json")]
pub struct RolloutArgs {
    /// Folder of the run.
    #[arg(value_name = "RUN_DIR", required_unless_present = "run")]
    pub folder: Option<PathBuf>,
    /// The same as an option, for scripts that were written for former versions.
    #[arg(long, value_name = "DIR", hide = true, conflicts_with = "folder")]
    pub run: Option<PathBuf>,
    /// Number of episodes.
    #[arg(long, default_value_t = 100, allow_negative_numbers = true, value_parser = episodes)]
    pub episodes: u64,
    /// Format of the rows.
    #[arg(long, value_enum, default_value_t = Format::Csv)]
    pub format: Format,
    /// How the protagonist picks its actions.
    #[arg(long, value_enum, default_value_t = Mode::Greedy)]
    pub protagonist: Mode,
    /// Who decides the law of chance.
    #[arg(long, value_enum, default_value_t = Chance::Nominal)]
    pub antagonist: Chance,
    /// Seed of the episodes [default: as the run was evaluated].
    #[arg(long, allow_negative_numbers = true, value_parser = whole::<u64>)]
    pub seed: Option<u64>,
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
  cvar-game exact --env lava-point --eta 25 --cell 0.2 --velocity 0.75
  cvar-game exact --policy results/quick/lava-grid/game/eta-25/seed-1")]
pub struct ExactArgs {
    /// World, such as lava-grid or lava-point.
    #[arg(long, required_unless_present = "policy")]
    pub env: Option<WorldName>,
    /// Budget, at least 1; the risk level is alpha = 1/eta.
    #[arg(long, allow_negative_numbers = true, required_unless_present = "policy")]
    pub eta: Option<f64>,
    /// A finished run's folder, in a finite world: what every single change of its policy is worth, in one cell
    /// another action. At the run's budget, or at --eta.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["env", "config", "cell", "velocity", "upper_cell", "anew", "settings", "scenes", "files"])]
    pub policy: Option<PathBuf>,
    /// Configuration file.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// lava-point: distance of the lattice's positions, in m [default: fits the arena; 0.1 by default].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub cell: Option<f64>,
    /// lava-point: distance of the lattice's velocities, in m/s [default: fits noise and acceleration; 0.5 by default].
    #[arg(long, value_name = "M/S", allow_negative_numbers = true)]
    pub velocity: Option<f64>,
    /// lava-point: side of the cells of the upper bound, in m; with half of it there are sixteen times as many
    /// [default: of a bound that comes with the program its own, else 0.2 for an arena of 10 m x 7 m].
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub upper_cell: Option<f64>,
    /// lava-point: compute even if there is a certificate.
    #[arg(long)]
    pub anew: bool,
    /// Answer as JSON.
    #[arg(long)]
    pub json: bool,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// Write the table of results of a folder again and print it.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game table results/quick
  cvar-game table results/paper --compare results/ablations --compare my-method")]
pub struct TableArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// Another such folder, to be compared with DIR in comparison.md, .csv and .tex. May be repeated.
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

/// Write everything about a results folder again: tables, figures and report.html.
///
/// The page needs no network and no other file.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Judge the trained policies of a results folder where the world is another than in training.
///
/// Writes DIR/shifts.csv, a line per run and value of a constant, and figures: CVaR at 1/eta against the constant, a line
/// per method. In finite worlds the numbers are exact. The runs need their weights.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game shifts results/quick
  cvar-game shifts results/quick --to lava-grid.slip=0.01,0.1,0.3 --to lava-point.noise=1,2")]
pub struct ShiftsArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// A constant of a world and its values; may be repeated [default: slip on lava-grid; noise, acceleration and
    /// what damping leaves of the velocity on lava-point].
    #[arg(long, value_name = "WORLD.CONSTANT=VALUES")]
    pub to: Vec<Shift>,
    /// Episodes per run and value where they must be played [default: as the runs were evaluated].
    #[arg(long, allow_negative_numbers = true, value_parser = kept_episodes)]
    pub episodes: Option<u64>,
}

/// Pack the records of a results folder into one archive, DIR/runs.zip.
///
/// The archive holds what the other verbs read of finished runs, and they read it as if the folders of the
/// runs were there. It is checked before the folders are removed.
#[derive(Debug, Args)]
pub struct PackArgs {
    /// Output folder of `bench` or `train`.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// Whose weights are packed as well.
    #[arg(long, value_name = "WHOSE", default_value = "first", num_args = 0..=1, default_missing_value = "all")]
    pub weights: PackedWeights,
}

/// Hand a sweep to Slurm: a job array with one task per run, then a job that writes the table.
///
/// Writes the scripts to DIR/slurm. A task that reaches its time limit writes a checkpoint and is put
/// into the queue again; finished runs are not submitted.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game slurm --config configs/paper.toml --out /scratch/me/paper --time 2:00:00 --submit
  cvar-game slurm --config configs/paper.toml --out sweep --array-limit 50 --extra=--mem=2G
      then check sweep/slurm and run sweep/slurm/submit.sh")]
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
    #[arg(long, value_name = "N", allow_negative_numbers = true, value_parser = at_least_one)]
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

/// List the worlds with their constants, and the scenes on which they can be played.
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
    /// Only this world.
    #[arg(long)]
    pub env: Option<WorldName>,
    /// Print the annotated default instead: every option with its text, default and range.
    #[arg(long, conflicts_with_all = ["config", "env", "settings", "scenes", "files"])]
    pub default: bool,
    /// Options set on the command line.
    #[command(flatten)]
    pub overrides: Overrides,
}

/// Print the completions of a shell for this program.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game completions bash > ~/.local/share/bash-completion/completions/cvar-game
  cvar-game completions fish > ~/.config/fish/completions/cvar-game.fish")]
pub struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

/// Write the manual pages of this program and of each verb.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  cvar-game man --out ~/.local/share/man/man1")]
pub struct ManArgs {
    /// Output folder.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// A whole number; digits may be grouped, as in 100_000.
fn whole<T: FromStr>(text: &str) -> Result<T, String> {
    let refused = || "use a whole number, such as 100_000".to_owned();
    let is_grouped = text.split('_').all(|group| !group.is_empty());
    let digits = if is_grouped { text.replace('_', "") } else { return Err(refused()) };
    digits.parse().map_err(|_| match digits.strip_prefix('-') {
        Some(digits) if digits.bytes().all(|byte| byte.is_ascii_digit()) => {
            "use a whole number that is not negative".to_owned()
        }
        _ if !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()) => {
            "the number is too large".to_owned()
        }
        _ => refused(),
    })
}

fn at_least_one(text: &str) -> Result<NonZeroUsize, String> {
    whole(text).map_err(|_| "use a whole number of at least 1".to_owned())
}

/// The seed of a run, which is a TOML integer.
fn seed_of_training(text: &str) -> Result<i64, String> {
    let seed = whole(text)?;
    if seed < 0 { Err("use a whole number that is not negative".to_owned()) } else { Ok(seed) }
}

fn episodes(text: &str) -> Result<u64, String> {
    whole(text)
        .and_then(|count| if count == 0 { Err("play at least 1".to_owned()) } else { Ok(count) })
}

/// Episodes that are all in memory at the end.
fn kept_episodes(text: &str) -> Result<u64, String> {
    let count = episodes(text)?;
    if count > MOST_EPISODES {
        let gigabytes = count as f64 * BYTES_OF_AN_EPISODE / 1e9;
        return Err(format!(
            "they would need about {gigabytes:.0} GB of memory; play at most {MOST_EPISODES}"
        ));
    }
    Ok(count)
}
