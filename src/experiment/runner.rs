//! The runner: from a plan to finished folders, `jobs` runs at a time.
//!
//! Nothing starts before everything is checked: [`prepare`] looks at every run's folder first and
//! refuses one that holds something else. [`sweep`] then carries out the runs that are not finished,
//! each by a [`Launcher`]: a worker process of its own, this process, or a mock in tests. A run that
//! fails is told and the others go on. Artefacts appear in one piece, `evaluation.json` last, so that
//! a run cut short is recognised and starts again from scratch.

mod worker;

use super::artefacts::{Evaluation, Manifest, SCHEMA, write_in_place};
use super::config::{Config, ConfigError, RunConfig};
use super::names::RunId;
use super::{plan, tensorboard};
use serde::{Deserialize, Deserializer, Serialize};
use std::fs::{self, File, TryLockError};
use std::io;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Instant;
use thiserror::Error;

pub use worker::{CarryOut, InProcess, Workers, work};

/// How far a run is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Tick {
    /// Environment steps so far.
    pub steps: u64,
    /// Mean return of the latest rollout; NaN if no episode has ended in it.
    #[serde(deserialize_with = "null_is_nan")]
    pub mean_return: f64,
}

/// JSON has no NaN; serde_json writes it as null.
fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|number| number.unwrap_or(f64::NAN))
}

/// Why a sweep cannot start. Nothing has been overwritten.
#[derive(Debug, Error)]
pub enum RunnerError {
    /// The output folder cannot be written.
    #[error("cannot write to {}: {source}; choose another folder with --out", folder.display())]
    Output {
        /// The folder.
        folder: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Two programs would write to one folder.
    #[error(
        "another cvar-game is writing to {}; wait until it ends or choose another folder with --out",
        folder.display()
    )]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A run's folder holds something else.
    #[error("{} {reason}; choose another folder with --out or remove that one", folder.display())]
    Foreign {
        /// The run's folder.
        folder: PathBuf,
        /// What it holds.
        reason: String,
    },
    /// A run's folder is of another version of the program.
    #[error(transparent)]
    Schema(ConfigError),
}

/// What a signal asked for. Clones share the request.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicUsize>);

impl Stop {
    /// Listens to SIGINT and SIGTERM; a second one ends the process at once.
    ///
    /// # Errors
    /// If the system refuses the handler.
    pub fn on_signals() -> io::Result<Stop> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        use signal_hook::flag;
        let stop = Stop::default();
        for signal in [SIGINT, SIGTERM] {
            let again = Arc::new(std::sync::atomic::AtomicBool::new(false));
            flag::register_conditional_shutdown(signal, 128 + signal, Arc::clone(&again))?;
            flag::register(signal, again)?;
            flag::register_usize(signal, Arc::clone(&stop.0), signal as usize)?;
        }
        Ok(stop)
    }

    /// Makes SIGINT and SIGTERM end the process at once, with the exit code that says so: for work
    /// in this process, whose files appear in one piece.
    ///
    /// # Errors
    /// If the system refuses the handler.
    pub fn by_ending_the_process() -> io::Result<()> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        for signal in [SIGINT, SIGTERM] {
            let always = Arc::new(std::sync::atomic::AtomicBool::new(true));
            signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, always)?;
        }
        Ok(())
    }

    /// Asks to stop, as the signal of this number would.
    pub fn request(&self, signal: usize) {
        self.0.store(signal, Ordering::SeqCst);
    }

    /// The number of the signal that asked to stop.
    pub fn signal(&self) -> Option<usize> {
        Some(self.0.load(Ordering::SeqCst)).filter(|&signal| signal != 0)
    }
}

/// Why a run did not finish.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// It was asked to stop.
    Stopped,
    /// It failed, for this reason.
    Failed(String),
}

/// Carries out one run.
pub trait Launcher: Sync {
    /// Carries out the run in its folder, which holds its `config.toml`, and leaves its artefacts
    /// there. Returns when the run has ended; soon after `stop` is requested, with
    /// [`Failure::Stopped`] and nothing left running.
    ///
    /// # Errors
    /// If the run did not finish.
    fn launch(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        tick: &mut dyn FnMut(Tick),
    ) -> Result<(), Failure>;
}

