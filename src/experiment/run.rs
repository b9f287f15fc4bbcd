//! One run, from its configuration to its artefacts: train, keep the weights, evaluate.
//!
//! Training writes a checkpoint every few updates, on a request to stop, and at its end. A run
//! that was cut short continues from the last valid one and ends with the same bits. Once the final weights
//! are written, training is over: only the evaluation begins again.

use super::artefacts::{BUILD, Evaluation, Manifest, SCHEMA};
use super::checkpoint::{self, Checkpoint, CheckpointError};
use super::clock::Clock;
use super::config::{EvaluationOptions, RunConfig};
use super::evaluation::{self, Contestants};
use super::failure::RunError;
use super::figure_data;
use super::lock::RunLock;
use super::progress_file::{self, ProgressFile};
use super::runner::{Evaluated, Report, Tick, WEIGHTS, evaluation_in};
use super::stop::Stop;
use crate::exact::yardstick::Solvable;
use crate::files::{LARGEST_FILE, read_at_most, read_text, remove_parts, write_in_place};
use crate::learn::method::{Arena, MethodEntry, Players, Setting, Training};
use std::cell::{Cell, RefCell};
use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

/// A protagonist whose regret is at most this is close to the optimum.
const CLOSE: f64 = 0.05;

/// Carries out the run and writes its artefacts to `folder`, `evaluation.json` last. Continues from an
/// earlier attempt of the same run in it.
///
/// # Errors
/// If training fails or an artefact cannot be written; [`RunError::Unfinished`] if `stop` was
/// requested or another process works on the run.
pub fn execute<W: Arena + Solvable>(
    method: &MethodEntry<W>,
    constants: &W::Constants,
    run: &RunConfig,
    folder: &Path,
    stop: &Stop,
    report: &mut dyn FnMut(Report),
) -> Result<(), RunError> {
    #[cfg(feature = "torch")]
    tch::set_num_threads(1);
    let lock = RunLock::take(folder).map_err(RunError::file(folder))?;
    let Some(_lock) = lock else { return Err(RunError::Unfinished) };
    if matches!(evaluation_in(folder), Ok(Some(_))) {
        return Ok(()); // another process has finished it meanwhile
    }
    remove_parts(folder).map_err(RunError::file(folder))?;
    let setting = run.setting();
    if let Some((players, manifest)) = trained_before(method, constants, &setting, folder, report)?
    {
        report(Report::Note("is trained; its weights are evaluated".to_owned()));
        let contestants = Contestants { run, constants, players: &*players, progress: &|| () };
        return evaluate(&contestants, manifest, folder, stop, report);
    }
    let mut attempt = Attempt::begin(method, constants, run, &setting, folder, report)?;
    let trained = attempt.train(stop, report);
    if matches!(trained, Err(RunError::Unfinished | RunError::File { .. })) {
        return trained;
    }
    let (steps, seconds) = (attempt.training.steps(), attempt.seconds());
    let mut manifest = Manifest::of(&run.id(), run.device, steps, seconds);
    manifest.close = progress_file::first_close(folder, CLOSE);
    manifest.notes.extend(run.train.rounding());
    manifest.failure = trained.as_ref().err().map(ToString::to_string);
    write_json(&folder.join("manifest.json"), &manifest)?;
    trained?;

    let players = attempt.training.players();
    let path = folder.join(WEIGHTS);
    let about = format!("schema {SCHEMA}, run {}, steps {steps}", manifest.run);
    write_in_place(&path, &players.weights(about)?).map_err(RunError::file(&path))?;

    let contestants = Contestants { run, constants, players, progress: &|| () };
    evaluate(&contestants, manifest, folder, stop, report)
}

/// Players with the manifest of their run.
type Trained<W> = (Box<dyn Players<W>>, Manifest);

