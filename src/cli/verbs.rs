//! The verbs of the command line.

use super::answer::{give, note, print, print_json};
use super::args::{
    BenchArgs, Cli, CompletionsArgs, EnvsArgs, EvaluateArgs, ExactArgs, FiguresArgs, ManArgs,
    PackArgs, PrintArgs, RolloutArgs, ShiftsArgs, SlurmArgs, TableArgs, TrainArgs, Verb,
};
use super::progress::{Counter, Meter, Progress, Watched};
use super::summary;
use crate::exact::yardstick;
use crate::experiment::archive;
use crate::experiment::artefacts::Chance;
use crate::experiment::config::catalogue::annotated_constants;
use crate::experiment::config::scenes;
use crate::experiment::config::{Config, RunConfig, Setting, Shift, Source, WorldConstants};
use crate::experiment::evaluation;
use crate::experiment::failure::RunError;
use crate::experiment::names::{MethodName, RunId, WorldName, base_of};
use crate::experiment::plan;
use crate::experiment::registry::{Registry, Request};
use crate::experiment::runner::{
    self, Failure, InProcess, Launcher, Outcome, Prepared, Report, Workers,
};
use crate::experiment::slurm::{self, SlurmOptions};
use crate::experiment::stop::{self, Stop};
use crate::experiment::words::counted;
use crate::game::budget::Eta;
use crate::learn::device::Device;
use crate::report;
use anyhow::{Context, Result, bail};
use clap::CommandFactory;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufWriter, IsTerminal};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Exit code of a program whose runs have failed.
const FAILED: u8 = 1;

/// Carries out what the command line asks for. `program` is started again for workers; if `None`, this one.
///
/// # Errors
/// On bad input, before anything is overwritten.
pub fn run(registry: &Registry, cli: Cli, program: Option<&Path>) -> Result<ExitCode> {
    let path = || match program {
        Some(program) => Ok(program.to_owned()),
        None => std::env::current_exe().context("the system does not tell this program's path"),
    };
    match cli.verb {
        Verb::Bench(args) => bench(registry, &args, path()?, &Stop::on_signals()?),
        Verb::Train(args) => train(registry, &args, &Stop::on_signals()?),
        Verb::Evaluate(args) => evaluate(registry, &args),
        Verb::Rollout(args) => rollout(registry, &args),
        Verb::Exact(args) => exact(registry, &args),
        Verb::Table(args) => table(registry, &args),
        Verb::Figures(args) => figures(registry, &args),
        Verb::Report(args) => report(registry, &args.folder),
        Verb::Shifts(args) => shifts(registry, &args),
        Verb::Pack(args) => pack(&args),
        Verb::Slurm(args) => slurm(registry, &args, &path()?),
        Verb::Envs(args) => envs(registry, &args),
        Verb::Config(args) => config(registry, &args),
        Verb::Completions(args) => completions(&args),
        Verb::Man(args) => man(&args),
        Verb::Worker { folder } => {
            let (catalogue, carry_out) = (registry.catalogue(), carry_out(registry));
            let stop = Stop::on_signals()?;
            Ok(ExitCode::from(runner::work(catalogue, &folder, &stop, &carry_out)))
        }
    }
}

