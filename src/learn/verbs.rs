//! The verbs that train and play.

pub mod answer;
mod progress;

use crate::protocol::evaluation::{Request, evaluate_run};
use crate::protocol::failure::RunError;
use crate::protocol::run::execute;
use crate::protocol::steps::{Format, Wanted, write_rollout};
use anyhow::{Context, Result, bail};
use cvar_game::cli::answer::{give, print};
use cvar_game::cli::{
    self, Antagonist, BenchArgs, Cli, EvaluateArgs, Picking, PlayVerb, RolloutArgs, RowFormat,
    TrainArgs, Verb, budget, select,
};
use cvar_game::experiment::artefacts::{Chance, Mode};
use cvar_game::experiment::config::{Config, Device, RunConfig, Setting};
use cvar_game::experiment::names::RunId;
use cvar_game::experiment::plan;
use cvar_game::experiment::runner::{
    self, Failure, InProcess, Launcher, Outcome, Prepared, Report, Workers,
};
use cvar_game::experiment::stop::{self, Stop};
use cvar_game::report;
use progress::Progress;
use std::io::{self, BufWriter};
use std::num::NonZeroUsize;
use std::path::Path;
use std::process::ExitCode;

/// Exit code of a program whose runs have failed.
const FAILED: u8 = 1;

/// Carries out what the command line asks for.
///
/// # Errors
/// On bad input, before anything is overwritten.
pub fn run(cli: Cli) -> Result<ExitCode> {
    cli::check_build()?;
    match cli.verb {
        Verb::Look(verb) => cli::look(verb),
        Verb::Play(verb) => play(verb),
    }
}

fn play(verb: PlayVerb) -> Result<ExitCode> {
    match verb {
        PlayVerb::Bench(args) => bench(&args),
        PlayVerb::Train(args) => train(&args),
        PlayVerb::Evaluate(args) => evaluate(&args),
        PlayVerb::Rollout(args) => rollout(&args),
        PlayVerb::Worker { folder } => Ok(ExitCode::from(runner::work(&folder, carry_out))),
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
    let mut runs = plan::runs(&config);
    if let Some(only) = args.only {
        if !runs.contains(&only) {
            bail!("--only {only}: the configuration has no such run; its first one is {}", runs[0]);
        }
        runs = vec![only];
    }
    let prepared = prepare(&config, &runs, &out)?;
    let jobs = match args.jobs {
        Some(jobs) => jobs,
        None => std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN),
    };
    let stop = Stop::on_signals().context("cannot listen to signals")?;
    let outcome = sweep(&prepared, jobs, &Workers::of_this_program()?, &stop);
    let any_finished = outcome.finished + prepared.finished.len() > 0;
    let code = tell_end(&outcome);
    if outcome.stopped.is_none() && args.only.is_none() && any_finished {
        let written = report::write_all(&out)?;
        print(&written.table)?;
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
    let prepared = prepare(&config, &[id], &args.out)?;
    let outcome = if prepared.todo.is_empty() {
        eprintln!("{id} has finished before; remove its folder to run it again");
        Outcome::default()
    } else {
        let stop = Stop::on_signals().context("cannot listen to signals")?;
        sweep(&prepared, NonZeroUsize::MIN, &InProcess(carry_out), &stop)
    };
    let folder = id.folder(&args.out);
    let code = tell_end(&outcome);
    match runner::read_evaluation(&folder)? {
        Some(evaluation) if code == ExitCode::SUCCESS => {
            let summary = answer::Summary::new(&evaluation, &folder);
            give(&summary, args.json)
        }
        _ => Ok(code),
    }
}

/// Checks everything that can be checked before the first run starts.
fn prepare(config: &Config, runs: &[RunId], out: &Path) -> Result<Prepared> {
    let prepared = runner::prepare(config, runs, out)?;
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

/// Tells why runs did not finish; the exit code.
fn tell_end(outcome: &Outcome) -> ExitCode {
    for (run, reason) in &outcome.failed {
        eprintln!("error: {run} failed: {reason}");
    }
    if let Some(signal) = outcome.stopped {
        eprintln!("stopped; finished runs are kept, and the same command goes on with the rest");
        return ExitCode::from(stop::exit_code(signal));
    }
    if outcome.failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn device(device: Device) -> Setting {
    Setting::option("--device", "device", device.to_string())
}

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

fn evaluate(args: &EvaluateArgs) -> Result<ExitCode> {
    let request =
        Request { chance: chance(args.antagonist), episodes: args.episodes, seed: args.seed };
    let run = read_run(&args.folder)?;
    require_device(run.device)?;
    let plays = evaluate_run(&args.folder, &request)?;
    give(&answer::Plays::new(run.id(), &plays, &run.evaluation.alphas), args.json)
}

fn rollout(args: &RolloutArgs) -> Result<ExitCode> {
    let run = read_run(&args.run)?;
    require_device(run.device)?;
    let wanted = Wanted {
        mode: match args.protagonist {
            Picking::Greedy => Mode::Greedy,
            Picking::Sampled => Mode::Sampled,
        },
        request: Request {
            chance: chance(args.antagonist),
            episodes: Some(args.episodes),
            seed: args.seed,
        },
        format: match args.format {
            RowFormat::Csv => Format::Csv,
            RowFormat::Json => Format::Json,
        },
    };
    match write_rollout(&args.run, &wanted, &mut BufWriter::new(io::stdout().lock())) {
        // A reader that has heard enough (`| head`) is no error.
        Err(RunError::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => {}
        result => result?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Carries out a run for the runner, which wants its failure in words.
fn carry_out(
    run: &RunConfig,
    folder: &Path,
    stop: &Stop,
    report: &mut dyn FnMut(Report),
) -> Result<(), Failure> {
    execute(run, folder, stop, report).map_err(|error| match error {
        RunError::Unfinished => Failure::Unfinished,
        error => Failure::Failed(error.to_string()),
    })
}

fn chance(antagonist: Antagonist) -> Chance {
    match antagonist {
        Antagonist::Nominal => Chance::Nominal,
        Antagonist::Learned => Chance::Antagonist,
        Antagonist::Exact => Chance::Exact,
    }
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