/// The players of a run whose training is over, with its manifest. Without both, or if one is damaged, it
/// has to be trained.
fn trained_before<W: Arena>(
    method: &MethodEntry<W>,
    constants: &W::Constants,
    setting: &Setting<'_>,
    folder: &Path,
    report: &mut dyn FnMut(Report),
) -> Result<Option<Trained<W>>, RunError> {
    let manifest = read_text(&folder.join("manifest.json")).ok();
    let manifest: Option<Manifest> = manifest.and_then(|text| serde_json::from_str(&text).ok());
    let path = folder.join(WEIGHTS);
    let bytes = match read_at_most(&path, LARGEST_FILE) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        bytes => bytes,
    };
    let Some(manifest) = manifest.filter(|manifest| manifest.failure.is_none()) else {
        return Ok(None);
    };
    let mut players = (method.players)(&W::new(constants, 1)?, setting);
    let loaded = match bytes {
        Ok(bytes) => players.load(&bytes).map_err(|error| error.to_string()),
        Err(error) => Err(error.to_string()),
    };
    if let Err(problem) = loaded {
        let path = path.display();
        report(Report::Note(format!(
            "{path} cannot be used ({problem}); the run is trained again"
        )));
        return Ok(None);
    }
    Ok(Some((players, manifest)))
}

/// Evaluates the players of a run that is trained, and writes what is found and how long it took.
fn evaluate<W: Arena + Solvable>(
    contestants: &Contestants<'_, W>,
    mut manifest: Manifest,
    folder: &Path,
    stop: &Stop,
    report: &mut dyn FnMut(Report),
) -> Result<(), RunError> {
    let run = contestants.run;
    let clock = Clock::of(run.device);
    let begun = clock.now();
    // Those of the protocol, and those from which figures are drawn.
    let EvaluationOptions { episodes, figure_episodes, .. } = run.evaluation;
    let of = match contestants.players.opponent() {
        Some(_) => 3 * episodes + episodes.max(figure_episodes),
        None => 2 * episodes,
    };
    let (played, told, report) = (Cell::new(0), Cell::new(0), RefCell::new(report));
    let progress = || {
        // At most a hundred times. A few episodes more are shown in figures.
        let episodes: u64 = (played.get() + 1).min(of);
        if played.replace(episodes) == 0 || (episodes - told.get()) * 100 >= of {
            told.set(episodes);
            (report.borrow_mut())(Report::Evaluated(Evaluated { episodes, of }));
        }
    };
    let contestants = Contestants { progress: &progress, ..*contestants };
    let found = stop.interruptible(|| {
        let mut shown = figure_data::perturbed(&contestants)?;
        let found = evaluation::protocol(&contestants, (&mut shown, figure_episodes))?;
        Ok::<_, RunError>((found, figure_data::collect(&contestants, shown)?))
    });
    let (found, shown) = found.ok_or(RunError::Unfinished)??;
    let path = folder.join(figure_data::FILE);
    let text = serde_json::to_vec(&shown).map_err(io::Error::other);
    text.and_then(|text| write_in_place(&path, &text)).map_err(RunError::file(&path))?;
    manifest.evaluation_seconds = Some((clock.now() - begun).as_secs_f64());
    write_json(&folder.join("manifest.json"), &manifest)?;
    let evaluation = Evaluation::new(&run.id(), (manifest.steps, manifest.seconds), found);
    write_json(&folder.join("evaluation.json"), &evaluation)?;
    checkpoint::remove(folder).map_err(RunError::file(folder))
}

/// A run being trained.
struct Attempt<'a, W: Arena> {
    run: &'a RunConfig,
    folder: &'a Path,
    training: Box<dyn Training<W> + 'a>,
    progress: ProgressFile,
    meter: Option<evaluation::RegretMeter<W>>,
    /// Seconds of training before this attempt.
    before: f64,
    clock: Clock,
    start: Duration,
    /// Of this attempt, in which the regret was measured.
    measuring: Duration,
}

