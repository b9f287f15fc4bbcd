//! Workers: one process per run, so that a crash ends only one run, with one thread, so that the
//! numbers do not depend on how many run at once.
//!
//! A worker reads the `config.toml` of its folder and reports on standard output, one JSON object a
//! line: `{"steps":..,"mean_return":..}` in training, `{"evaluated":{"episodes":..,"of":..}}` in the
//! evaluation, `{"note":".."}`, or `{"failure":".."}` before it fails.
//! Its standard input is empty. It closes when the parent stops the worker, or when the parent ends for
//! whatever reason; the worker then writes a checkpoint and ends.

use super::{Evaluated, Failure, LOG, Launcher, Report, Stop, Tick};
use crate::experiment::config::{Catalogue, RunConfig};
use crate::experiment::stop::{RESUME, exit_code};
use crate::files::{create, read_text};
use serde::{Deserialize, Serialize};
use signal_hook::consts::SIGTERM;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

/// A line of a worker's standard output.
#[derive(Debug, Serialize, Deserialize)]
#[serde(untagged)]
enum Line {
    Tick(Tick),
    Evaluated { evaluated: Evaluated },
    Note { note: String },
    Failure { failure: String },
}

impl From<Report> for Line {
    fn from(report: Report) -> Self {
        match report {
            Report::Tick(tick) => Line::Tick(tick),
            Report::Evaluated(evaluated) => Line::Evaluated { evaluated },
            Report::Note(note) => Line::Note { note },
        }
    }
}

/// Launches each run in a process of its own.
#[derive(Debug, Clone)]
pub struct Workers {
    program: PathBuf,
    patience: Duration,
}

/// How long a worker may take over its checkpoint: Slurm kills 30 s after its request to stop.
const PATIENCE: Duration = Duration::from_secs(25);

impl Workers {
    /// Workers that run a program again, as `worker --folder DIR`.
    pub fn of(program: PathBuf) -> Self {
        Workers { program, patience: PATIENCE }
    }

    /// The same, but kills a worker that has not ended this long after the request to stop.
    pub fn with_patience(self, patience: Duration) -> Self {
        Workers { patience, ..self }
    }

    fn start(&self, folder: &Path) -> io::Result<Child> {
        let mut command = Command::new(&self.program);
        command
            .args(["worker", "--folder"])
            .arg(folder)
            .envs([("OMP_NUM_THREADS", "1"), ("MKL_NUM_THREADS", "1")])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(create(&folder.join(LOG))?);
        // A group of its own: Ctrl-C on the terminal reaches only the parent, which then stops its
        // workers; a worker that the signal ended would look like a failed run.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        command.spawn()
    }
}

impl Launcher for Workers {
    fn launch(
        &self,
        _run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
    ) -> Result<(), Failure> {
        let failed = |error: io::Error| Failure::Failed(format!("cannot start a worker: {error}"));
        let mut worker = self.start(folder).map_err(failed)?;
        let mut input = worker.stdin.take(); // closing it stops the worker
        let mut deadline = None;
        let output = BufReader::new(worker.stdout.take().expect("its output is piped"));
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
        let mut told = None;
        loop {
            if stop.signal().is_some() {
                drop(input.take());
                let deadline = *deadline.get_or_insert_with(|| Instant::now() + self.patience);
                if Instant::now() >= deadline {
                    // Its files appear in one piece; what it did since its checkpoint is lost.
                    let _ = worker.kill();
                    let _ = worker.wait();
                    return Err(Failure::Unfinished);
                }
            }
            match lines.recv_timeout(Duration::from_millis(50)) {
                Ok(line) => match serde_json::from_str(&line) {
                    Ok(Line::Tick(tick)) => report(Report::Tick(tick)),
                    Ok(Line::Evaluated { evaluated }) => report(Report::Evaluated(evaluated)),
                    Ok(Line::Note { note }) => report(Report::Note(note)),
                    Ok(Line::Failure { failure }) => told = Some(failure),
                    Err(_) => {} // a library that prints
                },
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        let status = worker.wait().map_err(failed)?;
        let log = read_text(&folder.join(LOG)).unwrap_or_default();
        if log.trim().is_empty() {
            let _ = std::fs::remove_file(folder.join(LOG));
        }
        match told {
            Some(failure) => Err(Failure::Failed(failure)),
            None if status.success() => Ok(()),
            None if status.code() == Some(i32::from(RESUME)) => Err(Failure::Unfinished),
            None => Err(Failure::Failed(describe(status, &log, folder))),
        }
    }
}

/// The reason of a worker that ended without a report, as far as it is known.
fn describe(status: ExitStatus, log: &str, folder: &Path) -> String {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        let hint = if signal == 9 { ", as the system does when memory runs out" } else { "" };
        return format!("its worker was killed by signal {signal}{hint}");
    }
    let panic = log.lines().skip_while(|line| !line.contains("panicked at")).nth(1);
    let last = log.lines().rfind(|line| !line.trim().is_empty());
    let said = panic.or(last).unwrap_or("nothing");
    format!("its worker crashed ({status}) and said: {said}; see {}", folder.join(LOG).display())
}

/// The main function of a worker process: carries out the run in `folder` and reports on standard output.
/// Returns its exit code.
pub fn work(catalogue: &Catalogue, folder: &Path, stop: &Stop, carry_out: &CarryOut<'_>) -> u8 {
    let request = stop.clone();
    std::thread::spawn(move || {
        let _ = io::stdin().read_to_end(&mut Vec::new());
        request.request(SIGTERM);
    });
    let say = |line: &Line| {
        let line = serde_json::to_string(line).expect("a line is representable as JSON");
        let mut output = io::stdout().lock();
        // Fails after the parent has ended; the thread above then stops the run.
        let _ = writeln!(output, "{line}").and_then(|()| output.flush());
    };
    let result = RunConfig::load(&folder.join("config.toml"), catalogue)
        .map_err(|error| Failure::Failed(error.to_string()))
        .and_then(|run| carry_out(&run, folder, stop, &mut |report| say(&report.into())));
    match result {
        Ok(()) => 0,
        Err(Failure::Unfinished) => stop.signal().map_or(RESUME, exit_code),
        Err(Failure::Failed(failure)) => {
            say(&Line::Failure { failure });
            1
        }
    }
}

/// How a run is carried out, as [`Launcher::launch`] says.
pub type CarryOut<'a> =
    dyn Fn(&RunConfig, &Path, &Stop, &mut dyn FnMut(Report)) -> Result<(), Failure> + Sync + 'a;

/// Carries out runs in this process.
#[derive(Clone, Copy)]
pub struct InProcess<'a>(pub &'a CarryOut<'a>);

impl Launcher for InProcess<'_> {
    fn launch(
        &self,
        run: &RunConfig,
        folder: &Path,
        stop: &Stop,
        report: &mut dyn FnMut(Report),
    ) -> Result<(), Failure> {
        (self.0)(run, folder, stop, report)
    }
}