fn bench(registry: &Registry, args: &BenchArgs, program: PathBuf, stop: &Stop) -> Result<ExitCode> {
    let options = args.device.map(device).into_iter().collect();
    let source = args.config.as_deref().map_or(Source::Quick, Source::File);
    let config = args.overrides.resolve(registry.catalogue(), source, options)?;
    let out = match (&args.out, &args.config) {
        (Some(out), _) => out.clone(),
        (None, None) => Path::new("results").join("quick"),
        (None, Some(file)) => {
            Path::new("results").join(file.file_stem().context("--config names no file")?)
        }
    };
    let mut runs = plan::runs(&config);
    if let Some(only) = &args.only {
        if !runs.contains(only) {
            bail!("--only {only}: the configuration has no such run; its first one is {}", runs[0]);
        }
        runs = vec![only.clone()];
    }
    let Some(prepared) = stop.interruptible(|| prepare(registry, &config, &runs, &out)) else {
        return Ok(report_end(&stopped(stop)));
    };
    let prepared = prepared?;
    let jobs = match args.jobs {
        Some(jobs) => jobs,
        None => std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN),
    };
    let outcome = sweep(&prepared, jobs, &Workers::of(program), stop);
    let any_finished = outcome.finished + prepared.finished.len() > 0;
    let code = report_end(&outcome);
    if outcome.stopped.is_none() && args.only.is_none() && any_finished {
        let Some(written) = stop.interruptible(|| report::write_all(&out, registry)) else {
            return Ok(report_end(&stopped(stop)));
        };
        print(&written?.terminal(report::screen_width()))?;
        note(format!("written to {}", out.display()));
        let shifts = &config.experiment.shifts;
        if !shifts.is_empty() {
            let judged = stop.interruptible(|| judge_shifted(registry, &out, shifts, None));
            let Some(judged) = judged else { return Ok(report_end(&stopped(stop))) };
            judged?;
        }
    }
    Ok(code)
}

/// The outcome of a sweep that was stopped before or after its runs.
fn stopped(stop: &Stop) -> Outcome {
    Outcome { stopped: stop.signal(), ..Outcome::default() }
}

fn train(registry: &Registry, args: &TrainArgs, stop: &Stop) -> Result<ExitCode> {
    let mut options = vec![
        select(&args.env),
        budget(args.eta)?,
        Setting::option("--seed", "experiment.seeds", vec![args.seed]),
    ];
    options.extend(args.steps.map(|steps| Setting::option("--steps", "train.steps", steps)));
    options.extend(args.device.map(device));
    options.extend(args.method.as_ref().map(method));
    let source = Source::of(args.config.as_deref());
    let config = args.overrides.resolve(registry.catalogue(), source, options)?;
    let ids = plan::runs(&config);
    let [id] = &ids[..] else {
        bail!(
            "the configuration has {} variants, methods or scenes; use `bench --only RUN_ID`",
            ids.len()
        );
    };
    let Some(prepared) = stop.interruptible(|| prepare(registry, &config, &ids, &args.out)) else {
        return Ok(report_end(&stopped(stop)));
    };
    let prepared = prepared?;
    let outcome = if prepared.todo.is_empty() {
        note(format!("{id} has finished before; remove its folder to run it again"));
        Outcome::default()
    } else {
        let carry_out = carry_out(registry);
        sweep(&prepared, NonZeroUsize::MIN, &InProcess(&carry_out), stop)
    };
    let folder = id.folder(&args.out);
    let code = report_end(&outcome);
    match runner::read_evaluation(&folder)? {
        Some(evaluation) if code == ExitCode::SUCCESS => {
            let summary = summary::Summary::new(&evaluation, &folder);
            give(&summary, args.json)
        }
        _ => Ok(code),
    }
}

/// Checks everything that can be checked before the first run starts.
fn prepare<'a>(
    registry: &'a Registry,
    config: &Config,
    runs: &[RunId],
    out: &Path,
) -> Result<Prepared<'a>> {
    let prepared = runner::prepare(registry.catalogue(), config, runs, out)?;
    for run in &prepared.todo {
        run.device.require()?;
    }
    say_what_is_rounded(&prepared);
    Ok(prepared)
}

/// Says, before anything is trained, which numbers of steps are rounded up.
fn say_what_is_rounded(prepared: &Prepared) {
    let of = |run: &RunConfig| Some(format!("note: {}", run.train.rounding()?));
    let notes: BTreeSet<String> = prepared.todo.iter().filter_map(of).collect();
    notes.iter().for_each(note);
}

/// Carries out the runs with progress on standard error.
fn sweep(prepared: &Prepared, jobs: NonZeroUsize, launcher: &dyn Launcher, stop: &Stop) -> Outcome {
    let todo = prepared.todo.iter().map(|run| (run.id(), run.train.whole_steps())).collect();
    let mut progress = Progress::new(todo, prepared.finished.len());
    let outcome = runner::sweep(prepared, jobs, launcher, stop, &mut |event| progress.event(event));
    progress.finish();
    outcome
}

