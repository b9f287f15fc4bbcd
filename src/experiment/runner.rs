//! The runner: from a plan to finished folders, `jobs` runs at a time.
//!
//! Nothing starts before everything is checked: [`prepare`] looks at every run's folder first and
//! refuses one that holds something else. [`sweep`] then carries out the runs that are not finished,
//! each by a [`Launcher`]: a worker process of its own, this process, or a mock in tests. A run that
//! fails is told and the others continue. Artefacts appear in one piece, `evaluation.json` last, so that
//! a run cut short is recognised; it continues from its last checkpoint.
//!
//! Several sweeps may share a folder, on one machine or many: whoever carries out a run holds its
//! lock, and the others work on other runs until it is free.

mod worker;

use super::archive::RunFiles;
use super::artefacts::{Evaluation, Manifest, SCHEMA};
use super::checkpoint;
use super::config::{Catalogue, Config, ConfigError, Difference, RunConfig};
use super::figure_data;
use super::lock::RunLock;
use super::names::RunId;
use crate::files::{read_text, write_in_place};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::VecDeque;
use std::fs;
use std::io;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};
use thiserror::Error;

use super::stop::Stop;
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

/// What a run tells while it is carried out.
#[derive(Debug, Clone, PartialEq)]
pub enum Report {
    /// How far its training is.
    Tick(Tick),
    /// How far its evaluation is.
    Evaluated(Evaluated),
    /// Something that its user should know.
    Note(String),
}

/// How far the evaluation of a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Evaluated {
    /// Episodes played so far.
    pub episodes: u64,
    /// Episodes in all.
    pub of: u64,
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
    /// A run was evaluated with other settings and cannot be evaluated again.
    #[error(
        "{} holds a run that was evaluated with other settings ({told}), and its weights are gone: there \
         is no final.safetensors to evaluate again; use its settings, put that file back, or choose \
         another folder with --out",
        folder.display()
    )]
    NoWeights {
        /// The run's folder.
        folder: PathBuf,
        /// What differs.
        told: String,
    },
    /// A run's `evaluation.json` cannot be read, but training may be kept.
    #[error(
        "{} {reason}; the `bench` or `train` that wrote it evaluates the run again", path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// Why a run did not finish.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Failure {
    /// It was asked to stop, or another process works on it: to be launched again.
    Unfinished,
    /// It failed, for this reason.
    Failed(String),
}

/// Carries out one run.
pub trait Launcher: Sync {
    /// Carries out the run in its folder, which holds its `config.toml`, and leaves its artefacts
    /// there, under the folder's lock. Returns when the run has ended; soon after `stop` is
    /// requested, with [`Failure::Unfinished`] and nothing left running.
    ///
    /// # Errors
    /// If the run did not finish.
    fn launch(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
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
        /// Environment steps of an update.
        update: u64,
    },
    /// A run makes progress in training.
    Ticked {
        /// The run.
        run: RunId,
        /// How far it is.
        tick: Tick,
    },
    /// A run makes progress in its evaluation.
    Evaluating {
        /// The run.
        run: RunId,
        /// How far it is.
        evaluated: Evaluated,
    },
    /// A run has something to say.
    Noted {
        /// The run.
        run: RunId,
        /// What it says.
        note: String,
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
    /// Nothing else has happened for a second.
    Quiet,
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
    pub stopped: Option<i32>,
}

/// The runs of a sweep that are still to do, all folders checked.
#[derive(Debug)]
pub struct Prepared<'a> {
    catalogue: &'a Catalogue,
    out: PathBuf,
    /// Runs to do, in order.
    pub todo: Vec<RunConfig>,
    /// Runs that are finished and stay as they are.
    pub finished: Vec<RunId>,
}

/// Checks that the output folder can be written and that the folder of each of `runs`, which are runs
/// of the configuration, is new, the same run finished, or the same run cut short.
///
/// # Errors
/// See [`RunnerError`]; nothing has been overwritten then.
pub fn prepare<'a>(
    catalogue: &'a Catalogue,
    config: &Config,
    runs: &[RunId],
    out: &Path,
) -> Result<Prepared<'a>, RunnerError> {
    require_writable(out)?;
    let mut todo = Vec::new();
    let mut finished = Vec::new();
    for id in runs {
        let run = config.run(id);
        if matches!(look(catalogue, &run, &id.folder(out))?, Found::Finished) {
            tidy(&id.folder(out));
            finished.push(id.clone());
        } else {
            todo.push(run);
        }
    }
    Ok(Prepared { catalogue, out: out.to_owned(), todo, finished })
}

/// How long to wait for a run that another process works on before looking again.
const PAUSE: Duration = Duration::from_millis(250);

