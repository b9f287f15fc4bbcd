//! Answers on standard output, as text or as JSON, and messages on standard error.

use anyhow::{Context, Result};
use serde::Serialize;
use std::fmt::Display;
use std::io::{self, Write};
use std::process::ExitCode;

/// Prints an answer as text or, for programs, as JSON on one line.
///
/// # Errors
/// If standard output cannot be written to.
pub fn give(answer: &(impl Display + Serialize), json: bool) -> Result<ExitCode> {
    if json { print_json(answer) } else { print(&answer.to_string()) }
}

/// Prints an answer as JSON on one line.
///
/// # Errors
/// If standard output cannot be written to.
pub fn print_json(answer: &impl Serialize) -> Result<ExitCode> {
    print(&serde_json::to_string(answer)?)
}

/// Prints a text. It is not an error if the reader closes the pipe early (`| head`).
///
/// # Errors
/// If standard output cannot be written to.
pub fn print(text: &str) -> Result<ExitCode> {
    let mut output = io::stdout().lock();
    let end = if text.ends_with('\n') { "" } else { "\n" };
    match write!(output, "{text}{end}").and_then(|()| output.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(error).context("cannot write to standard output")
        }
        _ => Ok(ExitCode::SUCCESS),
    }
}

/// Writes a line to standard error: progress, a note, an error. Where it cannot be written it is lost: no
/// work ends because nobody can read about it.
pub fn note(text: impl Display) {
    // One write, so that lines of several programs in one file do not mix.
    let _ = io::stderr().write_all(format!("{text}\n").as_bytes());
}