/// Reports why runs did not finish; the exit code.
fn report_end(outcome: &Outcome) -> ExitCode {
    for (run, reason) in &outcome.failed {
        note(format!("error: {run} failed: {reason}"));
    }
    if let Some(signal) = outcome.stopped {
        note("stopped; finished runs are kept, and the same command continues with the rest");
        return ExitCode::from(stop::exit_code(signal));
    }
    if outcome.failed.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn device(device: Device) -> Setting {
    Setting::option("--device", "device", device.to_string())
}

fn method(method: &MethodName) -> Setting {
    Setting::option("--method", "experiment.methods", vec![method.as_str()])
}

fn evaluate(registry: &Registry, args: &EvaluateArgs) -> Result<ExitCode> {
    let run = read_run(registry, &args.folder)?;
    let settings = args.settings.iter().map(|text| Setting::parse(text));
    let settings = settings.collect::<Result<Vec<Setting>, _>>()?;
    let constants = run.constants_with(&settings, registry.catalogue())?;
    let episodes = args.episodes.unwrap_or(run.evaluation.episodes);
    let all = episodes.saturating_mul(evaluation::modes(args.antagonist).len() as u64);
    let meter = Counter::new(Meter::new("episodes", all));
    let request = Request {
        chance: args.antagonist,
        episodes: args.episodes,
        seed: args.seed,
        constants: Some(&constants),
        progress: &|| meter.count(),
    };
    let plays = registry.world(&run.env)?.evaluate(&run, &args.folder, &request);
    meter.finish();
    let plays = plays?;
    give(&summary::Plays::new(&run.id(), &plays, &run.evaluation.alphas), args.json)
}

fn rollout(registry: &Registry, args: &RolloutArgs) -> Result<ExitCode> {
    let folder = args.folder.as_ref().or(args.run.as_ref()).context("give the folder of a run")?;
    let run = read_run(registry, folder)?;
    let rows = (args.protagonist, args.format);
    let output = &mut BufWriter::new(io::stdout().lock());
    // On a terminal the rows themselves show how far it is.
    let meter = if io::stdout().is_terminal() {
        Counter::silent()
    } else {
        Counter::new(Meter::new("episodes", args.episodes))
    };
    let request = Request {
        chance: args.antagonist,
        episodes: Some(args.episodes),
        seed: args.seed,
        constants: None,
        progress: &|| meter.count(),
    };
    let result = registry.world(&run.env)?.rollout(&run, folder, &request, rows, output);
    meter.finish();
    match result {
        // A reader that stops reading (`| head`) is not an error.
        Err(RunError::Output(error)) if error.kind() == io::ErrorKind::BrokenPipe => {}
        result => result?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Carries out runs for the runner, which wants a failure in words.
fn carry_out(
    registry: &Registry,
) -> impl Fn(&RunConfig, &Path, &Stop, &mut dyn FnMut(Report)) -> Result<(), Failure> + Sync + '_ {
    |run, folder, stop, report| {
        let world = registry.world(&run.env);
        let result = world.and_then(|world| world.execute(run, folder, stop, report));
        result.map_err(|error| match error {
            RunError::Unfinished => Failure::Unfinished,
            error => Failure::Failed(error.to_string()),
        })
    }
}

/// The configuration of a finished run whose players can be used here.
fn read_run(registry: &Registry, folder: &Path) -> Result<RunConfig> {
    let Some(run) = RunConfig::of_folder(folder, registry.catalogue())? else {
        bail!(
            "{} holds no run; give the folder of one, such as \
             results/quick/lava-grid/game/eta-25/seed-1",
            folder.display()
        );
    };
    if runner::read_evaluation(folder)?.is_none() {
        bail!(
            "the run in {} has not finished; continue it with the `bench` or `train` that began it",
            folder.display()
        );
    }
    run.device.require()?;
    Ok(run)
}

/// The option `--env`.
fn select(world: &WorldName) -> Setting {
    Setting::option("--env", "experiment.envs", vec![world.as_str()])
}

/// The option `--eta`.
///
/// # Errors
/// If it is no budget.
fn budget(eta: f64) -> Result<Setting> {
    let eta = Eta::new(eta).context("--eta")?;
    Ok(Setting::option("--eta", "experiment.etas", vec![eta.get()]))
}

fn exact(registry: &Registry, args: &ExactArgs) -> Result<ExitCode> {
    if let Some(folder) = &args.policy {
        let run = read_run(registry, folder)?;
        let eta = args.eta.map(|eta| Eta::new(eta).context("--eta")).transpose()?;
        let found = registry.world(&run.env)?.changes(&run, folder, eta.map(Eta::get))?;
        return print(&if args.json { found.json() } else { found.to_string() });
    }
    let mut options: Vec<Setting> = args.env.iter().map(select).collect();
    options.extend(args.eta.map(budget).transpose()?);
    let source = Source::of(args.config.as_deref());
    let config = args.overrides.resolve(registry.catalogue(), source, options)?;
    let (gamma, eta) = (config.base.gamma, config.experiment.etas[0].get());
    let options = yardstick::Options {
        source: if args.anew { yardstick::Source::Anew } else { yardstick::Source::Computed },
        cell: args.cell,
        velocity: args.velocity,
        upper_cell: args.upper_cell,
    };
    let [world] = &config.experiment.envs[..] else {
        bail!("`exact` answers for one scene; give --scene once");
    };
    let constants = &config.world(world).constants;
    let watched = Watched::new(&format!("{world} at eta {eta}"));
    let found = registry.world(constants)?.solve(constants, gamma, eta, &options, &watched);
    watched.finish();
    let found = found?;
    if args.json {
        return print(&found.json());
    }
    // The solver's page begins with the world and knows nothing of scenes.
    let page = found.to_string();
    match page.strip_prefix(base_of(world.as_str())) {
        Some(rest) => print(&format!("{world}{rest}")),
        None => print(&page),
    }
}

fn table(registry: &Registry, args: &TableArgs) -> Result<ExitCode> {
    if args.json {
        return print_json(&report::table_json(&args.folder, &args.compare, registry)?);
    }
    let width = report::screen_width();
    print(&if args.compare.is_empty() {
        report::write(&args.folder, registry, width)?
    } else {
        report::write_comparison(&args.folder, &args.compare, registry, width)?
    })
}

fn figures(registry: &Registry, args: &FiguresArgs) -> Result<ExitCode> {
    let figures = report::write_figures(&args.folder, registry)?;
    report_missing(&figures);
    print(&format!(
        "{} written to {}",
        counted(figures.drawn.len() as u64, "figure"),
        args.folder.join("figures").display()
    ))
}

fn report(registry: &Registry, folder: &Path) -> Result<ExitCode> {
    let written = report::write_all(folder, registry)?;
    report_missing(&written.figures);
    print(&folder.join("report.html").display().to_string())
}

/// Says which figures the artefacts did not allow.
fn report_missing(figures: &report::figures::Figures) {
    if !figures.missing.is_empty() {
        note(format!(
            "left out, because the runs have no data for them: {}",
            figures.missing.join("; ")
        ));
    }
    for left_out in &figures.left_out {
        note(left_out);
    }
    for missing in &figures.notes {
        note(format!("missing in the figures: {missing}"));
    }
}

fn slurm(registry: &Registry, args: &SlurmArgs, program: &Path) -> Result<ExitCode> {
    let catalogue = registry.catalogue();
    let config = args.overrides.resolve(catalogue, Source::File(&args.config), Vec::new())?;
    let prepared = runner::prepare(catalogue, &config, &plan::runs(&config), &args.out)?;
    say_what_is_rounded(&prepared);
    if prepared.todo.is_empty() {
        return print("all runs are finished; `cvar-game table` makes their table");
    }
    let runs: Vec<RunId> = prepared.todo.iter().map(RunConfig::id).collect();
    let options = SlurmOptions {
        time: args.time.clone(),
        partition: args.partition.clone(),
        array_limit: args.array_limit,
        extra: args.extra.clone(),
    };
    let submit = slurm::write(&config, &runs, &args.out, program, &options)
        .with_context(|| format!("cannot write to {}", args.out.display()))?;
    if !args.submit {
        let (count, submit) =
            (counted(runs.len() as u64, "run"), slurm::quoted(&submit.to_string_lossy()));
        return print(&format!("{count} to do; submit with: sh {submit}"));
    }
    let status = Command::new("sh").arg(&submit).status().context("cannot start sh")?;
    if !status.success() {
        bail!("sbatch refused the sweep; its scripts are in {}", args.out.join("slurm").display());
    }
    Ok(ExitCode::SUCCESS)
}

fn envs(registry: &Registry, args: &EnvsArgs) -> Result<ExitCode> {
    let catalogue = registry.catalogue();
    if !args.json {
        let mut texts: Vec<String> = catalogue.worlds.iter().map(annotated_constants).collect();
        texts.push("# Scenes, for `--scene NAME` and as WORLD/NAME:".to_owned());
        for (name, scene) in scenes::all() {
            let map = scene.map.to_string();
            let difficulty = scene.difficulty.map_or(String::new(), |hard| format!(" ({hard})"));
            let lines = [format!("{name}{difficulty}: {}", scene.about)]
                .into_iter()
                .chain(map.lines().map(str::to_owned));
            texts.push(lines.map(|line| format!("# {line}\n")).collect());
        }
        return print(&texts.join("\n"));
    }
    let names: Vec<String> = scenes::all().map(|(name, _)| name.to_owned()).collect();
    let config = Config::resolve_on(catalogue, Source::Default, &[], &names)?;
    let constants: BTreeMap<_, _> =
        config.base.worlds.values().map(|of| (&of.constants.world, &of.constants.table)).collect();
    print_json(&constants)
}

fn config(registry: &Registry, args: &PrintArgs) -> Result<ExitCode> {
    let catalogue = registry.catalogue();
    if args.default {
        return print(catalogue.annotated_default());
    }
    let options = args.env.iter().map(select).collect();
    let source = Source::of(args.config.as_deref());
    print(&args.overrides.resolve(catalogue, source, options)?.to_toml())
}

fn completions(args: &CompletionsArgs) -> Result<ExitCode> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "cvar-game", &mut script);
    print(&String::from_utf8(script)?)
}

