//! Workers: one process per run, so that a crash is one run's own, with one torch thread, so that the
//! numbers do not depend on how many run at once.
//!
//! A worker reads the `config.toml` of its folder and reports on standard output, one JSON object a
//! line: `{"steps":..,"mean_return":..}`, or `{"failure":".."}` before it ends in vain. It never reads
//! its standard input; that closes when the parent dies, however it dies, and the worker ends.

use super::{Failure, LOG, Launcher, Stop, Tick};
use crate::experiment::config::RunConfig;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

/// A line of a worker's standard output.
#[derive(Debug, Serialize, Deserialize)]
#[serde(untagged)]
enum Report {
    Tick(Tick),
    Failure { failure: String },
}

/// Launches each run in a process of its own.
#[derive(Debug, Clone)]
pub struct Workers {
    program: PathBuf,
}

impl Workers {
    /// Workers that run this program again, as `worker --folder DIR`.
    ///
    /// # Errors
    /// If the system does not tell the program's path.
    pub fn of_this_program() -> io::Result<Self> {
        Ok(Workers::of(std::env::current_exe()?))
    }

    /// Workers that run another program in the same way.
    pub fn of(program: PathBuf) -> Self {
        Workers { program }
    }

    fn start(&self, folder: &Path) -> io::Result<Child> {
        let mut command = Command::new(&self.program);
        command
            .args(["worker", "--folder"])
            .arg(folder)
            .envs([("OMP_NUM_THREADS", "1"), ("MKL_NUM_THREADS", "1")])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(File::create(folder.join(LOG))?);
        // A group of its own: Ctrl-C on the terminal reaches the parent alone, which then stops its
        // workers; a worker that died first would look like a failed run.
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
        tick: &mut dyn FnMut(Tick),
    ) -> Result<(), Failure> {
        let failed = |error: io::Error| Failure::Failed(format!("cannot start a worker: {error}"));
        let mut worker = self.start(folder).map_err(failed)?;
        let _alive = worker.stdin.take(); // closing it would end the worker
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
                // Its files appear in one piece, so it can be ended at any moment.
                let _ = worker.kill();
                let _ = worker.wait();
                return Err(Failure::Stopped);
            }
            match lines.recv_timeout(Duration::from_millis(50)) {
                Ok(line) => match serde_json::from_str(&line) {
                    Ok(Report::Tick(report)) => tick(report),
                    Ok(Report::Failure { failure }) => told = Some(failure),
                    Err(_) => {} // a library that prints
                },
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        let status = worker.wait().map_err(failed)?;
        let log = std::fs::read_to_string(folder.join(LOG)).unwrap_or_default();
        if log.trim().is_empty() {
            let _ = std::fs::remove_file(folder.join(LOG));
        }
        match told {
            Some(failure) => Err(Failure::Failed(failure)),
            None if status.success() => Ok(()),
            None => Err(Failure::Failed(describe(status, &log, folder))),
        }
    }
}

/// What is known of a worker that died without a word.
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

/// The whole life of a worker process: carries out the run in `folder` and reports on standard
/// output. Whether the run finished.
pub fn work(folder: &Path, carry_out: CarryOut) -> bool {
    std::thread::spawn(|| {
        let _ = io::stdin().read_to_end(&mut Vec::new());
        // The parent is gone, and with it everyone who could use the result.
        std::process::exit(1);
    });
    let report = |report: &Report| {
        let line = serde_json::to_string(report).expect("a report is representable as JSON");
        let mut output = io::stdout().lock();
        // Fails when the parent is gone; the thread above then ends the process.
        let _ = writeln!(output, "{line}").and_then(|()| output.flush());
    };
    let result = RunConfig::load(&folder.join("config.toml"))
        .map_err(|error| error.to_string())
        .and_then(|run| carry_out(&run, folder, &mut |tick| report(&Report::Tick(tick))));
    match result {
        Ok(()) => true,
        Err(failure) => {
            report(&Report::Failure { failure });
            false
        }
    }
}

/// How a run is carried out: trains and evaluates by the configuration, leaves the artefacts in the
/// folder, and says in words why it failed.
pub type CarryOut = fn(&RunConfig, &Path, &mut dyn FnMut(Tick)) -> Result<(), String>;

/// Carries out runs in this process. Cannot be stopped: whoever uses it leaves signals to end the
/// process.
#[derive(Debug, Clone, Copy)]
pub struct InProcess(pub CarryOut);

impl Launcher for InProcess {
    fn launch(
        &self,
        run: &RunConfig,
        folder: &Path,
        _stop: &Stop,
        tick: &mut dyn FnMut(Tick),
    ) -> Result<(), Failure> {
        (self.0)(run, folder, tick).map_err(Failure::Failed)
    }
}