/// What happens in a sweep.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// A run starts.
    Started {
        /// The run.
        run: RunId,
        /// Its environment steps in all.
        steps: u64,
    },
    /// A run goes on.
    Ticked {
        /// The run.
        run: RunId,
        /// How far it is.
        tick: Tick,
    },
    /// A run has finished.
    Finished {
        /// The run.
        run: RunId,
        /// Its wall-clock seconds, evaluation included.
        seconds: f64,
        /// What came out.
        evaluation: Box<Evaluation>,
    },
    /// A run has failed.
    Failed {
        /// The run.
        run: RunId,
        /// Its wall-clock seconds.
        seconds: f64,
        /// Why.
        reason: String,
    },
    /// A run was stopped.
    Stopped {
        /// The run.
        run: RunId,
    },
}

/// How a sweep ended.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Outcome {
    /// Number of runs that finished.
    pub finished: usize,
    /// The runs that failed, and why.
    pub failed: Vec<(RunId, String)>,
    /// Number of the signal that stopped the sweep.
    pub stopped: Option<usize>,
}

/// The runs of a sweep that are still to do, all folders checked.
#[derive(Debug)]
pub struct Prepared {
    out: PathBuf,
    /// Runs to do, in order.
    pub todo: Vec<RunConfig>,
    /// Runs that are finished and stay as they are.
    pub finished: Vec<RunId>,
    /// Held while the sweep writes.
    _lock: File,
}

/// Checks that the output folder can be written and that every run's folder is new, the same run
/// finished, or the same run cut short.
///
/// # Errors
/// See [`RunnerError`]; nothing has been overwritten then.
pub fn prepare(config: &Config, out: &Path) -> Result<Prepared, RunnerError> {
    let lock = lock(out)?;
    let mut todo = Vec::new();
    let mut finished = Vec::new();
    for id in plan::runs(config) {
        let run = config.run(id);
        if is_finished(&run, &id.folder(out))? {
            finished.push(id);
        } else {
            todo.push(run);
        }
    }
    Ok(Prepared { out: out.to_owned(), todo, finished, _lock: lock })
}

/// Carries out the runs, `jobs` at a time, and tells `watch` what happens.
pub fn sweep(
    prepared: &Prepared,
    jobs: NonZeroUsize,
    launcher: &dyn Launcher,
    stop: &Stop,
    watch: &mut dyn FnMut(&Event),
) -> Outcome {
    let Prepared { out, todo, .. } = prepared;
    let queue = Mutex::new(todo.iter());
    let (events, incoming) = mpsc::channel();
    let mut outcome = Outcome::default();
    std::thread::scope(|scope| {
        for _ in 0..jobs.get().min(todo.len()) {
            let events = events.clone();
            let queue = &queue;
            scope.spawn(move || {
                while stop.signal().is_none() {
                    let Some(run) = queue.lock().expect("no thread panics here").next() else {
                        break;
                    };
                    // The receiver lives until all senders are gone.
                    let mut send = |event| events.send(event).expect("the sweep listens");
                    send(Event::Started { run: run.id(), steps: run.train.steps });
                    let end = carry_out(run, out, launcher, stop, &mut send);
                    send(end);
                }
            });
        }
        drop(events);
        for event in incoming {
            watch(&event);
            match event {
                Event::Finished { .. } => outcome.finished += 1,
                Event::Failed { run, reason, .. } => outcome.failed.push((run, reason)),
                Event::Started { .. } | Event::Ticked { .. } | Event::Stopped { .. } => {}
            }
        }
    });
    outcome.stopped = stop.signal();
    outcome
}

/// One run from an empty folder to its end.
fn carry_out(
    run: &RunConfig,
    out: &Path,
    launcher: &dyn Launcher,
    stop: &Stop,
    send: &mut dyn FnMut(Event),
) -> Event {
    let id = run.id();
    let folder = id.folder(out);
    let start = Instant::now();
    let mut steps = 0;
    let mut tick = |tick: Tick| {
        steps = tick.steps;
        send(Event::Ticked { run: id, tick });
    };
    let result = clear(run, &folder)
        .map_err(|error| Failure::Failed(format!("cannot write to {}: {error}", folder.display())))
        .and_then(|()| launcher.launch(run, &folder, stop, &mut tick))
        .and_then(|()| {
            read_evaluation(&folder)
                .map_err(|error| Failure::Failed(error.to_string()))?
                .ok_or_else(|| Failure::Failed("it ended without an evaluation.json".into()))
        });
    let seconds = start.elapsed().as_secs_f64();
    match result {
        Ok(evaluation) => Event::Finished { run: id, seconds, evaluation: Box::new(evaluation) },
        Err(Failure::Stopped) => Event::Stopped { run: id },
        Err(Failure::Failed(reason)) => {
            // The failure is told anyway; a full disk must not hide it.
            let _ = record_failure(run, &folder, &reason, steps, seconds);
            Event::Failed { run: id, seconds, reason }
        }
    }
}