/// How long nothing happens until [`Event::Quiet`].
const QUIET: Duration = Duration::from_secs(1);

/// Carries out the runs, `jobs` at a time, the longest ones first, so that all are busy to the end, and tells `watch`
/// what happens.
pub fn sweep(
    prepared: &Prepared<'_>,
    jobs: NonZeroUsize,
    launcher: &dyn Launcher,
    stop: &Stop,
    watch: &mut dyn FnMut(&Event),
) -> Outcome {
    let Prepared { todo, .. } = prepared;
    let mut longest_first: Vec<&RunConfig> = todo.iter().collect();
    longest_first.sort_by(|a, b| b.work().total_cmp(&a.work()));
    let queue = Mutex::new(VecDeque::from(longest_first));
    let (events, incoming) = mpsc::channel();
    let mut outcome = Outcome::default();
    std::thread::scope(|scope| {
        for _ in 0..jobs.get().min(todo.len()) {
            let events = events.clone();
            let queue = &queue;
            let queue = || queue.lock().expect("no thread panics here");
            scope.spawn(move || {
                while stop.signal().is_none() {
                    let Some(run) = queue().pop_front() else { break };
                    // The receiver lives until all senders are gone.
                    let mut send = |event| events.send(event).expect("the sweep listens");
                    match carry_out(prepared, run, launcher, stop, &mut send) {
                        Some(end) => send(end),
                        None => {
                            queue().push_back(run);
                            std::thread::sleep(PAUSE);
                        }
                    }
                }
            });
        }
        drop(events);
        loop {
            let event = match incoming.recv_timeout(QUIET) {
                Ok(event) => event,
                Err(RecvTimeoutError::Timeout) => Event::Quiet,
                Err(RecvTimeoutError::Disconnected) => break,
            };
            watch(&event);
            match event {
                Event::Finished { .. } => outcome.finished += 1,
                Event::Failed { run, reason, .. } => outcome.failed.push((run, reason)),
                _ => {}
            }
        }
    });
    outcome.stopped = stop.signal();
    outcome
}

/// One run to its end; `None` if it has to be tried again, because another process works on it.
fn carry_out(
    prepared: &Prepared<'_>,
    run: &RunConfig,
    launcher: &dyn Launcher,
    stop: &Stop,
    send: &mut dyn FnMut(Event),
) -> Option<Event> {
    let id = run.id();
    let folder = id.folder(&prepared.out);
    let start = Instant::now();
    let mut steps = 0;
    let (result, evaluation) = match begin(prepared.catalogue, run, &folder) {
        Ok(Begun::Free(note)) => {
            let (all, update) = (run.train.whole_steps(), run.train.rollout());
            send(Event::Started { run: id.clone(), steps: all, update });
            if let Some(note) = note {
                send(Event::Noted { run: id.clone(), note });
            }
            let result = launcher.launch(run, &folder, stop, &mut |report| {
                send(match report {
                    Report::Tick(tick) => {
                        steps = tick.steps;
                        Event::Ticked { run: id.clone(), tick }
                    }
                    Report::Evaluated(evaluated) => {
                        Event::Evaluating { run: id.clone(), evaluated }
                    }
                    Report::Note(note) => Event::Noted { run: id.clone(), note },
                });
            });
            (result, evaluation_in(&folder))
        }
        Ok(Begun::Finished) => (Ok(()), read_evaluation(&folder)),
        Ok(Begun::Busy) => (Err(Failure::Unfinished), Ok(None)),
        Err(reason) => (Err(Failure::Failed(reason)), Ok(None)),
    };
    let result = match (result, evaluation) {
        // However its process ended: it had nothing left to do.
        (_, Ok(Some(evaluation))) => Ok(evaluation),
        (Err(failure), _) => Err(failure),
        (Ok(()), Ok(None)) => Err(Failure::Failed("it ended without an evaluation.json".into())),
        (Ok(()), Err(error)) => Err(Failure::Failed(error.to_string())),
    };
    let seconds = start.elapsed().as_secs_f64();
    match result {
        Ok(evaluation) => {
            tidy(&folder);
            Some(Event::Finished { run: id, seconds, evaluation: Box::new(evaluation) })
        }
        Err(Failure::Unfinished) => stop.signal().map(|_| Event::Stopped { run: id }),
        Err(Failure::Failed(reason)) => {
            // The failure is told anyway; a full disk must not hide it.
            let _ = record_failure(run, &folder, &reason, steps, seconds);
            Some(Event::Failed { run: id, seconds, reason })
        }
    }
}

/// Makes the output folder and writes a file into it for a moment.
fn require_writable(out: &Path) -> Result<(), RunnerError> {
    fs::create_dir_all(out)
        .and_then(|()| tempfile::tempfile_in(out))
        .map(drop)
        .map_err(|source| RunnerError::Output { folder: out.to_owned(), source })
}