impl<'a, W: Arena + Solvable> Attempt<'a, W> {
    /// From the last valid checkpoint or, without one, from scratch.
    fn begin(
        method: &MethodEntry<W>,
        constants: &W::Constants,
        run: &'a RunConfig,
        setting: &'a Setting<'a>,
        folder: &'a Path,
        report: &mut dyn FnMut(Report),
    ) -> Result<Self, RunError> {
        let fresh = || -> Result<_, RunError> {
            Ok((method.begin)(W::new(constants, run.train.parallel_episodes)?, setting))
        };
        let meter = evaluation::regret_meter(constants, run)?;
        let clock = Clock::of(run.device);
        let start = clock.now();
        // They belong to the end of an earlier attempt.
        for name in ["manifest.json", "final.safetensors", figure_data::FILE] {
            let path = folder.join(name);
            match fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(RunError::file(&path)(error));
                }
                _ => {}
            }
        }
        for path in checkpoint::list(folder).map_err(RunError::file(folder))? {
            let mut training = fresh()?;
            match resume(&path, run, training.as_mut()) {
                Ok(checkpoint) => {
                    let (extent, before) = (checkpoint.progress, checkpoint.seconds);
                    match ProgressFile::resume(folder, method.metrics, extent, before) {
                        Ok(progress) => {
                            let update = training.updates();
                            report(Report::Note(format!("continues after update {update}")));
                            return Ok(Attempt {
                                run,
                                folder,
                                training,
                                progress,
                                meter,
                                before,
                                clock,
                                start,
                                measuring: Duration::ZERO,
                            });
                        }
                        Err(error) => pass_over(&path, &format!("does not fit: {error}"), report)?,
                    }
                }
                Err(error) => pass_over(&path, &error.to_string(), report)?,
            }
        }
        let path = folder.join(ProgressFile::NAME);
        let progress =
            ProgressFile::create(folder, method.metrics).map_err(RunError::file(&path))?;
        let (training, before, measuring) = (fresh()?, 0.0, Duration::ZERO);
        Ok(Attempt { run, folder, training, progress, meter, before, clock, start, measuring })
    }

    /// Seconds of training so far.
    fn seconds(&self) -> f64 {
        self.before + (self.clock.now() - self.start - self.measuring).as_secs_f64()
    }

    fn train(&mut self, stop: &Stop, report: &mut dyn FnMut(Report)) -> Result<(), RunError> {
        let every = self.run.checkpoint.every;
        let mut saved = self.training.updates();
        let mut steps = self.training.steps();
        while let Some(update) = self.training.update()? {
            let path = self.folder.join(ProgressFile::NAME);
            let (seconds, regret) = (self.seconds(), self.regret(steps, update.steps)?);
            steps = update.steps;
            self.progress.add(&update, seconds, regret).map_err(RunError::file(&path))?;
            report(Report::Tick(Tick { steps, mean_return: update.mean_return }));
            let stopped = stop.signal().is_some();
            if stopped || update.update % every == 0 {
                self.save()?;
                saved = update.update;
            }
            if stopped {
                return Err(RunError::Unfinished);
            }
        }
        // The evaluation may be cut short as well.
        if saved < self.training.updates() { self.save() } else { Ok(()) }
    }

    /// The regret after an update that went from `before` to `after` steps, if it is one at which it
    /// is measured.
    fn regret(&mut self, before: u64, after: u64) -> Result<Option<f64>, RunError> {
        let Some(meter) = &self.meter else { return Ok(None) };
        let all = self.run.train.steps;
        let points = |steps: u64| steps.min(all) * meter.points / all;
        if points(after) == points(before) {
            return Ok(None);
        }
        let begun = self.clock.now();
        let regret = (meter.measure)(self.training.players());
        self.measuring += self.clock.now() - begun;
        regret
    }

    fn save(&mut self) -> Result<(), RunError> {
        let path = self.folder.join(ProgressFile::NAME);
        let checkpoint = Checkpoint {
            program: BUILD.to_owned(),
            config: self.run.training_text(),
            seconds: self.seconds(),
            progress: self.progress.extent().map_err(RunError::file(&path))?,
            training: self.training.state(),
        };
        checkpoint::save(self.folder, self.training.updates(), &checkpoint)
            .map_err(RunError::file(self.folder))
    }
}

/// Reports why a checkpoint is not used, and removes it.
fn pass_over(path: &Path, why: &str, report: &mut dyn FnMut(Report)) -> Result<(), RunError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    report(Report::Note(format!("{name} {why}; the one before it is tried")));
    fs::remove_file(path).map_err(RunError::file(path))
}

/// Brings training to where a checkpoint was written.
fn resume<W: Arena>(
    path: &Path,
    run: &RunConfig,
    training: &mut dyn Training<W>,
) -> Result<Checkpoint, CheckpointError> {
    let unfit = |reason: &str| CheckpointError::Unfit(reason.to_owned());
    let checkpoint = checkpoint::load(path)?;
    if checkpoint.config != run.training_text() {
        return Err(unfit("it is of another configuration"));
    }
    if checkpoint.program != BUILD {
        return Err(unfit("it is of another version of the program"));
    }
    training.restore(&checkpoint.training).map_err(|error| unfit(&error.to_string()))?;
    Ok(checkpoint)
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<(), RunError> {
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|error| RunError::file(path)(io::Error::other(error)))?;
    text.push('\n');
    write_in_place(path, text.as_bytes()).map_err(RunError::file(path))
}