/// The lock of an output folder, which is made if need be.
fn lock(out: &Path) -> Result<File, RunnerError> {
    let refused = |source| RunnerError::Output { folder: out.to_owned(), source };
    fs::create_dir_all(out).map_err(refused)?;
    let lock = File::create(out.join(".lock")).map_err(refused)?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(RunnerError::Busy { folder: out.to_owned() }),
        Err(TryLockError::Error(source)) => Err(refused(source)),
    }
}

/// Whether the folder holds this run, finished.
fn is_finished(run: &RunConfig, folder: &Path) -> Result<bool, RunnerError> {
    let foreign = |reason: String| RunnerError::Foreign { folder: folder.to_owned(), reason };
    let is_empty = match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_none(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => true,
        Err(error) => return Err(foreign(format!("cannot be read ({error})"))),
    };
    if is_empty {
        return Ok(false);
    }
    let path = folder.join("config.toml");
    if !path.exists() {
        return Err(foreign("holds files but no config.toml".into()));
    }
    let there = match RunConfig::load(&path) {
        Ok(there) => there,
        Err(error @ ConfigError::Schema { .. }) => return Err(RunnerError::Schema(error)),
        Err(error) => {
            return Err(foreign(format!(
                "has a config.toml that does not fit this program ({error})"
            )));
        }
    };
    let differences = run.differences(&there);
    if !differences.is_empty() {
        let mut told: Vec<String> = differences
            .iter()
            .take(3)
            .map(|of| format!("{} is {} there and {} here", of.key, of.theirs, of.ours))
            .collect();
        if differences.len() > told.len() {
            told.push(format!("{} more", differences.len() - told.len()));
        }
        let told = told.join(", ");
        return Err(foreign(format!("holds a run with another configuration ({told})")));
    }
    read_evaluation(folder).map(|evaluation| evaluation.is_some())
}

/// The evaluation of a run's folder; `None` if there is none yet.
///
/// # Errors
/// If it is damaged or of another schema version.
pub fn read_evaluation(folder: &Path) -> Result<Option<Evaluation>, RunnerError> {
    let foreign = |reason: String| RunnerError::Foreign { folder: folder.to_owned(), reason };
    let text = match fs::read_to_string(folder.join("evaluation.json")) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(foreign(format!("has an unreadable evaluation.json ({error})"))),
    };
    let damaged = |error| foreign(format!("has a damaged evaluation.json ({error})"));
    let value: serde_json::Value = serde_json::from_str(&text).map_err(damaged)?;
    if value["schema"] != SCHEMA {
        let found = &value["schema"];
        return Err(foreign(format!(
            "has an evaluation.json of schema version {found}, this program reads {SCHEMA}"
        )));
    }
    serde_json::from_value(value).map(Some).map_err(damaged)
}

/// Makes the folder, removes what an earlier attempt left and writes `config.toml`.
fn clear(run: &RunConfig, folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    for name in [
        "manifest.json",
        "progress.csv",
        tensorboard::FILE,
        "final.safetensors",
        "exhibits.json",
        LOG,
    ] {
        match fs::remove_file(folder.join(name)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    write_in_place(&folder.join("config.toml"), run.to_toml().as_bytes())
}

/// What a worker printed on standard error; empty logs are removed.
const LOG: &str = "worker.log";

/// Notes the failure in the run's manifest; a run that died before it wrote one gets it here.
fn record_failure(
    run: &RunConfig,
    folder: &Path,
    reason: &str,
    steps: u64,
    seconds: f64,
) -> io::Result<()> {
    let path = folder.join("manifest.json");
    let written = fs::read(&path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
    let mut manifest =
        written.unwrap_or_else(|| Manifest::of(run.id(), &run.device.to_string(), steps, seconds));
    manifest.failure.get_or_insert_with(|| reason.to_owned());
    let mut text = serde_json::to_string_pretty(&manifest)?;
    text.push('\n');
    write_in_place(&path, text.as_bytes())
}