/// What there is of a run.
#[derive(Debug)]
enum Found {
    /// All of it.
    Finished,
    /// All of it, evaluated with other settings, as the text says; its weights are there.
    Outdated(String),
    /// Nothing, or a part to continue from; a text says what cannot be used.
    Unfinished(Option<String>),
}

/// Looks for this run in its folder and in the archive of its results folder.
fn look(catalogue: &Catalogue, run: &RunConfig, folder: &Path) -> Result<Found, RunnerError> {
    let foreign = |reason: String| RunnerError::Foreign { folder: folder.to_owned(), reason };
    let unreadable = |error| foreign(format!("cannot be read ({error})"));
    let files = RunFiles::at(folder).map_err(unreadable)?;
    let packed = files.filter(RunFiles::is_packed);
    let is_packed = packed.is_some();
    let is_empty = match fs::read_dir(folder) {
        // Hidden files are a lock, and what is left of a file that was being written.
        Ok(entries) => entries
            .map_while(Result::ok)
            .all(|entry| entry.file_name().as_encoded_bytes().starts_with(b".")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => true,
        Err(error) => return Err(unreadable(error)),
    };
    let path = packed.as_ref().map_or(folder.join("config.toml"), |of| of.place("config.toml"));
    let loaded = match packed {
        Some(packed) => match packed.text("config.toml").map_err(unreadable)? {
            Some(text) => RunConfig::parse(&path, &text, catalogue),
            None => return Err(foreign(format!("is packed without {}", path.display()))),
        },
        None if is_empty => return Ok(Found::Unfinished(None)),
        None if !path.exists() => return Err(foreign("holds files but no config.toml".into())),
        None => RunConfig::load(&path, catalogue),
    };
    let mut there = match loaded {
        Ok(there) => there,
        Err(error @ ConfigError::Schema { .. }) => return Err(RunnerError::Schema(error)),
        Err(error) => {
            return Err(foreign(format!(
                "has a config.toml that does not fit this program ({error})"
            )));
        }
    };
    // A run of a former version does not say its variant; its folder does.
    let variant = there.variant.take().or_else(|| run.variant.clone());
    let there = RunConfig { variant, ..there };
    let (evaluation, training): (Vec<Difference>, Vec<Difference>) =
        run.differences(&there).into_iter().partition(|of| of.key.starts_with("evaluation."));
    if !training.is_empty() {
        let told = in_words(&training);
        return Err(foreign(format!("holds a run with another configuration ({told})")));
    }
    match read_evaluation(folder) {
        Ok(None) => return Ok(Found::Unfinished(None)),
        Ok(Some(_)) => {}
        Err(error @ RunnerError::Damaged { .. }) if !is_packed => {
            return Ok(Found::Unfinished(Some(error.to_string())));
        }
        Err(error) => return Err(error),
    }
    if evaluation.is_empty() {
        return Ok(Found::Finished);
    }
    let told = in_words(&evaluation);
    let has_weights = match packed_files(folder).map_err(unreadable)? {
        Some(packed) => packed.read(WEIGHTS).map_err(unreadable)?.is_some(),
        None => false,
    };
    if has_weights || folder.join(WEIGHTS).is_file() {
        return Ok(Found::Outdated(told));
    }
    Err(RunnerError::NoWeights { folder: folder.to_owned(), told })
}

/// The files of a run that is in the archive of its results folder.
fn packed_files(folder: &Path) -> io::Result<Option<RunFiles>> {
    RunFiles::at(folder).map(|files| files.filter(RunFiles::is_packed))
}

/// The first differences of two configurations.
fn in_words(differences: &[Difference]) -> String {
    let mut told: Vec<String> = differences
        .iter()
        .take(3)
        .map(|of| format!("{} is {} there and {} here", of.key, of.theirs, of.ours))
        .collect();
    if differences.len() > told.len() {
        told.push(format!("{} more", differences.len() - told.len()));
    }
    told.join(", ")
}

/// The evaluation of a run, from its folder or from the archive of its results folder; `None` if there is
/// none yet.
///
/// # Errors
/// If it is damaged or of another schema version.
pub fn read_evaluation(folder: &Path) -> Result<Option<Evaluation>, RunnerError> {
    let unreadable = |error: io::Error| RunnerError::Foreign {
        folder: folder.to_owned(),
        reason: format!("cannot be read ({error})"),
    };
    match packed_files(folder).map_err(unreadable)? {
        Some(packed) => evaluation(folder, &packed.place(RESULT), packed.text(RESULT)),
        None => evaluation_in(folder),
    }
}

/// The evaluation in the folder of a run; `None` if there is none yet.
///
/// # Errors
/// As [`read_evaluation`].
pub fn evaluation_in(folder: &Path) -> Result<Option<Evaluation>, RunnerError> {
    let path = folder.join(RESULT);
    // A dangling link is a file that cannot be read, not an absent one.
    let there = path.symlink_metadata().is_ok();
    evaluation(folder, &path, there.then(|| read_text(&path)).transpose())
}

/// The evaluation of a text, which was read from `path` for the run of `folder`.
fn evaluation(
    folder: &Path,
    path: &Path,
    text: io::Result<Option<String>>,
) -> Result<Option<Evaluation>, RunnerError> {
    let damaged = |reason| RunnerError::Damaged { path: path.to_owned(), reason };
    let text = text.map_err(|error| damaged(format!("cannot be read ({error})")))?;
    let Some(text) = text else { return Ok(None) };
    let no_json = |error| damaged(format!("is damaged ({error})"));
    let value: serde_json::Value = serde_json::from_str(&text).map_err(no_json)?;
    if let Some(found) = value.get("schema").filter(|found| **found != SCHEMA) {
        let reason = format!(
            "has an evaluation.json of schema version {found}, this program reads {SCHEMA}"
        );
        return Err(RunnerError::Foreign { folder: folder.to_owned(), reason });
    }
    serde_json::from_value(value).map(Some).map_err(no_json)
}

/// How a run's folder is found when its turn comes.
enum Begun {
    /// To be carried out; a text says what its user should know.
    Free(Option<String>),
    /// Another process works on it.
    Busy,
    /// Another process has finished it meanwhile.
    Finished,
}

/// Makes the folder with its `config.toml`, if nobody else works there.
fn begin(catalogue: &Catalogue, run: &RunConfig, folder: &Path) -> Result<Begun, String> {
    let refused = |error| format!("cannot write to {}: {error}", folder.display());
    fs::create_dir_all(folder).map_err(refused)?;
    let Some(_lock) = RunLock::take(folder).map_err(refused)? else { return Ok(Begun::Busy) };
    // Looked at again: another sweep may have been here since `prepare`.
    let note = match look(catalogue, run, folder).map_err(|error| error.to_string())? {
        Found::Finished => return Ok(Begun::Finished),
        Found::Outdated(told) => {
            discard_evaluation(folder).map_err(refused)?;
            Some(format!("is evaluated again, without training: {told}"))
        }
        Found::Unfinished(note) => note,
    };
    write_in_place(&folder.join("config.toml"), run.to_toml().as_bytes()).map_err(refused)?;
    Ok(Begun::Free(note))
}

/// Makes an unfinished run of a finished one, whose weights are kept. The evaluation goes first: as long as
/// there is one, it belongs to the `config.toml` beside it.
fn discard_evaluation(folder: &Path) -> io::Result<()> {
    if let Some(packed) = packed_files(folder)? {
        // All that a finished run has beside its configuration and its evaluation.
        for file in [WEIGHTS, "manifest.json", "progress.csv", figure_data::FILE] {
            if let Some(bytes) = packed.read(file)? {
                write_in_place(&folder.join(file), &bytes)?;
            }
        }
    }
    match fs::remove_file(folder.join(RESULT)) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// What the evaluation of a run found; the last file that it writes.
const RESULT: &str = "evaluation.json";

/// The weights of the players of a run.
pub const WEIGHTS: &str = "final.safetensors";

/// What a worker printed on standard error; empty logs are removed.
const LOG: &str = "worker.log";

/// Removes what a finished run needs no more and was killed before it could remove.
fn tidy(folder: &Path) {
    // A folder that cannot be written keeps it.
    let _ = checkpoint::remove(folder);
    let log = folder.join(LOG);
    if fs::metadata(&log).is_ok_and(|log| log.len() == 0) {
        let _ = fs::remove_file(log);
    }
}

/// Notes the failure in the run's manifest; a run that died before it wrote one gets it here. If
/// somebody else has taken up the run, the manifest is theirs.
fn record_failure(
    run: &RunConfig,
    folder: &Path,
    reason: &str,
    steps: u64,
    seconds: f64,
) -> io::Result<()> {
    let Some(_lock) = RunLock::take(folder)? else { return Ok(()) };
    let path = folder.join("manifest.json");
    let written = read_text(&path).ok().and_then(|text| serde_json::from_str(&text).ok());
    let mut manifest =
        written.unwrap_or_else(|| Manifest::of(&run.id(), run.device, steps, seconds));
    manifest.failure.get_or_insert_with(|| reason.to_owned());
    let mut text = serde_json::to_string_pretty(&manifest)?;
    text.push('\n');
    write_in_place(&path, text.as_bytes())
}