fn man(args: &ManArgs) -> Result<ExitCode> {
    let written = std::fs::create_dir_all(&args.out)
        .and_then(|()| clap_mangen::generate_to(Cli::command(), &args.out));
    written.with_context(|| format!("cannot write to {}", args.out.display()))?;
    print(&format!("manual pages written to {}", args.out.display()))
}

fn shifts(registry: &Registry, args: &ShiftsArgs) -> Result<ExitCode> {
    let usual = || report::shifts::USUAL.map(|text| text.parse().expect("it is a shift")).to_vec();
    let shifts = if args.to.is_empty() { usual() } else { args.to.clone() };
    judge_shifted(registry, &args.folder, &shifts, args.episodes)?;
    Ok(ExitCode::SUCCESS)
}

/// Judges the policies of a folder under other constants than those of their training.
fn judge_shifted(
    registry: &Registry,
    dir: &Path,
    shifts: &[Shift],
    episodes: Option<u64>,
) -> Result<()> {
    let judge = |run: &report::runs::Run, constants: &toml::Table| {
        let folder = dir.join(&run.files.path);
        let config = read_run(registry, &folder).map_err(|error| error.to_string())?;
        let world = config.env.world.clone();
        let constants = WorldConstants { world, table: constants.clone() };
        let request = Request {
            chance: Chance::Nominal,
            episodes,
            seed: None,
            constants: Some(&constants),
            progress: &|| (),
        };
        let law =
            registry.world(&config.env).and_then(|of| of.greedy_law(&config, &folder, &request));
        law.map_err(|error| error.to_string())
    };
    let shifted = report::shifts::Shifted::read(dir, shifts, registry)?;
    let meter = Counter::new(Meter::new("policies", shifted.judgements() as u64));
    let notes = shifted.write(registry, &judge, &|| meter.count());
    meter.finish();
    notes?.into_iter().for_each(note);
    note(format!("written to {}", dir.join("shifts.csv").display()));
    Ok(())
}

fn pack(args: &PackArgs) -> Result<ExitCode> {
    let packed = archive::pack(&args.folder, args.weights)?;
    print(&packed.to_string())
}
